"""Sweeps over many scenes: a grid of points in blocks, over devices, processes and interruptions, and its results.

Imports `_arguments`, `compiler` and `_core`; knows no physics of rocking blocks. Start with `sweep`, then `plan` and
`runner`.
"""
