"""Surface meshes, which trimesh reads and integrates; trimesh is imported only when a file is read."""

import os
from typing import Any

from jaxrock._arguments.annotations import path_of
from jaxrock._core.arrays import shown
from jaxrock._core.regular_files import open_regular


def trimesh_of(mesh: Any) -> Any:
    """Return a trimesh mesh from a mesh or the path of a file."""
    if isinstance(mesh, (str, os.PathLike)):
        path = path_of("mesh", mesh)
        try:
            import trimesh
        except ImportError as error:
            raise ImportError('Reading a mesh needs trimesh: pip install "jaxrock[mesh]".') from error
        with open_regular(path):  # raises the same errors as for any other file
            pass
        try:
            return trimesh.load(path, force="mesh")
        except Exception as error:
            raise ValueError(
                f"File `{path.name}`: trimesh does not read it ({type(error).__name__}: {error})."
            ) from error
    if not all(hasattr(mesh, name) for name in ("is_volume", "vertices", "moment_inertia", "center_mass")):
        raise ValueError(f"Argument `mesh` must be a mesh of trimesh, or the path of a file, but is {shown(mesh)}.")
    return mesh
