"""Engines that follow one scene: the shared physics (flow, guards, reset, rest, the free stage), and two integrators.

Imports `models`, `motions`, `blocks`, `transforms`, `numerics`. Start with `stepper`, then `taylor.careful`.
"""
