"""Damage to stores and saved grids: what is read from one is right, or refused with its path; never silence.

`python -m references.damage 500` damages as many copies, by seeds from 0 on, and says what became of each kind.
"""

import argparse
import collections
import shutil
import tempfile
import warnings
from pathlib import Path

import jax
import numpy as np

import jaxrock as rk

AXES = {"alpha": np.linspace(0.1, 0.3, 3), "p": np.linspace(1.5, 4.0, 7)}
BLOCK = 4  # points: six blocks, every other of them smaller


def record() -> rk.Record:
    """A motion of many lobes."""
    time = 0.02 * np.arange(200)
    return rk.Record(0.5 * np.sin(2 * np.pi * time / 0.7) * np.exp(-((time - 2) ** 2)), 0.02)


def swept(
    store: Path | None = None, *, axes: dict = AXES, block: int = BLOCK, load: bool = True
) -> rk.studies.Grid | None:
    """Outcomes of blocks under a record."""
    motion = record()
    return rk.sweep(
        lambda alpha, p: rk.outcome(rk.Block(alpha, p), motion),
        store=store, load=load, block=block, progress=False, **axes,
    )  # fmt: skip


def bits(grid: rk.studies.Grid) -> list[tuple]:
    """All that a grid holds, to the last bit."""
    arrays = [*grid.axes.values(), *jax.tree.leaves(grid.values)]
    return [(x.dtype.str, x.shape, x.tobytes()) for x in map(np.asarray, arrays)]


def deleted(file: Path, rng) -> None:
    """Gone."""
    file.unlink()


def truncated(file: Path, rng) -> None:
    """Cut short, or empty."""
    content = file.read_bytes()
    file.write_bytes(content[: rng.integers(max(len(content), 1))])


def flipped(file: Path, rng) -> None:
    """One bit is another."""
    content = bytearray(file.read_bytes())
    if content:
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    file.write_bytes(content)


def zeroed(file: Path, rng) -> None:
    """As a disk leaves it that lost power: the size is right, a part from somewhere on is zero."""
    content = file.read_bytes()
    keep = rng.integers(max(len(content), 1))
    file.write_bytes(content[:keep] + bytes(len(content) - keep))


def lengthened(file: Path, rng) -> None:
    """More than was written."""
    file.write_bytes(file.read_bytes() + rng.bytes(1 + int(rng.integers(40))))


def swapped(file: Path, rng) -> None:
    """Another file of the same kind in its place: good bytes where they do not belong."""
    others = [other for other in sorted(file.parent.parent.rglob("*")) if other.is_file() and other != file]
    if not others:
        return deleted(file, rng)
    file.write_bytes(others[rng.integers(len(others))].read_bytes())


def a_folder_lost(file: Path, rng) -> None:
    """All that lies beside it is gone with it; of a file that lies in no folder of its own, it alone."""
    if file.suffix == ".nc":
        file.unlink()
    else:
        shutil.rmtree(file.parent)


KINDS = (deleted, truncated, flipped, zeroed, lengthened, swapped, a_folder_lost)


def damaged(original: Path, copy: Path, seed: int) -> str:
    """Damage a copy of a store or a file, by a seed; how, in a word."""
    rng = np.random.default_rng(seed)
    if original.is_dir():
        shutil.copytree(original, copy)
        files = sorted(path for path in copy.rglob("*") if path.is_file())
    else:
        shutil.copy(original, copy)
        files = [copy]
    kind = KINDS[rng.integers(len(KINDS))]
    for _ in range(1 + int(rng.integers(2))):  # one or two at a time
        file = files[rng.integers(len(files))]
        if file.exists():
            kind(file, rng)
    return kind.__name__


def loaded(path: Path, right: list[tuple]) -> str:
    """Load a grid or store: return `right`, or `refused` with its path; any other result fails."""
    try:
        found = rk.studies.Grid.load(path)
    except (ValueError, FileNotFoundError) as error:
        assert str(path) in str(error), f"a message without the path: {error}"
        return "refused"
    assert bits(found) == right, "a wrong answer, silently"
    return "right"


def resumed(path: Path, right: list[tuple], function=swept) -> str:
    """Resume a sweep: return `mended` with a warning that names files, `right`, or `refused`."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            found = function(path)
        except ValueError as error:
            assert str(path) in str(error), f"a message without the path: {error}"
            return "refused"
    assert bits(found) == right, "a wrong answer, silently"
    assert bits(rk.studies.Grid.load(path)) == right, "what was mended is not right"
    assert len(said) <= 1 and all(str(path) in str(warning.message) for warning in said)
    return "mended" if said else "right"


def attack(count: int, first: int = 0) -> collections.Counter:
    """Damage stores and saved grids, by seeds from the first on: how often what became of which kind."""
    found = collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        grid = swept(folder / "store.zarr")
        grid.save(folder / "saved.zarr")
        grid.save(folder / "saved.nc")
        right = bits(swept())
        assert bits(grid) == right
        for seed in range(first, first + count):
            # Three of five are stores.
            name = ("store.zarr", "store.zarr", "saved.zarr", "store.zarr", "saved.nc")[seed % 5]
            copy = folder / f"{seed}" / name
            copy.parent.mkdir()
            try:
                kind = damaged(folder / name, copy, seed)
                found[name, kind, f"loaded: {loaded(copy, right)}"] += 1
                if name == "store.zarr":
                    found[name, kind, f"resumed: {resumed(copy, right)}"] += 1
            except Exception as error:
                raise AssertionError(f"seed {seed}, {name}") from error
            shutil.rmtree(copy.parent)
    return found


def main() -> None:
    """Damage many, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--seed", type=int, default=0, help="the first")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    found = attack(given.count, given.seed)
    for what, often in sorted(found.items()):
        print(f"{often:6d}  {', '.join(what)}")


if __name__ == "__main__":
    main()
