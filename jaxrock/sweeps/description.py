"""Description of a store: one text with its own checksum, kept twice, against which all other files are verified."""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxrock._core.atomic_files import written_atomically
from jaxrock._core.precision import setting
from jaxrock._core.regular_files import open_regular
from jaxrock.compiler import cache
from jaxrock.sweeps.labels import RECORDS, layout_name

TWINS = ("zarr.json", f"{RECORDS}/store.json")  # the root of a Zarr group, and a second copy of it
_ABOUT, _CHECKSUM = "jaxrock_store", "jaxrock_checksum"  # attributes
_UNFINISHED, _FINISHED = "unfinished", "finished"


def fingerprint(
    axes: dict[str, np.ndarray], outer: bool, program: str, words: Mapping[str, Sequence[str]]
) -> dict[str, str]:
    """Identify a sweep, part by part; `words`: labels of the axes that have words, which are numbered."""
    hashes = {f"axis `{name}`": digest_of_axis(values) for name, values in axes.items()}
    hashes |= {f"words of axis `{name}`": _checksum({"words": list(told)}) for name, told in words.items()}
    return hashes | {
        "order of the axes": ", ".join(axes),
        "layout": layout_name(outer),
        "precision": "double" if setting("jax_enable_x64") else "single",
        "function, or what it holds": program,
        "version of jaxrock": cache.version_of("jaxrock"),
        "code of jaxrock": cache.code_digest(),
        "version of JAX": f"{cache.version_of('jax')}, {cache.version_of('jaxlib')}",
        "version of llvmlite": cache.version_of("llvmlite"),
    }


def digest_of_axis(values: np.ndarray) -> str:
    """Hash the type and the values of an axis."""
    return hashlib.sha256(f"{values.dtype}".encode() + values.tobytes()).hexdigest()


@dataclasses.dataclass(frozen=True)
class Description:
    """The complete root of a store, including the metadata of all its arrays.

    - `root`: as in the file.
    """

    root: dict

    @classmethod
    def of(
        cls,
        axes: list[str],
        results: dict[str, str],
        block: tuple[int, ...],
        made_by: dict[str, str],
        metadata: dict,
        marks: dict[str, dict[str, dict]],
    ) -> "Description":
        """Make a description from names of axes, results with their types, and Zarr's metadata of every array.

        `marks`: attributes of arrays in an unfinished store and in a finished one.
        """
        about = {"axes": axes, "results": results, "block": block, "made_by": made_by, "marks": marks}
        return cls._of(about, metadata)

    @classmethod
    def _of(cls, about: dict, metadata: dict) -> "Description":
        root: dict[str, Any] = {
            "zarr_format": 3,
            "node_type": "group",
            "attributes": {"layout": about["made_by"]["layout"], _ABOUT: json.dumps(about)},
            "consolidated_metadata": {"kind": "inline", "must_understand": False, "metadata": metadata},
        }
        root["attributes"][_CHECKSUM] = _checksum(root)
        return cls(root)

    @property
    def about(self) -> dict:
        """Names of axes, types of results by their names, points of a block, and the fingerprint of the sweep."""
        return json.loads(self.root["attributes"][_ABOUT])

    @property
    def metadata(self) -> dict[str, dict]:
        """Zarr's metadata of every array."""
        return self.root["consolidated_metadata"]["metadata"]

    @functools.cached_property
    def checksum(self) -> str:
        """Checksum of the unfinished store's description, which identifies the store in either state."""
        return self.marked(_UNFINISHED).root["attributes"][_CHECKSUM]

    def marked(self, state: str) -> "Description":
        """Return the description of the store in a state: "unfinished" or "finished".

        An unfinished store marks the fill value of missing values; a finished one has none. A store without marks has
        one description.
        """
        about, metadata = self.about, dict(self.metadata)
        if not about.get("marks"):
            return self
        for name, attributes in about["marks"].items():
            metadata[name] = metadata[name] | {"attributes": attributes[state]}
        about.pop("state", None)
        return self._of(about if state == _UNFINISHED else about | {"state": state}, metadata)

    def files(self) -> dict[str, dict]:
        """Return the content of every file that describes the store, by its path below that of the store."""
        return {name: self.root for name in TWINS} | {f"{name}/zarr.json": said for name, said in self.metadata.items()}

    def damaged(self, path: Path) -> list[Path]:
        """List the files that differ from the description in both states: a session may end between two of them."""
        states = [self.marked(state).files() for state in (_UNFINISHED, _FINISHED)]
        return [path / name for name in states[0] if _read(path / name) not in [files[name] for files in states]]

    def write(self, path: Path) -> None:
        """Write the files that differ from the description in this state."""
        for name, said in self.files().items():
            file = path / name
            if _read(file) == said:
                continue
            file.parent.mkdir(exist_ok=True)
            with written_atomically(file, replace=True) as aside:
                aside.write_text(json.dumps(said, indent=1), encoding="utf-8")


def read_description(path: Path, wanted: str) -> Description:
    """Read the description at a path; `wanted`: the argument and its requirement, in words.

    **Raises:** ValueError where there is no store, or one whose description is lost.
    """
    for name in TWINS:
        root = _read(path / name)
        try:
            told = root["attributes"].pop(_CHECKSUM)
            if told == _checksum(root):
                root["attributes"][_CHECKSUM] = told
                return Description(root)
        except (TypeError, KeyError, AttributeError):
            continue
    if (path / TWINS[1]).exists():
        raise ValueError(
            f"The store {path} is damaged: nothing can be known of it without one of {path / TWINS[0]} and "
            f"{path / TWINS[1]}."
        )
    raise ValueError(f"{wanted}, but {path} is neither.")


def _checksum(root: dict) -> str:
    return hashlib.sha256(json.dumps(root, sort_keys=True).encode()).hexdigest()


def _read(file: Path):
    try:
        with open_regular(file) as opened:
            return json.loads(opened.read().decode("utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError, RecursionError):
        return None
