"""V3, the CSMIP format for response spectra, which agencies publish beside accelerograms; it holds no accelerogram."""

import os
import re
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxrock._arguments.annotations import arguments, at_least, path_of
from jaxrock._core.text import file_error, text_lines
from jaxrock.motions.files.cosmos import is_spectra
from jaxrock.motions.files.csmip import told
from jaxrock.motions.files.headers import chosen_channel, places_of
from jaxrock.motions.files.parsing import NUMBER, announced_columns, fixed_numbers
from jaxrock.motions.record import Origin

_FIRST = re.compile(r"^\s*RESPONSE AND FOURIER AMPLITUDE SPECTRA\s*\(\s*(\d+)\s+PERIODS", re.IGNORECASE)
_UNITS = re.compile(r"UNITS FOR SPECTRA ARE (\w+) AND SEC\w*,\s+EXCEPT SA\b.*\bG\b", re.IGNORECASE)
_FOURIER = re.compile(r"^\s*FOURIER AMPLITUDE SPECTRA\b", re.IGNORECASE)
_DAMPING = re.compile(rf"^\s*DAMPING\s*=\s*({NUMBER})\s*\.\s*DATA OF SD,\s*SV,\s*SA,\s*PSSV,\s*TT", re.IGNORECASE)
_END = re.compile(r"^\s*/&.*END OF", re.IGNORECASE)
_LENGTHS = {"inches": 0.0254, "in": 0.0254, "cm": 0.01}  # m
_WIDTH, _ROOM, _ROWS = 10, 100, 13  # characters of a number, numbers of a padded list, lines they take
_KINDS = 7  # lists for each damping: four spectra, and the times of three


class ResponseSpectra(NamedTuple):
    """Response spectra of one component, as an agency published them.

    - `period`: (periods,) [s]; `damping`: (dampings,) over critical.
    - `displacement` [m], `velocity` [m/s]: (dampings, periods) peaks relative to the ground; `acceleration` [g]: of the
      oscillator itself; `pseudo_velocity` [m/s]: 2 pi displacement/period.
    - `name`, `origin`: as those of a `Record`.
    """

    period: Float[np.ndarray, " periods"]
    damping: Float[np.ndarray, " dampings"]
    displacement: Float[np.ndarray, "dampings periods"]
    velocity: Float[np.ndarray, "dampings periods"]
    acceleration: Float[np.ndarray, "dampings periods"]
    pseudo_velocity: Float[np.ndarray, "dampings periods"]
    name: str
    origin: Origin


@arguments
def read_spectra(path: str | os.PathLike, channel: Annotated[int, at_least(0)] = 0) -> ResponseSpectra:
    """Read response spectra from a V3 file of CSMIP.

    **Arguments:**

    - `path`: the file.
    - `channel`: which of its channels, counted from 0.

    **Returns:** a `ResponseSpectra`, to three digits, to compare with `intensity.spectral_velocity` of a record.

    **Raises:** OSError if the file cannot be opened; ValueError, with file and line, for one that is damaged or cut
    short, or whose pseudo-velocities are not those of its displacements. ValueError for a file that is no V3 file of
    CSMIP; the message names COSMOS's as such.
    """
    path = path_of("path", path)
    name, lines = path.name, text_lines(path)
    starts = places_of(_FIRST, lines)
    if is_spectra(lines):
        raise file_error(
            name, "is a V3 file of COSMOS; only CSMIP's are read. `intensity` makes spectra of its V2 file."
        )
    if not starts:
        raise file_error(name, "no line begins with 'Response and Fourier amplitude spectra', as a V3 file must.")
    channel = chosen_channel(name, "V3", channel, len(starts))
    end = (*starts[1:], len(lines))[channel]
    return _of_channel(name, lines[:end], starts[channel])


def _said(pattern: re.Pattern, line: str) -> re.Match:
    """Return the match of a line that is known to match."""
    found = pattern.match(line)
    assert found is not None
    return found


def _of_channel(name: str, lines: list[str], start: int) -> ResponseSpectra:
    count = int(_said(_FIRST, lines[start])[1])
    fourier = next((row for row in range(start, len(lines)) if _FOURIER.match(lines[row])), None)
    unit = next((m[1] for line in lines[start:fourier] if (m := _UNITS.search(line))), "")
    if fourier is None or unit.lower() not in _LENGTHS or not 0 < count <= _ROOM:
        raise file_error(
            name, "header must state 1 to 100 periods, units of inches or cm, and Sa in g, as a V3 file's."
        )
    period = announced_columns(name, lines[:fourier], fourier - _ROWS, _ROOM, _WIDTH, "periods and their room")
    stated = fixed_numbers(lines[fourier - _ROWS - 1], _WIDTH) or []
    _check_room(name, period, count)
    if not (np.diff(period[:count], prepend=0.0) > 0).all():
        raise file_error(name, f"the {count} periods before line {fourier + 1} do not increase.")
    found = [row for row in range(fourier, len(lines)) if _DAMPING.match(lines[row])]
    said = [float(_said(_DAMPING, lines[row])[1]) for row in found]
    if len(said) != len(stated) or not np.allclose(said, stated, atol=0.0051):
        raise file_error(name, f"header states dampings {stated}, but spectra follow for {said}.")
    last = found[-1] + 1 + _KINDS * _ROWS
    if last >= len(lines) or not _END.match(lines[last]):
        raise file_error(name, f"line {last + 1} should end the channel: the file is cut off, or holds more.")
    lists = np.stack([_lists(name, lines, row + 1, count) for row in found])
    length = _LENGTHS[unit.lower()]
    place, speed, acceleration, pseudo = np.moveaxis(lists[:, :4], 1, 0)
    off = np.abs(pseudo - 2 * np.pi * place / period[:count]) > 0.015 * pseudo
    if off.any():
        worst = period[:count][off.any(axis=0)][0]
        raise file_error(name, f"its pseudo-velocity at {worst:g} s is not that of its displacement.")
    title, origin = told(lines[start : fourier - 2 * _ROWS], _FIRST.pattern, (3, 7, 8))
    origin = origin._replace(format="v3", unit=unit, file=name)
    spectra = length * place, length * speed, acceleration, length * pseudo
    return ResponseSpectra(period[:count], np.array(stated), *spectra, title or name, origin)


def _lists(name: str, lines: list[str], start: int, count: int) -> np.ndarray:
    """Return the lists of one damping, (7, periods), without their padding."""
    block = lines[: start + _KINDS * _ROWS]
    values = announced_columns(name, block, start, _KINDS * _ROOM, _WIDTH, "spectral values and their room")
    lists = values.reshape(_KINDS, _ROOM)
    _check_room(name, lists, count)
    return lists[:, :count]


def _check_room(name: str, values: np.ndarray, count: int) -> None:
    """Check that lists are zero beyond the periods, and nowhere negative."""
    if values[..., count:].any() or (values < 0).any():
        raise file_error(name, f"announces {count} periods, but the numbers of a list go on, or are below 0.")
