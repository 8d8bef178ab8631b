"""Restraints of a block: tendons, ties and dampers, whose forces do not change with the weight.

Imports `blocks`, `numerics` and the modules of `models` below it. Start with `restraint`, the interface; each restraint
is one file.
"""
