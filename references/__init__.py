"""References that judge jaxrock in tests and benchmarks: solutions, the programs that made them, hard scenes.

Not installed. Generators run from the root as modules: `python -m references.derivatives`.
Imports jaxrock where a motion or a scan is taken from it, and nothing of tests or benchmarks.
"""
