"""What JAX's transformations do with a function of one scene: many at once, derivatives of every order and mode,
tracing where it is compiled, and functions known by the program that they trace to.

Imports `native` and `numerics`. Start with `differentiation`, then `batching`.
"""
