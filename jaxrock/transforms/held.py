"""Objects of other libraries in a pytree: their arrays are leaves, and all else is static."""

from typing import Any

import equinox as eqx
from jaxtyping import PyTree


class Held(eqx.Module):
    """An object that may hold arrays, as `jax.jit` takes it: without arrays it is as static as a number."""

    arrays: PyTree
    rest: Any = eqx.field(static=True)

    @classmethod
    def of(cls, value: PyTree) -> "Held":
        """Part its arrays from all else."""
        return cls(*eqx.partition(value, eqx.is_array))

    @property
    def value(self) -> PyTree:
        """The object again."""
        return eqx.combine(self.arrays, self.rest)
