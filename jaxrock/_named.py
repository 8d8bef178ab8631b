"""Many things with names, of which one is taken by its number: an axis of a sweep."""

import abc
from typing import Any

import equinox as eqx


class AbstractNamed(eqx.Module):
    """Things by their numbers, which may be traced, and their names."""

    names: eqx.AbstractVar[tuple[str, ...]]

    @abc.abstractmethod
    def __getitem__(self, number) -> Any:
        """One of them."""
