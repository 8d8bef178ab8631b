"""What JAX's transformations do with a function of one scene: one primitive for it, at one scene or at many, with its
derivatives; and functions known by what they read, and by the program that they trace to.

Imports `native`, `keeping` and `numerics`. Start with `recipe`, then `scenes` (the rules), `lowering` and `batching`.
"""
