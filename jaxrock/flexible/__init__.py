"""Flexible columns on a rocking base: exact in every linear phase; a nonlinear remainder is iterated beside a linear
one.

Imports `engines`, `blocks`, `motions`, `numerics`, `compiler`. Start with `phases`, then `stepper`, then `response`.
Nonlinear columns are in `column`, then `remainder`, then `nonlinear`.
"""
