"""Engines that follow one scene: the shared physics (flow, guards, reset, rest, the free stage), and two integrators.

Imports `models`, `motions`, `blocks`, `numerics`, `compiler`. Start with `stepper`, then `taylor.accurate`.
"""
