"""Flexible columns on a rocking base, exact in every phase of the motion.

Imports `blocks`, `motions`, `transforms`, `numerics`. Start with `phases`, then `stepper`, then `response`.
"""
