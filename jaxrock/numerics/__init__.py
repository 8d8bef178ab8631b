"""Pure mathematics: elementary functions, polynomials and their first events, roots, sums of exponentials, divided
differences, quadrature, optimisers; and JAX primitives for groups of operations (`compound`).

Imports only the modules below it in the package. Start with `polynomial`: the series engine rests on it.
"""
