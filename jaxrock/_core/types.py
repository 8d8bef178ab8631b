"""Types of arrays in annotations: `Scalar`, `Flag` and `Real` are JAX's, traced or concrete."""

from jaxtyping import Array, ArrayLike, Bool, Float, Inexact

Scalar = Inexact[Array, ""]
Flag = Bool[Array, ""]
Real = Inexact[Array, "..."]
RealLike = Inexact[ArrayLike, "..."]
Floats = Float[Array, "..."]
