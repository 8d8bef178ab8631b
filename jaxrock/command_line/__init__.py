"""The command `jaxrock`.

Imports everything. Start with `main`.
"""
