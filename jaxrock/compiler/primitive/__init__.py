"""One primitive of JAX for a lane function: binding, batching, derivatives, transposition and lowering.

Imports `autodiff`, `jaxpr`, `llvm`, `cache` and `hints`. Start with `lane_function`, then `bind`, `lower` and `lanes`.
"""
