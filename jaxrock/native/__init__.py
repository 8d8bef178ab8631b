"""Machine code for vectors of lanes: a program that JAX traces for one lane, compiled by LLVM for 2 to 16 of them.

Knows nothing of blocks; imports `numerics.elementary`, `numerics.compound` and `keeping.folder`, and needs llvmlite.
Start with `call` and `postponed`, then `plain`, `unmarked`, `hoisting` and `partition`, `kernels`, `parted`, `emitter`,
`arrays`, `lists` and `operations`, `machine`, `interface` and `pool`.
"""
