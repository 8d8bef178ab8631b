"""Nodes and weights of Gauss-Legendre quadrature."""

import numpy as np
from jaxtyping import Float

from jaxrock._core.settings import kept_by_precision


@kept_by_precision
def gauss_legendre(count: int) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, " count"]]:
    """Return nodes and weights on [-1, 1], exact for polynomials of degree 2 count - 1; the arrays are read-only."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    nodes.flags.writeable = weights.flags.writeable = False
    return nodes, weights


@kept_by_precision
def gauss_legendre_of_unit(count: int) -> tuple[Float[np.ndarray, " count"], Float[np.ndarray, " count"]]:
    """Return nodes and weights on [0, 1]; the arrays are read-only."""
    nodes, weights = gauss_legendre(count)
    nodes, weights = (nodes + 1) / 2, weights / 2
    nodes.flags.writeable = weights.flags.writeable = False
    return nodes, weights
