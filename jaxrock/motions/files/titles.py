"""What the titles of columns of text say: the unit of accelerations, and what the numbers beside them are.

Nothing is guessed: what looks like another unit is refused, and so is a first column that is said to be no time.
"""

import re
from typing import NamedTuple

import numpy as np

from jaxrock._text import file_error
from jaxrock.motions.files.parsing import is_unit

_BRACKETS = re.compile(r"[\[(]\s*([^()\[\]]+?)\s*[\])]$")
# Units that accelerations are not read in, or that are of something else: any speed or length, parts of g, volts.
_OTHER_UNIT = re.compile(
    r"(%|milli|micro|[mµμu])[-\s]*(g|gals?)"
    r"|.*(/|\bper\b)\s*s(ec(onds?)?)?(/s(ec)?|[\^*]*[2²])?|.*\bs(ec)?\^?[-−][12]"
    r"|[kcmµμ]?m|in(ch(es)?)?|ft|feet|[mµμ]?v(olts?)?|counts?",
    re.IGNORECASE,
)
SECONDS = (
    dict.fromkeys(["s", "sec", "secs", "second", "seconds"], 1.0)
    | dict.fromkeys(["ms", "msec", "millisecond", "milliseconds"], 1e-3)
    | dict.fromkeys(["us", "µs", "μs", "usec", "microsecond", "microseconds"], 1e-6)
    | dict.fromkeys(["min", "minute", "minutes"], 60.0)
)
_COUNTS = {"step", "steps", "index", "no", "nr", "n", "i", "k", "number", "sample", "samples", "point", "points"}
_SPECTRUM = {"frequency", "freq", "period", "periods", "frequencies"}


class Titles(NamedTuple):
    """The line that titles columns, and its fields; none where no line has as many as there are columns."""

    line: int
    fields: list[str]

    def unit_of(self, column: int) -> str:
        """The unit in brackets behind a title; empty where there is none, or another word in brackets."""
        written = self._in_brackets(column)
        return written if is_unit(written) or _OTHER_UNIT.fullmatch(written) else ""

    @property
    def state_units(self) -> bool:
        """Whether there is a unit in brackets behind the first."""
        return bool(self.unit_of(0)) or self._in_brackets(0).lower().rstrip(".") in SECONDS

    def seconds(self, name: str, numbers: np.ndarray) -> float | None:
        """What the numbers of the first column are in [s]; None where they count samples. ValueError, if they are
        said to be something else."""
        if not self.fields:
            return 1.0
        title, written = self.fields[0], self._in_brackets(0)
        word = _BRACKETS.sub("", title).strip(" .").lower()
        if word in _SPECTRUM or written and written.lower().rstrip(".") not in SECONDS:
            said = f"line {self.line} titles column 0 {title!r}"
            raise file_error(name, f"{said}, but before accelerations there must be times in s, ms, us or min.")
        if written:
            return SECONDS[written.lower().rstrip(".")]
        # A column without a title is how tables with a numbered row are written.
        counts = word in _COUNTS or not word and (np.diff(numbers) == 1).all()
        return None if counts else 1.0

    def _in_brackets(self, column: int) -> str:
        written = _BRACKETS.search(self.fields[column]) if self.fields else None
        return written[1] if written else ""
