"""How one scene is followed: what any engine does (flow, guards, reset, rest, the free stage), and two engines.

Imports `models`, `motions`, `blocks`, `transforms`, `numerics`. Start with `stepper`, then `taylor.careful`.
"""
