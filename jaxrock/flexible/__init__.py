"""Flexible columns on a rocking base: exact in every phase that is linear; what is not is followed beside a linear one.

Imports `engines`, `blocks`, `motions`, `transforms`, `numerics`. Start with `phases`, then `stepper`, then `response`;
of what is not linear with `column`, then `remainder`, then `nonlinear`.
"""
