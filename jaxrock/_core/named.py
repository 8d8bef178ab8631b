"""Named collections, such as a suite of records: items are taken by number, along an axis of a sweep."""

import abc
from typing import Any

import equinox as eqx


class AbstractNamed(eqx.Module):
    """A collection of items with names; an item is taken by its number, which may be traced."""

    names: eqx.AbstractVar[tuple[str, ...]]

    @abc.abstractmethod
    def __getitem__(self, number) -> Any:
        """Return one item."""
