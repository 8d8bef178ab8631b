"""Names in pytrees that compiled programs ignore."""

from typing import Any


class Label:
    """A name, or several, that compiled functions do not see.

    All labels are equal, so that a new one compiles nothing.
    """

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Label)

    def __hash__(self) -> int:
        return 0

    def __repr__(self) -> str:
        first = self.value[0] if isinstance(self.value, tuple) and self.value else self.value
        return repr(first)
