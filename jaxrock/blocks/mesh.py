"""Surface meshes, which trimesh reads; trimesh is imported only when a file is read."""

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxrock._arguments.annotations import path_of
from jaxrock._core.arrays import shown
from jaxrock._core.precision import frames_of_the_package
from jaxrock._core.regular_files import open_regular
from jaxrock.blocks.rigid import LENGTHS

_METRES = LENGTHS | {
    "meter": 1.0, "metre": 1.0, "kilometer": 1000.0, "kilometre": 1000.0, "km": 1000.0, "decimeter": 0.1,
    "decimetre": 0.1, "dm": 0.1, "centimeter": 0.01, "centimetre": 0.01, "millimeter": 0.001, "millimetre": 0.001,
    "micrometer": 1e-6, "micrometre": 1e-6, "micron": 1e-6, "inch": 0.0254, "inches": 0.0254, "in": 0.0254, '"': 0.0254,
    "foot": 0.3048, "feet": 0.3048, "ft": 0.3048, "'": 0.3048, "yard": 0.9144, "yd": 0.9144,
}  # fmt: skip
_SAME = 1e-6  # relative difference of two units that are one, but for their digits
_COARSE = 1e-3  # share of the smallest extent to which coordinates may be rounded without a warning


def trimesh_of(mesh: Any) -> Any:
    """Return a trimesh mesh from a mesh, a scene or the path of a file."""
    if isinstance(mesh, (str, os.PathLike)):
        return _read(path_of("mesh", mesh))
    if hasattr(mesh, "geometry") and hasattr(mesh, "to_mesh"):  # a scene, which trimesh makes of some files
        return mesh.to_mesh()
    if not (hasattr(mesh, "vertices") and hasattr(mesh, "units")):
        raise ValueError(f"Argument `mesh` must be a mesh of trimesh, or the path of a file, but is {shown(mesh)}.")
    return mesh


def _read(path: Path) -> Any:
    """Return the mesh of a file with the vertices as they stand there, or whatever a file without faces holds."""
    try:
        import trimesh
    except ImportError as error:
        raise ImportError('Reading a mesh needs trimesh: pip install "jaxrock[mesh]".') from error
    with open_regular(path):  # raises the same errors as for any other file
        pass
    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
        return mesh if len(mesh.faces) else trimesh.load(path, process=False)
    except ImportError as error:
        raise ImportError(f"File `{path.name}`: trimesh needs another package to read it ({error}).") from error
    except Exception as error:
        raise ValueError(f"File `{path.name}`: trimesh does not read it ({type(error).__name__}: {error}).") from error


def triangles_of(mesh: Any) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Return the vertices of a trimesh mesh, and the numbers of those of every face."""
    faces = np.asarray(getattr(mesh, "faces", ()), int).reshape(-1, 3)
    if not len(faces):
        points = len(getattr(mesh, "vertices", ()))
        said = f"is {points} points without faces: make a surface of them first" if points else "is empty"
        raise ValueError(f"Argument `mesh` must be a closed surface, but {said}.")
    vertices = np.asarray(mesh.vertices, float)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"Argument `mesh` must have faces of its {len(vertices)} vertices, but one has others.")
    if not np.isfinite(vertices[faces]).all():
        raise ValueError("Argument `mesh` must have finite vertices, but one is not.")
    _warn_of_coarse(vertices[faces].reshape(-1, 3))
    return vertices, faces


def _warn_of_coarse(points: Float[np.ndarray, "n 3"]) -> None:
    """Warn of coordinates in single precision so far from their origin that few digits are left for the shape."""
    single = points.astype(np.float32)
    steps, extents = np.spacing(abs(single).max(axis=0)), np.ptp(points, axis=0)
    rounded = (single % (4 * steps) != 0).any(axis=0)  # numbers of few digits are exact
    if (single == points).all() and (rounded & (steps > _COARSE * extents)).any():
        worst = int((rounded * steps / np.maximum(extents, steps)).argmax())
        warnings.warn(
            f"Argument `mesh` must have coordinates that resolve its shape, but in single precision they are rounded "
            f"to {steps[worst]:.2g}, of an extent of {extents[worst]:.2g}: write the file with a nearer origin.",
            stacklevel=frames_of_the_package() + 1,
        )


def metres_of(mesh: Any, unit: str | None) -> float:
    """Return the length of the unit of a mesh [m]: as the argument says, else as the mesh says, else 1."""
    stated = str(getattr(mesh, "units", None) or "none").strip().lower()
    if stated == "none":
        return LENGTHS[unit or "m"]
    length = _metres(stated)
    if unit is None:
        if length is None:
            raise ValueError(f"Argument `mesh` must state a known unit, but states {stated!r}: give `unit`.")
        return length
    if length is not None and abs(length / LENGTHS[unit] - 1) > _SAME:
        raise ValueError(
            f"Argument `mesh` must be in the unit of `unit`, but states {stated!r} where `unit` is {unit!r}: leave "
            "`unit` out, or set `mesh.units` if the mesh is wrong."
        )
    return LENGTHS[unit]


def _metres(stated: str) -> float | None:
    """Return the length of a unit that may have a factor, such as "0.5 * meters" [m]; None: it is not known."""
    factor, star, name = stated.rpartition("*")
    name = name.strip()
    length = _METRES.get(name, _METRES.get(name.removesuffix("s")))
    try:
        number = float(factor) if star else 1.0
    except ValueError:
        return None
    return number * length if length is not None and 0 < number < np.inf else None
