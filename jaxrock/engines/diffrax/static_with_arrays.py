"""Objects of other libraries as pytrees: their arrays are leaves, and all else is static."""

from typing import Any

import equinox as eqx
from jaxtyping import PyTree


class StaticWithArrays(eqx.Module):
    """An object that may hold arrays, as a pytree for `jax.jit`; without arrays it is entirely static."""

    arrays: PyTree
    rest: Any = eqx.field(static=True)

    @classmethod
    def of(cls, value: PyTree) -> "StaticWithArrays":
        """Partition an object into its arrays and all else."""
        return cls(*eqx.partition(value, eqx.is_array))

    @property
    def value(self) -> PyTree:
        """Return the object, combined again."""
        return eqx.combine(self.arrays, self.rest)
