"""Mathematics that knows nothing of blocks: elementary functions, polynomials and their first events, roots, sums of
exponentials, divided differences, quadrature, optimisers; and operations of JAX that stand for many (`compound`).

Imports nothing of the package but what lies below all of it. Start with `polynomial`: the series engine rests on it.
"""
