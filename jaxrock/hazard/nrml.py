"""Fragilities as NRML, the natural hazards' risk markup language that the OpenQuake engine reads."""

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping

import numpy as np

from jaxrock._arguments.annotations import arguments, path_of
from jaxrock._core.arrays import shown
from jaxrock._core.atomic_files import written_atomically
from jaxrock.hazard.fragility import LogNormalFragility, TabulatedFragility, check_measure
from jaxrock.hazard.openquake import units_of_openquake

_SPACE = "http://openquake.org/xmlns/nrml/0.5"


@arguments
def write_nrml(
    fragilities: Mapping[str, LogNormalFragility | TabulatedFragility],
    path: str | os.PathLike,
    measure: str = "PGA",
    *,
    taxonomy: str = "block",
    description: str = "Rocking block",
) -> None:
    """Write the fragilities of one object for OpenQuake: NRML 0.5, a `fragilityModel`.

    **Arguments:**

    - `fragilities`: by the names of their limit states, from slight to severe: all `LogNormalFragility`, or all
      `TabulatedFragility` of the same levels.
    - `path`: the file; an existing one is replaced.
    - `measure`: OpenQuake's name of it, such as "PGA" [g], "IA" [m/s] or "SA(0.5)" [g]. For "PGV" and "CAV" [m/s] and
      "PGD" [m] the file is in OpenQuake's units: cm/s, g s and cm. OpenQuake has no "SV(0.5)".
    - `taxonomy`, `description`: of the object.

    OpenQuake interpolates linearly between the levels of a table, `TabulatedFragility` linearly in their logarithms.
    The two differ between levels far apart.

    **Raises:** ValueError for fragilities that do not go together, or of another measure, or spectral velocities;
    OSError if the file cannot be written.
    """
    if measure.startswith("SV("):
        raise ValueError(f"Argument `measure` must be one that OpenQuake knows, as SA, but is {measure!r}.")
    good = isinstance(fragilities, Mapping) and fragilities and all(isinstance(name, str) for name in fragilities)
    kinds = {type(each) for each in fragilities.values()} if good else set()
    if kinds not in ({LogNormalFragility}, {TabulatedFragility}):
        raise ValueError(
            "Argument `fragilities` must hold fragilities by name, all lognormal or all tabulated, but is "
            f"{shown(fragilities)}."
        )
    for each in fragilities.values():
        check_measure("measure", measure, each)
    fragilities = {name: _in_unit(each, units_of_openquake(measure)) for name, each in fragilities.items()}
    root = ElementTree.Element("nrml", xmlns=_SPACE)
    model = ElementTree.SubElement(
        root, "fragilityModel", id="jaxrock", assetCategory="contents", lossCategory="contents"
    )
    ElementTree.SubElement(model, "description").text = description
    ElementTree.SubElement(model, "limitStates").text = " ".join(name.replace(" ", "_") for name in fragilities)
    (_continuous if kinds == {LogNormalFragility} else _discrete)(model, fragilities, measure, taxonomy)
    ElementTree.indent(root)
    with written_atomically(path_of("path", path), replace=True) as aside:
        ElementTree.ElementTree(root).write(aside, encoding="utf-8", xml_declaration=True)


def _in_unit(fragility: LogNormalFragility | TabulatedFragility, factor: float):
    """Return the fragility with its intensities multiplied by a factor."""
    if isinstance(fragility, LogNormalFragility):
        return LogNormalFragility(factor * fragility.median, fragility.dispersion)
    return TabulatedFragility(factor * fragility.levels, fragility.probabilities)


def _continuous(model, fragilities: Mapping, measure: str, taxonomy: str) -> None:
    function = ElementTree.SubElement(model, "fragilityFunction", id=taxonomy, format="continuous", shape="logncdf")
    ends = [np.ravel([each.knots[0], each.knots[-1]]) for each in fragilities.values()]
    low, high = (f"{end:.10g}" for end in (np.min(ends), np.max(ends)))
    ElementTree.SubElement(function, "imls", imt=measure, noDamageLimit=low, minIML=low, maxIML=high)
    for name, each in fragilities.items():
        median, dispersion = (float(np.reshape(x, ())) for x in (each.median, each.dispersion))
        mean = median * np.exp(dispersion**2 / 2)  # NRML states moments of the intensity, not of its logarithm
        spread = mean * np.sqrt(np.expm1(dispersion**2))
        ElementTree.SubElement(
            function, "params", ls=name.replace(" ", "_"), mean=f"{mean:.12g}", stddev=f"{spread:.12g}"
        )


def _discrete(model, fragilities: Mapping, measure: str, taxonomy: str) -> None:
    levels = [np.asarray(each.levels) for each in fragilities.values()]
    if any(each.ndim > 1 or not np.array_equal(each, levels[0]) for each in levels):
        raise ValueError("Argument `fragilities` must hold tables of the same levels.")
    function = ElementTree.SubElement(model, "fragilityFunction", id=taxonomy, format="discrete")
    limits = ElementTree.SubElement(function, "imls", imt=measure, noDamageLimit=f"{levels[0][0]:.10g}")
    limits.text = " ".join(f"{level:.10g}" for level in levels[0])
    for name, each in fragilities.items():
        shares = ElementTree.SubElement(function, "poes", ls=name.replace(" ", "_"))
        shares.text = " ".join(f"{share:.10g}" for share in np.asarray(each.probabilities))
