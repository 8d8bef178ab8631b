"""Equations of motion of a rigid block: a table of coefficients, or functions of the user's own.

Imports `blocks` and `numerics`. Start with `equation`, what every model must tell, then `rigid`.
"""
