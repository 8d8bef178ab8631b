"""The interface of a format of accelerograms."""

import abc
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxrock._core.text import file_error
from jaxrock.motions.record import Origin


class Accelerogram(NamedTuple):
    """One accelerogram of a file: samples in `unit`, one of `parsing.PER_G`.

    `title` may be empty; `origin` holds the metadata that the file states.
    """

    samples: Float[np.ndarray, " n"]
    dt: float
    unit: str
    title: str
    origin: Origin = Origin()

    @classmethod
    def named(cls, samples: np.ndarray, dt: float, unit: str, origin: Origin) -> "Accelerogram":
        """Return an accelerogram whose title is its event, station and component."""
        return cls(samples, dt, unit, ", ".join(filter(None, origin[:3])), origin)


def no_acceleration(name: str, line: int, kind: str, verb: str = "states") -> ValueError:
    """Return what to raise for a file of another quantity."""
    return file_error(name, f"line {line} {verb} {kind.lower()}, but samples must be accelerations.")


class AbstractFormat(abc.ABC):
    """A format of accelerograms.

    - `name`: its word in `read_record(format=...)`.
    - `suffixes`: of file names, in lower case, that tell the format where the content does not.
    - `single`: whether a file holds one component only.
    """

    name: ClassVar[str]
    suffixes: ClassVar[tuple[str, ...]] = ()
    single: ClassVar[bool] = False

    @abc.abstractmethod
    def recognises(self, lines: list[str]) -> bool:
        """Return whether the lines of a file are of this format, beyond doubt.

        After the 400th line, only those with words are among them.
        """

    @abc.abstractmethod
    def read(self, name: str, lines: list[str], dt: float | None, unit: str | None, column: int | None) -> Accelerogram:
        """Read the lines of a file.

        **Arguments:**

        - `name`: of the file, for messages.
        - `lines`: all lines, without their ends; the last may be empty.
        - `dt`, `unit`, `column`: as given to `read_record`, each valid by itself.

        **Returns:** an `Accelerogram`.

        **Raises:** ValueError, with file and line, for a file that is damaged; ValueError for an argument that is
        missing, of no use for the format, or contradicted by the file.
        """

    def components(self, name: str, lines: list[str]) -> tuple[int, ...]:
        """Return the columns or channels that are the components of one record: the first three.

        **Raises:** ValueError for a file that holds one component.
        """
        if self.single:
            told = f"{self.name.upper()} file `{name}` holds one component"
            raise ValueError(f"Argument `paths` must be a file for each component, because {told}.")
        return (0, 1, 2)
