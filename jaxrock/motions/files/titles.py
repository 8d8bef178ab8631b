"""Titles of columns of text: units, the kind of the first column, directions of sensors.

Nothing is guessed: a word that looks like another unit is refused, and so is a first column that is said to be no time.
"""

import csv
import re
from typing import NamedTuple

import numpy as np

from jaxrock._core.text import file_error
from jaxrock.motions.files.parsing import NUMBER, is_unit
from jaxrock.motions.files.unit_words import (
    BRACKETS,
    LONGEST_TITLE,
    OTHER_UNIT,
    SECONDS,
    SHORT,
    is_any_unit,
    is_bare_unit,
    is_seconds,
    same_unit,
    without_brackets,
)

_COUNTS = {"step", "steps", "index", "no", "nr", "n", "i", "k", "number", "sample", "samples", "point", "points"}
_SPECTRUM = {"frequency", "freq", "period", "periods", "frequencies"}
_TIME = re.compile(r"(?:elapsed |relative |record )?(?:t|times?|zeit|temps|tiempo|tempo)", re.IGNORECASE)
_NO_DIRECTION = re.compile(r"\b(?:a|acc\w*|ground|motion|component|comp|sensor|of|the|in)\b", re.IGNORECASE)

_BEFORE_BARE = re.compile(r"\s*[/:]\s*|\s+-\s+|[\s_]+(?:in[\s_]+)?")  # time_ms, t/ms, time in ms
_BEHIND_BRACKETS, _NOT_BEFORE_BRACKETS = re.compile(r"(?<=[\])}>])\s+"), re.compile(r"\s+(?![\[({<])")
_MARK, _RULE = re.compile(r"^(?:[#%!]|//)+\s*"), re.compile(r"[-=_*+|~.:,;#\s]+")
_ACCELERATION = (
    r"acc\w*\.?(?:\s+(?:data|values?|series|time|history|histories|records?|is|are|given|measured|expressed|stated))*"
)
_SAID = re.compile(
    r"\b(?:units\b\s*(?:[:=]|(?:of|in|are)\b)?|unit\s*(?:[:=]|(?:of|in|is)\b)|times?\s+(?:(?:is|are)\s+)?in\b"
    rf"|{_ACCELERATION}\s+in\b|\w+units?\s*[:=]|units?_\w+\s*[:=])",
    re.IGNORECASE,
)
_UNIT_OF_ACCELERATION = re.compile(rf"\b{_ACCELERATION}\s*(?={BRACKETS.pattern})", re.IGNORECASE)
_OTHER_QUANTITY = re.compile(r"vel|dis[pt]|len|height|depth|freq|angle|lat|lon|mag", re.IGNORECASE)
_EXTREME = re.compile(r"\b(?:pg[avd]|peaks?|max\w*|min\w*|rms|largest|scaled?)\b", re.IGNORECASE)
_COLUMN = re.compile(r"(?:the\s+)?col(?:umn)?\.?\s*#?\s*(\d+)\s*(?:[:=)-]|(?:is|holds)\b)\s*(.+)", re.IGNORECASE)
_OF_A_VALUE = re.compile(r"[:=]\s*[-+]?\.?\d")
_BEHIND_LAST_UNIT = re.compile(r"[)\]}>]\s*[:=]?\s*[-+.]?\d[^\[({<]*$")
_PROSE = re.compile(r"[:=]|[.!?]\s|\b(?:1[89]|20)\d\d\b")
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


class Title(NamedTuple):
    """A title, and its unit as written: empty where it states none. `bare`: no brackets are around the unit."""

    word: str = ""
    unit: str = ""
    bare: bool = False

    @property
    def is_time(self) -> bool:
        """Return whether it says that the numbers are times."""
        said = _TIME.fullmatch(" ".join(self.word.replace("_", " ").split()).rstrip("."))
        return bool(said) or not self.bare and is_seconds(self.unit)

    @property
    def states_unit(self) -> bool:
        """Return whether it states one that is known."""
        return is_unit(self.unit) or is_seconds(self.unit)

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

    `said`: units that the header states elsewhere, of accelerations and of times, each with its line. `lines`: the line
    of each title, where every column has its own.
    """

    line: int
    titles: tuple[Title, ...]
    said: tuple[tuple[int, str], tuple[int, str]] = ((0, ""), (0, ""))
    lines: tuple[int, ...] = ()

    def unit_of(self, name: str, column: int) -> tuple[int, str]:
        """Return a line, and the unit that it states of a column; empty for none, or for another word in brackets."""
        written = self._of(column).unit
        written = written if is_unit(written) or OTHER_UNIT.fullmatch(written) or _OR in written else ""
        line, elsewhere = self.said[0]
        own = self.lines[column] if self.lines else self.line
        if written and elsewhere and written != elsewhere and not same_unit(written, elsewhere):
            raise file_error(name, f"line {own} states the unit {written!r}, but line {line} {elsewhere!r}.")
        return (own, written) if written else (line, elsewhere)

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


def titles_of(name: str, lines: list[str], width: int, spare: int, row: str = "") -> Titles:
    """Read the titles of `width` columns from the lines of a header.

    `spare`: the number of empty fields at the end of a row, which have titles of their own. `row`: the first row of
    numbers, whose separators are those of titles without units.
    """
    said = _said(name, lines, width)
    units, plain = said.pop("columns", None), None
    for number in range(len(lines), 0, -1):
        text = _MARK.sub("", lines[number - 1].strip()).strip()[: 10 * LONGEST_TITLE]
        if not text or _RULE.fullmatch(text) or _COLUMN.match(text) or _states_a_value(text):
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
        if fitting and plain is None and (_are_names(fitting[0], text, row) or _is_plain(fitting[0])):
            plain = number, fitting[0]
    listed = _listed(name, lines, width)
    if listed:
        numbers, found = zip(*listed)
        return Titles(numbers[0], found, _both(name, said, found), numbers)
    number, titles = plain or (units[0] if units else 0, ())
    return _with_units(name, number, titles, units, said)


def _of_other_width(name, number: int, every: list[list[Title]], width: int, spare: int) -> list[Title] | None:
    """Refuse a line of titles in another number than the columns, unless rows have empty last fields."""
    for titles in every:
        of_times = titles[0].is_time or titles[0].bare
        if len(titles) > 1 and of_times and any(each.states_unit for each in titles):
            if width < len(titles) <= width + spare:
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
            differs = above.unit != under.unit and not same_unit(above.unit, under.unit)
            if differs and under.unit and is_any_unit(above.unit):
                stated = f"line {number} states the unit {above.unit!r}, but line {line} {under.unit!r}"
                raise file_error(name, f"{stated}.")
        found = tuple(above.with_unit(under.unit) for above, under in zip(found, below))
        number = line
    return Titles(number, found, _both(name, said, found))


def _both(name: str, said: dict, titles: tuple[Title, ...]) -> tuple[tuple[int, str], tuple[int, str]]:
    """Return the units that a header states of accelerations and times.

    A unit beside the word acceleration counts where neither titles nor other words state one.
    """
    acceleration, beside = said.get("acceleration", (0, "")), said.get("beside", [])
    if beside and not acceleration[1] and not any(is_unit(each.unit) for each in titles):
        for other in beside:
            _agree(name, beside[0], other)
        acceleration = beside[0]
    return acceleration, said.get("time", (0, ""))


def _listed(name: str, lines: list[str], width: int) -> list[tuple[int, Title]]:
    """Return lines and titles of columns that have a line each, from 1 or 0 on: "Column 2: acceleration (cm/s2)"."""
    found: dict[int, tuple[int, Title]] = {}
    for number, line in enumerate(lines, 1):
        said = _COLUMN.match(_MARK.sub("", line.strip()))
        if said and found.setdefault(int(said[1]), (number, _title(said[2])))[0] != number:
            raise file_error(name, f"line {number} titles column {said[1]} once more.")
    first = 0 if 0 in found else 1
    if any(place >= width + first for place in found):
        return []
    return [found.get(place, (0, Title())) for place in range(first, width + first)] if found else []


def _states_a_value(text: str) -> bool:
    """Return whether a line states a value, such as "Duration (s): 40", so that its words are no titles."""
    marks = [mark for mark in "\t;," if mark in text]
    if not marks:
        words = text.split()
        beside = any(
            re.fullmatch(NUMBER, word) and is_any_unit(without_brackets(unit)) for word, unit in zip(words, words[1:])
        )
        behind = _BEHIND_LAST_UNIT.search(text) and not _TIME.match(words[0].partition("(")[0])
        return bool(_OF_A_VALUE.search(text) or beside or behind)
    return bool(_OF_A_VALUE.search(text.split(marks[0])[0]))


def _are_names(titles: list[Title], text: str, row: str) -> bool:
    """Return whether fields are names of columns, parted as numbers are, and not a sentence with a comma."""
    marks = set("\t;,") & set(text)
    if not marks or row and not marks & set(row):
        return False
    return not any(_PROSE.search(each.word) or len(each.word.split()) > _MOST_WORDS for each in titles)


_MOST_WORDS = 4  # of a title without a unit


def _said(name: str, lines: list[str], width: int) -> dict:
    """Return units that lines state in words: `units: cm/s2`, `times in ms`; one for every column, if there are as
    many. "beside": the unit in brackets behind the word acceleration, which may stand in a line of titles.
    """
    found: dict = {}
    for number, line in enumerate(lines, 1):
        begin = _SAID.search(line)
        if not begin:
            unit = "" if _COLUMN.match(_MARK.sub("", line.strip())) else _unit_beside(line)
            found["beside"] = [*found.get("beside", []), *([(number, unit)] if unit else [])]
            continue
        if _is_of_a_value(line[begin.end() :]) or "unit" in begin[0].lower() and _OTHER_QUANTITY.search(begin[0]):
            continue
        # "in cm/s2 and dt=0.01 sec": a value has its own unit
        rest = re.sub(rf"\w+\s*=\s*{NUMBER}(?:\s*[A-Za-z]\S*)?", "", line[begin.end() :])
        parts = [without_brackets(part) for part in re.split(r"[,;&\t]|\band\b", rest)]
        words = [
            word for part in parts for word in ([part] if is_any_unit(part) else map(without_brackets, part.split()))
        ]
        titles = [Title("", word) for word in words]
        if len(words) == width > 1 and _only_units(titles):
            found.setdefault("columns", (number, titles))
            continue
        known = list(dict.fromkeys(word for word in words if is_unit(word)))
        times = list(dict.fromkeys(word for word in words if is_seconds(word)))
        other = [word for word in words if word not in times and is_any_unit(word) and word.lower() not in SHORT]
        if len(known) == 1 or not known and other:
            _agree(
                name,
                found.setdefault("acceleration", (number, (known or other)[0])),
                (number, known[0] if known else ""),
            )
        if len(times) == 1 and (known or not other):
            found.setdefault("time", (number, times[0]))
    return found


def _unit_beside(line: str) -> str:
    """Return the unit in brackets behind the word acceleration: "Acceleration data (cm/s/s)"; or an empty text."""
    units = [text for each in BRACKETS.findall(line) for text in map(str.strip, each) if text and is_any_unit(text)]
    units = [unit for unit in units if not is_seconds(unit) and unit.lower() not in SHORT]
    found = _UNIT_OF_ACCELERATION.search(line)
    if not found or len(set(units)) != 1 or _EXTREME.search(line) or _BEHIND_UNIT.search(line):
        return ""
    first = BRACKETS.match(line, found.end())
    return units[0] if first and units[0] in map(str.strip, filter(None, first.groups())) else ""


def _agree(name: str, first: tuple[int, str], second: tuple[int, str]) -> None:
    """Refuse a header of which two lines state different units of acceleration."""
    if is_unit(first[1]) and second[1] and not same_unit(first[1], second[1]):
        raise file_error(name, f"line {first[0]} states the unit {first[1]!r}, but line {second[0]} {second[1]!r}.")


def _is_of_a_value(words: str) -> bool:
    """Return whether a unit is that of a value behind it, and says nothing of the columns."""
    found = _VALUED.match(words[:LONGEST_TITLE])
    # Without a sign between them, a number beside a unit of acceleration may be a factor.
    return found is not None and (is_any_unit if found[2] else is_seconds)(without_brackets(found[1]))


def _is_plain(titles: list[Title]) -> bool:
    """Return whether words that blanks part are titles, and not just as many as there are columns."""
    first = titles[0].word.lower()
    return first in _COUNTS | _SPECTRUM or all(_DIRECTION.fullmatch(each.word) for each in titles)


def _only_units(titles: list[Title]) -> bool:
    """Return whether a line holds nothing but units, and one of times or accelerations among them."""
    good = all(
        not each.word and (not each.unit or each.states_unit or OTHER_UNIT.fullmatch(each.unit)) for each in titles
    )
    return good and any(each.states_unit for each in titles)


def _parted(line: str, width: int) -> list[list[Title]]:
    """Split a line into titles, in all possible ways: titles hold blanks, and units in brackets."""
    marks = [mark for mark in "\t;," if mark in line]
    apart = [next(csv.reader([line], delimiter=mark, skipinitialspace=True)) for mark in marks[:2]]
    apart = [fields[: max((k for k, field in enumerate(fields, 1) if field.strip()), default=1)] for fields in apart]
    found = [[_title(field) for field in fields] for fields in apart]
    if width == 1:
        found.append([_title(line)])
    if not marks or marks == ["\t"]:
        words = line.split()
        plain = [Title("" if is_bare_unit(word) else word, word if is_bare_unit(word) else "") for word in words]
        bracketed = [_title(word) for word in words]
        # Without a separator, an ambiguous word is a unit only among units.
        found.append(plain if _only_units(plain) else [t if t.word else Title(w) for t, w in zip(bracketed, words)])
        for mark in (_BEHIND_BRACKETS, _NOT_BEFORE_BRACKETS):
            titles = [_title(field) for field in mark.split(line)]
            sure = titles[0].is_time or all(each.unit for each in titles)
            sure = sure and titles[0].states_unit and not titles[0].bare
            found += [titles] if sure and not _STATED.search(line) else []
    return found


def _title(field: str) -> Title:
    """Parse a field of a line of titles."""
    field = field.strip().strip("\"'").strip()[:LONGEST_TITLE]
    if not field:
        return Title()
    found = [(each, next((part for part in each.groups() if part), "").strip()) for each in BRACKETS.finditer(field)]
    found = [] if _BEHIND_UNIT.search(field) else found  # a value follows: no title
    known = [(each, text) for each, text in found if is_unit(text) or is_seconds(text)]
    other = [(each, text) for each, text in found if OTHER_UNIT.fullmatch(text) and not is_unit(text)]
    other = [(each, text) for each, text in other if not is_seconds(text) and text.lower() not in SHORT]
    stated = known + other
    if len({text for _, text in stated}) > 1:
        return Title(BRACKETS.sub(" ", field).strip(), _OR.join(text for _, text in stated))
    at_end = [(each, text) for each, text in found if each.end() == len(field)]
    for each, text in (stated or at_end)[:1]:
        return Title(f"{field[: each.start()].rstrip(' /')} {field[each.end() :]}".strip(), text)
    return _bare(field)


def _bare(field: str) -> Title:
    """Parse a title without brackets: `time_ms`, `t/ms`, `Acc in cm/s2`."""
    if is_bare_unit(field):
        return Title("", field, True)
    for mark in _BEFORE_BARE.finditer(field):
        word, unit = field[: mark.start()], field[mark.end() :]
        named = word and not _VALUE.search(word) and not _is_of_a_value(unit) and (word + unit).lower() != "ns"
        if named and (is_bare_unit(unit) or unit in ("G", "S") and re.fullmatch(r"acc\w*|t|time", word, re.IGNORECASE)):
            return Title(word, unit.replace("_", "/"), True)
    first, *within = field.split()
    unit = "" if _VALUE.search(field) else next((word for word in within if len(word) > 1 and is_unit(word)), "")
    return Title(" ".join([first, *(word for word in within if word != unit)]), unit, bool(unit))
