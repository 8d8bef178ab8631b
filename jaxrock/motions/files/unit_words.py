"""Words that are units: of accelerations and times, and others, which are refused by what they are."""

import re

from jaxrock.motions.files.parsing import is_unit, unit_named

LONGEST_TITLE = 300  # characters
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
OTHER_UNIT = re.compile(
    rf"{_SURE}|.*(/|\bper\b)\s*s(ec(onds?)?)?(/s(ec)?|[\^*]*[2²])?|.*\bs(ec)?\^?[-−⁻][12²]", re.IGNORECASE
)
_OTHER_BARE = re.compile(rf"(?=[^\W\d]|%)(?:{_SURE})", re.IGNORECASE)
SECONDS = (
    dict.fromkeys(["s", "sec", "secs", "second", "seconds"], 1.0)
    | dict.fromkeys(["ms", "msec", "msecs", "millisecond", "milliseconds"], 1e-3)
    | dict.fromkeys(["us", "µs", "μs", "usec", "microsecond", "microseconds"], 1e-6)
    | dict.fromkeys(["min", "minute", "minutes"], 60.0)
)
BRACKETS = re.compile(r"\[([^\[\]]*)\]|\(((?:[^()]|\([^()]*\))*)\)|\{([^{}]*)\}|<([^<>]*)>")
SHORT = {"m", "v", "in"}  # other units that are also words or directions, where no brackets surround them


def is_seconds(unit: str) -> bool:
    """Return whether a word is a unit of time."""
    return unit.lower().rstrip(".") in SECONDS


def same_unit(one: str, other: str) -> bool:
    """Return whether two spellings are of one unit."""
    return is_unit(one) and unit_named(one) == unit_named(other)


def is_any_unit(word: str) -> bool:
    """Return whether a word is a unit, of whatever."""
    return is_unit(word) or is_seconds(word) or bool(OTHER_UNIT.fullmatch(word[:LONGEST_TITLE]))


def without_brackets(text: str) -> str:
    """Return a unit without brackets around it."""
    text = text.strip(" .:\"'")
    found = BRACKETS.fullmatch(text)
    return next((part for part in found.groups() if part), "").strip() if found else text


def is_bare_unit(text: str) -> bool:
    """Return whether a word without brackets is a unit, beyond doubt."""
    text = text.replace("_", "/")
    if len(text) == 1:
        return text in "gs"  # G and S may be names
    return is_unit(text) or is_seconds(text) or bool(_OTHER_BARE.fullmatch(text)) and text.lower() not in SHORT
