"""Hazard curves from files that the OpenQuake engine writes."""

import csv
import os
import re
from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Array, Inexact

from jaxrock._arguments.annotations import arguments, list_of, path_of
from jaxrock._arguments.ranges import whole
from jaxrock._arguments.repr import described
from jaxrock._core.arrays import is_traced, to_device
from jaxrock._core.text import check_end, file_error, text_lines
from jaxrock.blocks.rigid import GRAVITY
from jaxrock.hazard.curves import HazardCurve

_FRONT = {"custom_site_id", "lon", "lat", "depth"}
_POE = "poe-"
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[Ee][-+]?\d+)?")
_TIME = re.compile(r"\binvestigation_time=([^,\s\"']+)")

# imt='SA(0.1)' today, imt="SA(0.1)" or imt=SA(0.1) in older files.
_MEASURE = re.compile(r"\bimt=(?:'([^']*)'|\"+([^\"]*)\"+|([^\s,\"']+))")
_KIND = re.compile(r"\bkind='([^']*)'")

# Older files, without kind=: "# quantile-0.1, investigation_time=...", "# source_model_tree_path=('b1',), gsim_...".
_OLD_KIND = re.compile(r"#[\s,\"]*(.*?)[\s,]*\binvestigation_time=")

# Units of OpenQuake in one of ours, where they differ: its PGV are in cm/s, PGD in cm, and CAV in g s.
_OF_OURS = {"PGV": 100.0, "PGD": 100.0, "CAV": 1 / GRAVITY}

# OpenQuake computes probabilities in single precision from many sources, so that equal ones may differ slightly.
_NOISE = 1e-5, 3e-7


class HazardCurves(eqx.Module):
    """Hazard curves of sites under one or more branches of a logic tree, as read from files.

    - `curves`: a `HazardCurve` with arrays of shape (branches, sites, levels), in g for PGA and SA, in m/s for PGV and
      CAV, in m for PGD (of which files have cm/s, g s and cm), and in the unit of the files for others.
    - `longitude`, `latitude`: (sites,) [degrees].
    - `depth`: (sites,) below sea level [km]; 0 where a file has none.
    - `kinds`: the kind of each branch as stated in its file, such as "mean", "rlz-000", "quantile-0.5".
    - `names`: of the sites; empty strings where they have none.
    """

    __repr__ = described

    curves: HazardCurve
    longitude: Inexact[Array, " sites"]
    latitude: Inexact[Array, " sites"]
    depth: Inexact[Array, " sites"]
    kinds: tuple[str, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @arguments
    def at(self, site: int, branch: int | None = None) -> HazardCurve:
        """Return the curve of one site, in the order of the files.

        **Arguments:**

        - `site`: from 0.
        - `branch`: from 0, in the order of `kinds`. None: all, for use under `jax.vmap`.

        **Returns:** a `HazardCurve` with arrays of shape (levels,), or (branches, levels).

        **Raises:** ValueError for a site or branch that does not exist.
        """
        for name, index, count in (("site", site, len(self.names)), ("branch", branch or 0, len(self.kinds))):
            whole(name, index, 0, count - 1)
        rows = slice(None) if branch is None else branch
        curves = self.curves
        levels, rates = (x if is_traced(x) else np.asarray(x) for x in (curves.levels, curves.rates))
        return HazardCurve(levels[rows, site], rates[rows, site], curves.measure)


def read_hazard_curves(paths: str | os.PathLike | Sequence[str | os.PathLike]) -> HazardCurves:
    """Read hazard curves as the OpenQuake engine exports them (`hazard_curve-*.csv`).

    Such a file has a comment (kind, investigation_time, imt), a header (lon, lat, depth, poe-0.005, ...), and for each
    site the probabilities that the levels are exceeded within the investigation time. Where rounding printed a
    probability as 1 or 0, the rate is not known (see `HazardCurve`); where noise of single precision makes
    probabilities rise by less than 1e-5 of them (or 3e-7), they are levelled.

    **Arguments:**

    - `paths`: the file, or the files of several branches (realisations, quantiles), of one measure, with the same
      sites and levels.

    **Returns:** `HazardCurves`.

    **Raises:** OSError if a file cannot be opened; ValueError, with file and line, for one that is empty, binary,
    damaged or holds something else, or differs from the first in measure, levels or sites.

    **Source:** the exporters of the OpenQuake engine and the results that its tests expect, 2017 to release 3.26.
    """
    paths = [paths] if isinstance(paths, str | os.PathLike) else list_of(object, "paths")("paths", paths)
    if not paths:
        raise ValueError("Argument `paths` must be a file or a list of files, but is empty.")
    found = [path_of("paths", path) for path in paths]
    files = [_read(path) for path in found]
    first = files[0]
    for path, file in zip(found, files):
        for what in ("measure", "levels", "names", "positions"):
            if not np.array_equal(file[what], first[what]):
                which = "sites" if what in ("names", "positions") else what
                raise file_error(path.name, f"differs in its {which} from file `{found[0].name}`.")
    rates = np.stack([file["rates"] for file in files])
    levels = first["levels"] / units_of_openquake(first["measure"])
    curves = HazardCurve(np.broadcast_to(levels, rates.shape), rates, first["measure"])
    kinds = tuple(file["kind"] for file in files)
    longitude, latitude, depth = to_device(list(np.asarray(first["positions"]).T))
    return HazardCurves(curves, longitude, latitude, depth, kinds=kinds, names=tuple(first["names"]))


def units_of_openquake(measure: str) -> float:
    """Return the number of OpenQuake's units of a measure in one unit of this package."""
    return _OF_OURS.get(measure, 1.0)


def _read(path: Path) -> dict:
    """Read one file; return its kind, measure and levels, and names, positions and rates of its sites."""
    name, lines = path.name, text_lines(path)
    time, measure, kind = _comment(name, lines[0])
    columns = next(csv.reader(lines[1:2]), [])
    levels = _levels(name, columns)
    front = columns[: -levels.size]
    names, positions, probabilities, printed = [], [], [], []
    for number, line in enumerate(lines[2:], 3):
        if not line.strip():
            continue
        fields = next(csv.reader([line]))
        if len(fields) != len(columns):
            raise file_error(name, f"line {number} has {len(fields)} columns, but the header has {len(columns)}.")
        site = dict(zip(front, fields))
        names.append(site.pop("custom_site_id", ""))
        positions.append(_numbers(name, number, [site["lon"], site["lat"], site.get("depth", "0")]))
        printed.append(fields[-1])
        probabilities.append(_falling(name, number, _numbers(name, number, fields[len(front) :])))
    if names:
        check_end(name, lines, printed)
    else:
        raise file_error(name, "holds no sites.")
    with np.errstate(divide="ignore"):
        rates = -np.log1p(-np.array(probabilities)) / time
    return {
        "kind": kind,
        "measure": measure,
        "levels": levels,
        "names": names,
        "positions": np.array(positions),
        "rates": rates,
    }


def _comment(name: str, line: str) -> tuple[float, str, str]:
    """Return investigation time [years], measure and kind, from the first line."""
    time, measure, kind = _TIME.search(line), _MEASURE.search(line), _KIND.search(line) or _OLD_KIND.match(line)
    if not line.startswith("#") or not time or not measure or not kind:
        expected = "a comment that states investigation_time and imt, as of hazard curves by OpenQuake"
        raise file_error(name, f"line 1 should be {expected}, but is {line[:60]!r}.")
    if not _NUMBER.fullmatch(time[1]) or not 0 < float(time[1]) < np.inf:
        raise file_error(name, f"line 1 states an investigation time of {time[1]!r}, which is not a positive number.")
    return float(time[1]), next(filter(None, measure.groups())), kind[1]


def _levels(name: str, columns: list[str]) -> np.ndarray:
    """Return the levels in the header."""
    front = [column for column in columns if not column.startswith(_POE)]
    if columns[: len(front)] != front or not {"lon", "lat"} <= set(front) <= _FRONT:
        expected = "name the columns of hazard curves: lon, lat, depth, poe-0.005 and so on"
        raise file_error(name, f"line 2 should {expected}, but is {','.join(columns)[:60]!r}.")
    levels = _numbers(name, 2, [column.removeprefix(_POE) for column in columns[len(front) :]])
    if levels.size < 2 or levels[0] <= 0 or (np.diff(levels) <= 0).any():
        raise file_error(name, "line 2 should hold at least two levels that are positive and rise.")
    return levels


def _numbers(name: str, number: int, fields: list[str]) -> np.ndarray:
    for field in fields:
        if not _NUMBER.fullmatch(field.strip()) or not np.isfinite(float(field)):
            raise file_error(name, f"line {number} holds {field[:60]!r}, which is not a finite number.")
    return np.array([float(field) for field in fields])


def _falling(name: str, number: int, probabilities: np.ndarray) -> np.ndarray:
    """Return probabilities that never rise, after levelling small rises that are rounding."""
    if (probabilities < 0).any() or (probabilities > 1).any():
        raise file_error(name, f"line {number} holds a probability that is not in [0, 1].")
    levelled = np.minimum.accumulate(probabilities)
    relative, absolute = _NOISE
    if (probabilities > levelled * (1 + relative) + absolute).any():
        raise file_error(name, f"line {number} holds probabilities that rise with the level.")
    if levelled[0] == 1 and not ((levelled > 0) & (levelled < 1)).any():
        raise file_error(name, f"line {number} holds no probability between 0 and 1, so that no rate is known.")
    return levelled
