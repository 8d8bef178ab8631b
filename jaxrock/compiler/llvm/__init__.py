"""Compile a jaxpr of one lane to machine code for vectors of 2 to 16 lanes, by LLVM. Needs llvmlite.

Imports `jaxpr`, `cache.store` and `xla_ffi`. Start with `compiled_program` and `compaction`, then `kernels`, `emitter`,
`operations`, `divergent_loop` and `jit`.
"""
