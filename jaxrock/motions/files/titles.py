"""Titles of columns of text: units, the kind of the first column, directions of sensors.

Nothing is guessed: a word that looks like another unit is refused, and so is a first column that is said to be no time.
"""

import csv
import re
from typing import NamedTuple

import numpy as np

from jaxrock._core.text import file_error
from jaxrock.motions.files.parsing import is_unit, unit_named

# A factor beside g: 0.1 g, g/10, 10^-3 g, percent of g.
_FACTOR = r"(?:[-−+\d.,\s%‰^*/x×·()e]|per\s?cent|pct|per\s?mille?|milli|micro|of|times)*"
_LENGTH = r"(?:[kcdmµμ]?m|in(?:ch(?:es)?)?|ft|feet|foot)"
# Units that are refused for accelerations, or of other quantities: any speed or length, parts of g, volts.
_SURE = (
    r"(%|milli|micro|[mµμu])[-\s]*(g|gals?)"
    rf"|{_FACTOR}(g|gals?){_FACTOR}"
    rf"|{_FACTOR}{_LENGTH}[\W_]*(p?ss?(ec\w*)?|sq\w*)([\W\d_]|s(ec\w*)?\b|sq\w*|x|times)*"
    rf"|{_LENGTH}|[mµμ]?v(olts?)?|counts?|k?hz"
)
_OTHER_UNIT = re.compile(
    rf"{_SURE}|.*(/|\bper\b)\s*s(ec(onds?)?)?(/s(ec)?|[\^*]*[2²])?|.*\bs(ec)?\^?[-−⁻][12²]", re.IGNORECASE
)
_OTHER_BARE = re.compile(rf"(?=[^\W\d]|%)(?:{_SURE})", re.IGNORECASE)
SECONDS = (
    dict.fromkeys(["s", "sec", "secs", "second", "seconds"], 1.0)
    | dict.fromkeys(["ms", "msec", "msecs", "millisecond", "milliseconds"], 1e-3)
    | dict.fromkeys(["us", "µs", "μs", "usec", "microsecond", "microseconds"], 1e-6)
    | dict.fromkeys(["min", "minute", "minutes"], 60.0)
)
_COUNTS = {"step", "steps", "index", "no", "nr", "n", "i", "k", "number", "sample", "samples", "point", "points"}
_SPECTRUM = {"frequency", "freq", "period", "periods", "frequencies"}
_TIME = re.compile(r"(?:elapsed |relative |record )?(?:t|times?|zeit|temps|tiempo|tempo)", re.IGNORECASE)
_NO_DIRECTION = re.compile(r"\b(?:a|acc\w*|ground|motion|component|comp|sensor|of|the|in)\b", re.IGNORECASE)

_BRACKETS = re.compile(r"\[([^\[\]]*)\]|\(((?:[^()]|\([^()]*\))*)\)|\{([^{}]*)\}|<([^<>]*)>")
_BEFORE_BARE = re.compile(r"\s*[/:]\s*|\s+-\s+|[\s_]+(?:in[\s_]+)?")  # time_ms, t/ms, time in ms
SHORT = {"m", "v", "in"}  # other units that are also words or directions, where no brackets surround them
_BEHIND_BRACKETS, _NOT_BEFORE_BRACKETS = re.compile(r"(?<=[\])}>])\s+"), re.compile(r"\s+(?![\[({<])")
_MARK, _RULE = re.compile(r"^(?:[#%!]|//)+\s*"), re.compile(r"[-=_*+|~.:,;#\s]+")
_SAID = re.compile(
    r"\b(?:units\b\s*(?:[:=]|(?:of|in|are)\b)?|unit\s*(?:[:=]|(?:of|in|is)\b)|(?:acc\w*|times?)\s+(?:(?:is|are)\s+)?in\b)",
    re.IGNORECASE,
)
# "in g: 0.311", "in g at 3.2 s: 0.311", "in minutes 1.5": a value, of a peak or a duration
_WHERE = r"(?:at|for|of|along|on)\b[^,;&\t:=]*"
_BEHIND_UNIT = re.compile(rf"[)\]}}>]\s*(?:{_WHERE}[:=]|[:=]?)\s*[-+.]?\d", re.IGNORECASE)
_VALUED = re.compile(
    rf"(\s*\S.*?)(?:\s*\([^()]*\)|\s+{_WHERE})?"
    r"(?:(\s*[:=]|\s+(?:is|was)\b)\s*[-+.]?\d|\s+[-+.\d]+\s*$)",
    re.IGNORECASE,
)
_DIRECTION = re.compile(r"[NSEWUDVHXYZLTR]{1,3}\d?|[NSEWUD]-[NSEWUD]|\d{1,3}|up|down|vert\w*\.?", re.IGNORECASE)
_VALUE = re.compile(r"(^|[\s=:])[-+\d.]+($|\s)")  # a number, so no title: `PGA = 0.3 g`
_STATED = re.compile(r"[:=]\s*[-+.]?\d")
_OR = " or else "  # between units of one title
_LONG = 300  # characters of a title; ten times as many of a line of titles


class Title(NamedTuple):
    """A title, and its unit as written: empty where it states none. `bare`: no brackets are around the unit."""

    word: str = ""
    unit: str = ""
    bare: bool = False

    @property
    def is_time(self) -> bool:
        """Return whether it says that the numbers are times."""
        said = _TIME.fullmatch(" ".join(self.word.replace("_", " ").split()).rstrip("."))
        return bool(said) or not self.bare and _seconds(self.unit)

    @property
    def states_unit(self) -> bool:
        """Return whether it states one that is known."""
        return is_unit(self.unit) or _seconds(self.unit)

    def with_unit(self, unit: str) -> "Title":
        """Return the title with a unit from elsewhere; its own text in brackets, such as (NS), then belongs to the
        word.
        """
        if not unit or is_any_unit(self.unit):
            return self
        return Title(f"{self.word} {self.unit}".strip(), unit)


class Titles(NamedTuple):
    """The line of column titles, and the title of each column; empty where no line has as many titles as there are
    columns.

    `said`: units that the header states elsewhere, of accelerations and of times, each with its line.
    """

    line: int
    titles: tuple[Title, ...]
    said: tuple[tuple[int, str], tuple[int, str]] = ((0, ""), (0, ""))

    def unit_of(self, name: str, column: int) -> tuple[int, str]:
        """Return a line, and the unit that it states of a column; empty for none, or for another word in brackets."""
        written = self._of(column).unit
        written = written if is_unit(written) or _OTHER_UNIT.fullmatch(written) or _OR in written else ""
        line, elsewhere = self.said[0]
        if written and elsewhere and written != elsewhere and not _same(written, elsewhere):
            raise file_error(name, f"line {self.line} states the unit {written!r}, but line {line} {elsewhere!r}.")
        return (self.line, written) if written else (line, elsewhere)

    def seconds(self, name: str, numbers: np.ndarray) -> tuple[float, bool] | None:
        """Return the unit of the first column in seconds, and whether it is stated; None where the column counts
        samples.

        **Raises:** ValueError, if the header says that the numbers are something else.
        """
        title = self._of(0)
        word, written = title.word.strip(" .").lower(), title.unit.lower().rstrip(".")
        if word in _SPECTRUM or written and written not in SECONDS:
            shown = " ".join(filter(None, (title.word, f"[{title.unit}]" if title.unit else "")))
            said = f"line {self.line} titles column 0 {shown!r}"
            raise file_error(name, f"{said}, but before accelerations there must be times in s, ms, us or min.")
        if written:
            return SECONDS[written], True
        # Tables with a numbered row have a first column without a title.
        if word in _COUNTS or self.titles and not word and (np.diff(numbers) == 1).all():
            return None
        elsewhere = self.said[1][1].lower().rstrip(".")
        return SECONDS.get(elsewhere, 1.0), bool(elsewhere)

    def is_time(self, column: int) -> bool:
        """Return whether a column is said to hold times."""
        return self._of(column).is_time

    def counts(self, column: int) -> bool:
        """Return whether a column is said to count samples."""
        return self._of(column).word.strip(" .").lower() in _COUNTS

    def direction(self, column: int) -> str:
        """Return the direction of a column's sensor, from its title."""
        title = self._of(column)
        word = " ".join(_NO_DIRECTION.sub(" ", title.word.replace("_", " ")).split())
        return word or (title.unit if _DIRECTION.fullmatch(title.unit) and not is_any_unit(title.unit) else "")

    def _of(self, column: int) -> Title:
        return self.titles[column] if self.titles else Title()


def _seconds(unit: str) -> bool:
    return unit.lower().rstrip(".") in SECONDS


def _same(one: str, other: str) -> bool:
    """Return whether two spellings are of one unit."""
    return is_unit(one) and unit_named(one) == unit_named(other)


def titles_of(name: str, lines: list[str], width: int, spare: bool) -> Titles:
    """Read the titles of `width` columns from the lines of a header.

    `spare`: whether rows end with an empty field, which has its own title.
    """
    said = _said(lines, width)
    units, plain = said.pop("columns", None), None
    for number in range(len(lines), 0, -1):
        text = _MARK.sub("", lines[number - 1].strip()).strip()[: 10 * _LONG]
        if not text or _RULE.fullmatch(text):
            continue
        every = _parted(text, width)
        fitting = [titles for titles in every if len(titles) == width]
        only = next((titles for titles in fitting if _only_units(titles)), None)
        if only and units is None:
            units = number, only
            continue
        titles = next((titles for titles in fitting if any(each.states_unit for each in titles)), None)
        titles = titles or next((titles for titles in fitting if titles[0].is_time or titles[0].bare), None)
        if titles is None and not fitting:
            titles = _of_other_width(name, number, every, width, spare)
        if titles is not None:
            return _with_units(name, number, titles, units, said)
        if fitting and plain is None and (set("\t;,") & set(text) or _is_plain(fitting[0])):
            plain = number, fitting[0]
    number, titles = plain or (units[0] if units else 0, ())
    return _with_units(name, number, titles, units, said)


def _of_other_width(name, number: int, every: list[list[Title]], width: int, spare: bool) -> list[Title] | None:
    """Refuse a line of titles in another number than the columns, unless rows have an empty last field."""
    for titles in every:
        of_times = titles[0].is_time or titles[0].bare
        if len(titles) > 1 and of_times and any(each.states_unit for each in titles):
            if spare and len(titles) == width + 1:
                return titles[:width]
            columns = f"{width} column{'s' if width > 1 else ''}"
            raise file_error(name, f"line {number} has {len(titles)} titles, but {columns} of numbers follow.")
    return None


def _with_units(name: str, number: int, titles, units: tuple[int, list[Title]] | None, said: dict) -> Titles:
    """Combine titles with a line of units."""
    found = tuple(titles)
    if units:
        line, below = units
        found = found or tuple(Title() for _ in below)
        for above, under in zip(found, below):
            differs = above.unit != under.unit and not _same(above.unit, under.unit)
            if differs and under.unit and is_any_unit(above.unit):
                stated = f"line {number} states the unit {above.unit!r}, but line {line} {under.unit!r}"
                raise file_error(name, f"{stated}.")
        found = tuple(above.with_unit(under.unit) for above, under in zip(found, below))
        number = line
    return Titles(number, found, (said.get("acceleration", (0, "")), said.get("time", (0, ""))))


def _said(lines: list[str], width: int) -> dict:
    """Return units that lines state in words: `units: cm/s2`, `times in ms`; one for every column, if there are as
    many.
    """
    found: dict = {}
    for number, line in enumerate(lines, 1):
        begin = _SAID.search(line)
        if not begin or _is_of_a_value(line[begin.end() :]):
            continue
        parts = [_inner(part) for part in re.split(r"[,;&\t]|\band\b", line[begin.end() :])]
        words = [word for part in parts for word in ([part] if is_any_unit(part) else map(_inner, part.split()))]
        titles = [Title("", word) for word in words]
        if len(words) == width > 1 and _only_units(titles):
            found.setdefault("columns", (number, titles))
            continue
        known = list(dict.fromkeys(word for word in words if is_unit(word)))
        times = list(dict.fromkeys(word for word in words if _seconds(word)))
        other = [word for word in words if word not in times and is_any_unit(word) and word.lower() not in SHORT]
        if len(known) == 1 or not known and other:
            found.setdefault("acceleration", (number, (known or other)[0]))
        if len(times) == 1 and (known or not other):
            found.setdefault("time", (number, times[0]))
    return found


def _is_of_a_value(words: str) -> bool:
    """Return whether a unit is that of a value behind it, and says nothing of the columns."""
    found = _VALUED.match(words[:_LONG])
    # Without a sign between them, a number beside a unit of acceleration may be a factor.
    return found is not None and (is_any_unit if found[2] else _seconds)(_inner(found[1]))


def _is_plain(titles: list[Title]) -> bool:
    """Return whether words that blanks part are titles, and not just as many as there are columns."""
    first = titles[0].word.lower()
    return first in _COUNTS | _SPECTRUM or all(_DIRECTION.fullmatch(each.word) for each in titles)


def is_any_unit(word: str) -> bool:
    """Return whether a word is a unit, of whatever."""
    return is_unit(word) or _seconds(word) or bool(_OTHER_UNIT.fullmatch(word[:_LONG]))


def _only_units(titles: list[Title]) -> bool:
    """Return whether a line holds nothing but units, and one of times or accelerations among them."""
    good = all(
        not each.word and (not each.unit or each.states_unit or _OTHER_UNIT.fullmatch(each.unit)) for each in titles
    )
    return good and any(each.states_unit for each in titles)


def _parted(line: str, width: int) -> list[list[Title]]:
    """Split a line into titles, in all possible ways: titles hold blanks, and units in brackets."""
    marks = [mark for mark in "\t;," if mark in line]
    apart = [next(csv.reader([line], delimiter=mark, skipinitialspace=True)) for mark in marks[:2]]
    apart = [fields[:-1] if not fields[-1].strip() else fields for fields in apart]
    found = [[_title(field) for field in fields] for fields in apart]
    if width == 1:
        found.append([_title(line)])
    if not marks or marks == ["\t"]:
        words = line.split()
        plain = [Title("" if _is_bare(word) else word, word if _is_bare(word) else "") for word in words]
        bracketed = [_title(word) for word in words]
        # Without a separator, an ambiguous word is a unit only among units.
        found.append(plain if _only_units(plain) else [t if t.word else Title(w) for t, w in zip(bracketed, words)])
        for mark in (_BEHIND_BRACKETS, _NOT_BEFORE_BRACKETS):
            titles = [_title(field) for field in mark.split(line)]
            found += [titles] if titles[0].states_unit and not titles[0].bare and not _STATED.search(line) else []
    return found


def _inner(text: str) -> str:
    """Return a unit without brackets around it."""
    text = text.strip(" .:\"'")
    found = _BRACKETS.fullmatch(text)
    return next((part for part in found.groups() if part), "").strip() if found else text


def _title(field: str) -> Title:
    """Parse a field of a line of titles."""
    field = field.strip().strip("\"'").strip()[:_LONG]
    if not field:
        return Title()
    found = [(each, next((part for part in each.groups() if part), "").strip()) for each in _BRACKETS.finditer(field)]
    found = [] if _BEHIND_UNIT.search(field) else found  # a value follows: no title
    known = [(each, text) for each, text in found if is_unit(text) or _seconds(text)]
    other = [(each, text) for each, text in found if _OTHER_UNIT.fullmatch(text) and not is_unit(text)]
    other = [(each, text) for each, text in other if not _seconds(text) and text.lower() not in SHORT]
    stated = known + other
    if len({text for _, text in stated}) > 1:
        return Title(_BRACKETS.sub(" ", field).strip(), _OR.join(text for _, text in stated))
    at_end = [(each, text) for each, text in found if each.end() == len(field)]
    for each, text in (stated or at_end)[:1]:
        return Title(f"{field[: each.start()].rstrip(' /')} {field[each.end() :]}".strip(), text)
    return _bare(field)


def _bare(field: str) -> Title:
    """Parse a title without brackets: `time_ms`, `t/ms`, `Acc in cm/s2`."""
    if _is_bare(field):
        return Title("", field, True)
    for mark in _BEFORE_BARE.finditer(field):
        word, unit = field[: mark.start()], field[mark.end() :]
        named = word and not _VALUE.search(word) and not _is_of_a_value(unit) and (word + unit).lower() != "ns"
        if named and (_is_bare(unit) or unit in ("G", "S") and re.fullmatch(r"acc\w*|t|time", word, re.IGNORECASE)):
            return Title(word, unit.replace("_", "/"), True)
    first, *within = field.split()
    unit = "" if _VALUE.search(field) else next((word for word in within if len(word) > 1 and is_unit(word)), "")
    return Title(" ".join([first, *(word for word in within if word != unit)]), unit, bool(unit))


def _is_bare(text: str) -> bool:
    """Return whether a word without brackets is a unit, beyond doubt."""
    text = text.replace("_", "/")
    if len(text) == 1:
        return text in "gs"  # G and S may be names
    return is_unit(text) or _seconds(text) or bool(_OTHER_BARE.fullmatch(text)) and text.lower() not in SHORT
