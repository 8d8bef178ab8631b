"""Many scenes: a grid of points cut into blocks, over devices, processes and interruptions, and its results.

Imports `transforms`; knows nothing of blocks. Start with `sweep`, then `plan` and `runner`.
"""
