"""Mathematics that knows nothing of blocks: elementary functions, polynomials and their first events, roots, sums of
exponentials, divided differences, quadrature, optimisers.

Imports nothing of the package but `_checks`. Start with `polynomial`: the series engine rests on it.
"""
