"""Read rocks and their observed outcomes from a CSV file.

The first line that is not a comment (#) names the columns, with their units; each other line holds a rock. The columns,
in any order:

- `name`: optional.
- `alpha_rad` or `alpha_deg`: slenderness angle; and `p_rad_per_s`, or `half_diagonal_m` of a rectangle (p = sqrt(3 g/4
  R), g = 9.81 m/s^2). Or, instead of both, `width_m` and `height_m`, full sizes of a rectangle.
- For rocks whose sides differ, in place of these: `alpha1_rad` and `alpha2_rad`, or `alpha1_deg` and `alpha2_deg`; with
  `p1_rad_per_s` and `p2_rad_per_s`, or `radius1_m` and `radius2_m`, the distances from the corners to the centre of
  mass. `inertia_ratio` is m R1^2/I1, optional; empty means 3/4, the value of a rectangle. `facing`, optional: 1 where
  positive ground acceleration drives the rock from side 1 to side 2, -1 for the other orientation; empty means unknown.
- `restitution`: optional; empty means Housner's value. For rocks whose sides differ it is the root of the product of
  both sides' values; empty means by angular momentum.
- `observed`: survived, toppled (stood, fell and similar words are accepted), or rotation (rocked). For a rotation,
  `rotation_rad` or `rotation_deg` holds the largest |rotation|; it is empty otherwise.
- `..._sd` of measured columns, such as `alpha_deg_sd`: standard deviation, in the same unit; empty means 0. A measured
  rotation needs one. Deviations of side 1 hold for both sides, which are off by the same factor.
"""

import csv
import difflib
from pathlib import Path
from typing import Any

import numpy as np

from jaxrock._arguments.annotations import path_of
from jaxrock._arguments.ranges import Range, size
from jaxrock._core.did_you_mean import did_you_mean
from jaxrock._core.text import check_end, file_error, text_lines
from jaxrock.blocks.asymmetric import AsymmetricBlock
from jaxrock.blocks.restitution import ratio_of_inertia
from jaxrock.blocks.rigid import GRAVITY
from jaxrock.inverse.observations import CALLED, SEEN, Observations, called

EXAMPLE = """\
# angles in degrees, sizes in metres; _sd: standard deviations; an empty field is not known
name,alpha_deg,alpha_deg_sd,half_diagonal_m,observed,rotation_deg,rotation_deg_sd
pedestal,9.2,0.5,0.45,toppled,,
slab,12.4,0.6,0.80,rocked,5.1,0.8
boulder,15.1,0.7,0.62,stood,,
column,18.0,0.5,1.10,stood,,
"""

_DEGREE = np.pi / 180
_LEAST_DEGREES = 0.5  # least slenderness in degrees; a smaller value is probably in radians

_FACTORS = {
    "alpha_rad": 1.0, "alpha_deg": _DEGREE, "p_rad_per_s": 1.0, "half_diagonal_m": 1.0, "width_m": 1.0, "height_m": 1.0,
    "restitution": 1.0, "rotation_rad": 1.0, "rotation_deg": _DEGREE, "alpha1_rad": 1.0, "alpha1_deg": _DEGREE,
    "p1_rad_per_s": 1.0, "radius1_m": 1.0,
}  # fmt: skip

_EXACT = {
    "alpha2_rad": 1.0, "alpha2_deg": _DEGREE, "p2_rad_per_s": 1.0, "radius2_m": 1.0, "inertia_ratio": 1.0, "facing": 1.0
}  # fmt: skip

_COLUMNS = {"name", "observed", *_FACTORS, *(f"{name}_sd" for name in _FACTORS), *_EXACT}

# A file must have exactly one column of each row of _WAYS, and both or none of each pair.
_WAYS = (
    ("alpha_rad", "alpha_deg", "width_m", "alpha1_rad", "alpha1_deg"),
    ("p_rad_per_s", "half_diagonal_m", "height_m", "p1_rad_per_s", "radius1_m"),
)

_PAIRS = (
    ("width_m", "height_m"), ("alpha1_rad", "alpha2_rad"), ("alpha1_deg", "alpha2_deg"),
    ("p1_rad_per_s", "p2_rad_per_s"), ("radius1_m", "radius2_m"),
)  # fmt: skip


def read_observations(path: str | Path) -> Observations:
    """Read rocks and their observed outcomes from a CSV file.

    **Arguments:**

    - `path`: of the file.

    The first line that is not a comment (#) names the columns, with their units; each other line holds a rock:

    - `name`: optional.
    - `alpha_rad` or `alpha_deg`, with `p_rad_per_s` or `half_diagonal_m` (of a rectangle); or `width_m` and `height_m`.
    - For rocks whose sides differ instead: `alpha1_rad` and `alpha2_rad` (or `_deg`), with `p1_rad_per_s` and
      `p2_rad_per_s`, or `radius1_m` and `radius2_m`; optional `inertia_ratio` (m R1^2/I1; empty means 3/4) and
      `facing` (1, -1; empty means unknown).
    - `restitution`: optional; empty means by angular momentum.
    - `observed`: survived (stood), toppled (fell), or rotation (rocked), which needs `rotation_rad` or `rotation_deg`.
    - `..._sd` of measured columns, such as `alpha_deg_sd`: standard deviation in the same unit; empty means 0. A
      rotation needs one; `alpha2`, `p2_rad_per_s`, `radius2_m`, `inertia_ratio` and `facing` have none.

    **Returns:** an `Observations`.

    **Raises:** ValueError, with the number of the line, for a malformed file or an impossible rock.
    """
    path = path_of("path", path)
    lines = text_lines(path)
    rows = [
        (number, [field.strip() for field in next(csv.reader([line]))])
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    rows = _without_empty_fields(rows)
    if rows:
        _check_comments(path.name, lines, *rows[0])
    if len(rows) < 2:
        raise file_error(path.name, "holds no rocks: it must have a line of column names, and one for each rock.")
    header = rows[0][1]
    _check_header(path.name, header)
    rocks = []
    for number, fields in rows[1:]:
        try:
            if len(fields) != len(header):
                raise ValueError(f"has {len(fields)} fields, but there are {len(header)} columns.")
            rock = _rock(dict(zip(header, fields)))
            _observations([rock])
        except ValueError as error:
            raise file_error(path.name, f"line {number}: {error}") from None
        rocks.append(rock)
    if header[-1] not in ("name", "observed"):
        check_end(path.name, lines, [fields[-1] for _, fields in rows[1:]])
    return _observations(rocks, [rock["name"] or f"line {number}" for rock, (number, _) in zip(rocks, rows[1:])])


def _without_empty_fields(rows: list[tuple[int, list[str]]]) -> list[tuple[int, list[str]]]:
    """Return rows without the empty columns and rows that spreadsheets write at the end of a table."""
    while rows and not any(rows[-1][1]):
        rows = rows[:-1]
    width = max((place for place, field in enumerate(rows[0][1], 1) if field), default=0) if rows else 0
    return [(line, fields if any(fields[width:]) else fields[:width]) for line, fields in rows]


def _observations(rocks: list[dict], names: list[str] | None = None) -> Observations:
    def column(name):
        return [rock[name] for rock in rocks]

    known = ("alpha_sd", "p_sd", "restitution_sd", "rotation", "rotation_sd")
    rest = (column("observed"), column("restitution")), {name: column(name) for name in known} | {"names": names}
    if "alpha2" not in rocks[0]:
        return Observations(column("alpha"), column("p"), *rest[0], **rest[1])
    names = ("alpha", "alpha2", "p", "inertia_ratio", "radius_ratio")
    alpha1, alpha2, p1, inertia_ratio, radius_ratio = (np.array(column(name)) for name in names)
    blocks = AsymmetricBlock(alpha1, alpha2, p1, inertia_ratio, radius_ratio)
    return Observations.asymmetric(blocks, *rest[0], facing=column("facing"), **rest[1])


def _check_comments(file: str, lines: list[str], first: int, header: list[str]) -> None:
    """Raise ValueError if a comment after the header, in line `first`, looks like a rock."""
    for number, line in enumerate(lines[first:], first + 1):
        if line.lstrip().startswith("#") and len(next(csv.reader([line]))) == len(header):
            said = "looks like a rock, but a line that begins with # is a comment; put its name in another way."
            raise file_error(file, f"line {number}: {said}")


def _check_header(file: str, header: list[str]) -> None:
    for mark, kind in {";": "semicolons", "\t": "tabs"}.items():
        if len(header) == 1 and mark in header[0]:
            raise file_error(file, f"must separate its fields by commas, not by {kind}.")
    unknown = [name for name in header if name not in _COLUMNS]
    if unknown:
        near = difflib.get_close_matches(unknown[0], sorted(_COLUMNS), n=3, cutoff=0.5)
        rest = f"the nearest that is known: {', '.join(near)}" if near else f"known are {', '.join(sorted(_COLUMNS))}"
        raise file_error(file, f"has a column `{unknown[0]}`; {rest}.")
    twice = [name for name in header if header.count(name) > 1]
    if twice:
        raise file_error(file, f"has the column `{twice[0]}` twice.")
    if "observed" not in header:
        raise file_error(file, f"has no column `observed` ({', '.join(SEEN)}).")
    for name in header:
        if name.endswith("_sd") and name.removesuffix("_sd") not in header:
            raise file_error(file, f"has a column `{name}`, but no column `{name.removesuffix('_sd')}`.")
    _check_shapes(file, set(header))


def _check_shapes(file: str, header: set[str]) -> None:
    """Raise ValueError unless each measure has one column, and each measure of two sides both."""
    for way in _WAYS:
        if len(header.intersection(way)) != 1:
            raise file_error(file, f"must have one of the columns {', '.join(way)}, and only one.")
    if header.issuperset(("rotation_rad", "rotation_deg")):
        raise file_error(file, "must have one of the columns rotation_rad, rotation_deg, and not both.")
    for pair in _PAIRS:
        if len(header.intersection(pair)) == 1:
            raise file_error(file, f"must have both columns {pair[0]} and {pair[1]}, or none of them.")
    two_sides = [bool(header.intersection(way[3:])) for way in _WAYS]
    if two_sides[0] != two_sides[1]:
        raise file_error(file, "must have columns of both sides (1 and 2) for angles and sizes alike.")
    for name in header.intersection(("facing", "inertia_ratio")):
        if not two_sides[0]:
            raise file_error(file, f"has a column `{name}`, which is for rocks whose sides differ (alpha1, alpha2).")


def _rock(fields: dict[str, str]) -> dict:
    """Return a rock from the fields of its line."""
    values = {name: _number(name, fields.get(name, "")) for name in fields if name not in ("name", "observed")}

    def get(name, empty):
        """Return the value of a column, in any of its units, in rad where angular; and its standard deviation."""
        for unit in (name, f"{name}_rad", f"{name}_deg"):
            if unit in fields:
                value, sd = values[unit], values.get(f"{unit}_sd")
                factor = (_FACTORS | _EXACT)[unit]
                return empty if value is None else value * factor, (sd or 0.0) * factor
        return empty, 0.0

    _check_degrees(values)
    if called(fields["observed"]) is None:
        said = fields["observed"]
        raise ValueError(f"`observed` must be one of {', '.join(SEEN)}, but is {said!r}.{did_you_mean(said, CALLED)}")
    rock: dict[str, Any] = {"name": fields.get("name", ""), "observed": called(fields["observed"])}
    if "width_m" in fields:
        rock |= _rectangle(*(_given(name, get(name, None)) for name in ("width_m", "height_m")))
    elif "alpha1_rad" in fields or "alpha1_deg" in fields:
        rock |= _two_sides(fields, get)
    else:
        rock["alpha"], rock["alpha_sd"] = _given("alpha", get("alpha", None))
        rock |= _size(fields, get)
    rock["restitution"], rock["restitution_sd"] = get("restitution", np.nan)
    rock["rotation"], rock["rotation_sd"] = _rotation(fields["observed"], get)
    return rock


def _check_degrees(values: dict[str, float | None]) -> None:
    """Raise ValueError if a slenderness in degrees is so small that it must be in radians."""
    for name in ("alpha_deg", "alpha1_deg", "alpha2_deg"):
        value = values.get(name)
        if value is not None and 0 < value < _LEAST_DEGREES:
            said = f"must be {_LEAST_DEGREES} or more, in degrees, but is {value:g}"
            raise ValueError(f"`{name}` {said}; of radians the column is `{name.replace('deg', 'rad')}`.")


def _rotation(observed: str, get) -> tuple[float, float]:
    """Return the measured rotation and its standard deviation; both are 1 if none was measured."""
    rotation, deviation = get("rotation", None)
    measured = called(observed) == "rotation"
    if measured and (rotation is None or deviation <= 0):
        raise ValueError("a measured rotation needs a value and a standard deviation.")
    if not measured and rotation is not None:
        said = f"`observed` is {observed!r}, but a rotation is given"
        raise ValueError(f"{said}: call it rocked, or leave the rotation empty.")
    return (rotation, deviation) if measured else (1.0, 1.0)


def _size(fields: dict[str, str], get) -> dict:
    """Return the frequency parameter and its standard deviation."""
    if "p_rad_per_s" in fields:
        p, deviation = _given("p_rad_per_s", get("p_rad_per_s", None))
        return {"p": p, "p_sd": deviation}
    radius, deviation = _positive("half_diagonal_m", _given("half_diagonal_m", get("half_diagonal_m", None)))
    p = np.sqrt(3 * GRAVITY / (4 * radius))
    return {"p": p, "p_sd": p * deviation / (2 * radius)}


def _two_sides(fields: dict[str, str], get) -> dict:
    """Return angles and sizes of a rock whose sides differ; deviations are those of side 1."""
    (alpha1, deviation), (alpha2, _) = (_given(name, get(name, None)) for name in ("alpha1", "alpha2"))
    facing, inertia = (get(name, empty)[0] for name, empty in (("facing", 0.0), ("inertia_ratio", 0.75)))
    _within(ratio_of_inertia, "inertia_ratio", inertia)
    rock = {"alpha": alpha1, "alpha_sd": deviation, "alpha2": alpha2, "inertia_ratio": inertia, "facing": facing}
    if "p1_rad_per_s" in fields:
        (p1, p_sd), (p2, _) = (_given(name, get(name, None)) for name in ("p1_rad_per_s", "p2_rad_per_s"))
        block = AsymmetricBlock.from_frequencies(alpha1, alpha2, p1, p2, inertia)
        return rock | {"p": p1, "p_sd": p_sd, "radius_ratio": float(block.radius_ratio)}
    first, second = (_positive(name, _given(name, get(name, None))) for name in ("radius1_m", "radius2_m"))
    p1 = np.sqrt(inertia * GRAVITY / first[0])
    return rock | {"p": p1, "p_sd": p1 * first[1] / (2 * first[0]), "radius_ratio": second[0] / first[0]}


def _rectangle(width: tuple[float, float], height: tuple[float, float]) -> dict:
    """Return slenderness and frequency parameter of a rectangle, with standard deviations to first order."""
    (b, b_sd), (h, h_sd) = _positive("width_m", width), _positive("height_m", height)
    square = b**2 + h**2
    p = np.sqrt(3 * GRAVITY / (2 * np.sqrt(square)))
    return {
        "alpha": np.arctan2(b, h),
        "alpha_sd": np.hypot(h * b_sd, b * h_sd) / square,
        "p": p,
        "p_sd": p * np.hypot(b * b_sd, h * h_sd) / (2 * square),
    }


def _positive(name: str, pair: tuple[float, float]) -> tuple[float, float]:
    return _within(size, name, pair[0]), pair[1]


def _within(allowed: Range, name: str, value: float) -> float:
    if not allowed.holds(value):
        raise ValueError(f"`{name}` must {allowed.allowed}, but is {value:g}.")
    return value


def _given(name: str, pair: tuple) -> tuple[float, float]:
    if pair[0] is None:
        raise ValueError(f"`{name}` is empty.")
    return pair


def _number(name: str, text: str) -> float | None:
    if not text:
        return None
    try:
        if "_" in text:  # `float` accepts underscores between digits
            raise ValueError
        value = float(text)
    except ValueError:
        raise ValueError(f"`{name}` must be a number, but is {text!r}.") from None
    if not np.isfinite(value):
        raise ValueError(f"`{name}` must be a finite number, but is {text!r}; an empty field is not known.")
    if name.endswith("_sd") and value < 0:
        raise ValueError(f"`{name}` must be 0 or more, but is {value:g}.")
    return value
