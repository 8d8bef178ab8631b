"""Real records: reading, damage, measures of intensity beside another package, fragilities of the FEMA P-695 suites.

`python -m benchmarks.records [FOLDER]` writes `records.md`; the folder holds files of accelerograms, which are damaged.
Needs `pip install "jaxrock[p695]" eqsig`.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import jaxrock as rk  # noqa: E402
from benchmarks.common import table  # noqa: E402

COUNT, SEED = 1_000_000, 7
NAMES = ["PGA", "PGV", "PGD", "IA", "CAV", "SA(0.3)", "SA(0.5)", "SA(1.0)", "SA(2.0)"]
MEASURES = {name: name for name in NAMES} | {
    "AvgSA(0.5 to 3)": lambda m: rk.intensity.average_spectral_acceleration(m, np.linspace(0.5, 3.0, 10)),
    "mean period": rk.intensity.mean_period,
    "D5-95": rk.intensity.significant_duration,
}
# Of FEMA P-695: samples, step [s], peak [g].
PINS = {
    "RSN725": (2230, 0.01, 0.446326),
    "RSN752": (7991, 0.005, 0.528519),
    "RSN1063": (1991, 0.01, 0.869806),
    "RSN181": (7807, 0.005, 0.441714),
}


def timed(run):
    """What a function gives, and seconds of the processor."""
    begin = time.process_time()
    return run(), time.process_time() - begin


def reading() -> list[tuple[str, ...]]:
    """A million samples in every way in which numbers are printed."""
    values = np.round(np.random.default_rng(SEED).normal(0, 0.1, COUNT), 7)
    heads = {
        "AT2": f"PEER\nA, B, C\nACCELERATION IN UNITS OF G\nNPTS= {COUNT}, DT= .005 SEC\n",
        "V2": f"{COUNT} POINTS OF ACCEL DATA EQUALLY SPACED AT  .010 SEC.  (UNITS: G)\n",
        "V1": f"Uncorrected Accelerogram Data\n{COUNT} Accelerogram points at 100 pts/sec in units of g. "
        "Format: (8f10.7)\n",
        "ESM": f"SAMPLING_INTERVAL_S: 0.005000\nNDATA: {COUNT}\nUNITS: g\n",
        "CSV": "time,acceleration\n",
    }
    rows = []
    for kind, head in heads.items():
        text = np.char.mod("%15.7E" if kind == "AT2" else "%10.7f", values).astype(str)
        if kind == "CSV":
            lines = [f"{0.01 * k:.2f},{x}" for k, x in enumerate(text)]
        else:
            step = 1 if kind == "ESM" else 8
            lines = ["".join(text[k : k + step]) for k in range(0, COUNT, step)]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "long"
            path.write_text(head + "\n".join(lines) + "\n")
            given = {"unit": "g"} if kind == "CSV" else {}
            taken = min(timed(lambda path=path, given=given: rk.read_record(path, **given))[1] for _ in range(3))
            good = np.allclose(rk.read_record(path, **given).samples, values, atol=1e-12)
        rows.append((kind, f"{taken:.2f} s", str(good)))
    return rows


_ANSWERED = """
import resource, time, jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jaxrock as rk
noise = np.random.default_rng(7).normal(size={count} + 30)
record = rk.Record(0.1 * np.convolve(noise, np.ones(31) / 31**0.5, "valid")[: {count}], 0.005)
block, begin = rk.Block.from_dimensions(0.5, 2.0), time.process_time()
scales = np.linspace(0.1, 2.0, 256)
{what}.block_until_ready()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, time.process_time() - begin)
"""
ANSWERS = {
    "an outcome": "rk.outcome(block, record).margin",
    "outcomes at 256 scales": "jax.vmap(lambda s: rk.outcome(block, s * record).margin)(scales)",
    "a history": "rk.simulate(block, record).rotation",
}


def answering() -> list[tuple[str, ...]]:
    """Largest memory of a process that answers a record, with Python, JAX and compiling; and seconds with compiling."""
    rows = []
    for name, what in ANSWERS.items():
        told = []
        for count in (1000, COUNT):
            script = _ANSWERED.format(count=count, what=what)
            done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
            told.append([float(x) for x in done.stdout.split()])
        (little, _), (much, busy) = told
        rows.append((name, f"{little:.0f} MB", f"{much:.0f} MB", f"{busy:.0f} s"))
    return rows


def damaged(folder: Path) -> list[tuple[str, ...]]:
    """Files cut short and mislabelled: refused, read as they were, or read as something else."""
    random, rows = np.random.default_rng(SEED), []
    for path in sorted(each for each in folder.iterdir() if each.is_file()):
        content, whole = path.read_bytes(), rk.read_record(path)
        places = [*random.integers(0, len(content), 150), *range(len(content) - 60, len(content) - 1)]
        cuts = [content[:place] for place in places]
        text = content.decode("latin-1")
        head = text[: max(len(text) // 10, 4000)]
        labels = []
        for found in re.finditer(rf"(?<!\d){whole.samples.size}(?!\d)", head):
            for count in (whole.samples.size - 1, whole.samples.size + 1):
                labels.append(text[: found.start()] + str(count) + text[found.end() :])
        for found in re.finditer(r"(?i)\bcm/s\S*|\bunits of g\b", head):
            labels.append(text[: found.start()] + "counts" + text[found.end() :])
        labels = [each.encode("latin-1") for each in labels]
        peak = f"{float(np.abs(whole.samples).max()):.4f} g"
        known = path.suffix, f"{whole.samples.size}", f"{float(whole.dt):g} s", peak
        rows.append((*known, told(path, cuts, whole), told(path, labels, whole)))
    return rows


def told(path: Path, contents: list[bytes], whole: rk.Record) -> str:
    """How many were refused, read as the same samples, and (wrong) as others."""
    refused = same = other = 0
    with tempfile.TemporaryDirectory() as name:
        damaged = Path(name) / path.name
        for content in contents:
            damaged.write_bytes(content)
            try:
                found = rk.read_record(damaged)
            except ValueError:
                refused += 1
                continue
            alike = found.samples.shape == whole.samples.shape and np.array_equal(found.samples, whole.samples)
            same, other = same + (alike and found.dt == whole.dt), other + (not alike or found.dt != whole.dt)
    return f"{refused}, {same}, {other}"


def measures() -> list[tuple[str, ...]]:
    """Measures of intensity of the built-in record, and by eqsig."""
    import eqsig

    record, periods = rk.example_record(), np.array([0.1, 0.3, 1.0, 3.0])
    # eqsig joins squares and absolute values by straight lines: it gets the same motion with twenty times the samples.
    fine = rk.processing.resampled(record, float(record.dt) / 20)
    signal = eqsig.AccSignal(9.81 * np.asarray(fine.samples), float(fine.dt))
    signal.generate_response_spectrum(response_times=periods, xi=0.05)
    pairs = {
        "PGA [g]": (float(rk.intensity.peak_acceleration(record)), signal.pga / 9.81),
        "PGV [m/s]": (float(rk.intensity.peak_velocity(record)), signal.pgv),
        "Arias [m/s]": (rk.intensity.arias(record), eqsig.im.calc_arias_intensity(signal)[-1]),
        "CAV [m/s]": (rk.intensity.cumulative_absolute_velocity(record), eqsig.im.calc_cav(signal)[-1]),
        "D5-95 [s]": (rk.intensity.significant_duration(record), eqsig.im.calc_sig_dur(signal)),
    }
    own = rk.intensity.spectral_acceleration(record, periods)
    pairs |= {f"SA({period:g}) [g]": (a, b / 9.81) for period, a, b in zip(periods, own, signal.s_a)}
    return [(name, f"{a:.6g}", f"{b:.6g}", f"{abs(a / b - 1):.1e}") for name, (a, b) in pairs.items()]


def fragilities() -> list[str]:
    """The far-field suite: its pins, stripes, which measure explains overturning, and planes of an oval column."""
    parts, taken = timed(lambda: rk.motions.fema_p695())
    every = [part for pair in (*parts, *rk.motions.fema_p695("nearfield")) for part in (pair.first, pair.second)]
    for title, (samples, dt, peak) in PINS.items():
        near = [x for x in every if x.name.startswith(title + " ") and x.samples.size == samples and float(x.dt) == dt]
        assert min(abs(float(np.abs(x.samples).max()) - peak) for x in near) < 1e-6, title
    suite = rk.motions.Suite([part for pair in parts for part in (pair.first, pair.second)])
    blocks = rk.blocks.draw_blocks(rk.Block(0.2, 2.5), 20, alpha=0.2, p=0.2)
    scale = np.geomspace(0.2, 5.0, 50)
    found, first = timed(lambda: rk.hazard.suite_outcomes(blocks, suite, scale, progress=False))
    again = timed(lambda: rk.hazard.suite_outcomes(blocks, suite, scale, progress=False))[1]
    lines = [
        f"The 44 components of the far-field suite were read in {taken:.2f} s; samples, steps and peaks of four "
        "records of the suites are as published.",
        "",
        f"44 components x 50 scales x 20 blocks, {found.verdict.size:,} histories: {first:.1f} s of the processor with "
        f"compiling, {again:.1f} s again; {found.undecided} undecided.",
        "",
        "Which measure explains what toppled (motions go together; 20 blocks around alpha 0.2, p 2.5 rad/s):",
        "",
    ]
    best = rk.hazard.compare_measures(found, MEASURES)
    rows = [(str(best["measure"][k]), *(f"{best[name][k]:.3f}" for name in ("auc", "median", "dispersion")),
             f"{best['p_value'][k]:.1e}", str(bool(best["useless"][k]))) for k in range(len(MEASURES))]  # fmt: skip
    lines += [table(("measure", "auc", "median", "dispersion", "p-value", "useless"), rows), ""]
    stripes = []
    for measure, levels in (("PGA", np.geomspace(0.1, 2.0, 16)), ("PGV", np.geomspace(0.1, 3.0, 16)),
                            ("SA(1.0)", np.geomspace(0.05, 2.0, 16)), ("IA", np.geomspace(0.1, 60.0, 16))):  # fmt: skip
        fragility, busy = timed(
            lambda m=measure, x=levels: rk.hazard.simulated_fragility(blocks, suite, x, measure=m, progress=False)
        )
        fit = fragility.fit("lower")
        errors = np.sqrt(np.diag(np.asarray(fit.covariance)))
        stripes.append((f"{measure} [{fragility.unit}]", f"{float(fit.fragility.median):.3f} ({errors[0]:.2f})",
                        f"{float(fit.fragility.dispersion):.3f} ({errors[1]:.2f})", f"{fragility.undecided}",
                        f"{busy:.1f} s"))  # fmt: skip
    header = (
        "stripes by",
        "median (error of its logarithm)",
        "dispersion (error of its logarithm)",
        "undecided",
        "processor",
    )
    lines += [table(header, stripes), ""]
    lines += planes(parts)
    return lines


def planes(parts) -> list[str]:
    """An oval column in 36 planes under both components of every record."""

    def oval(azimuth):
        return rk.Block(0.18 + 0.05 * np.cos(2 * azimuth), 2.5)

    def run():
        return [rk.studies.azimuth_outcomes(oval, pair, scale=[1.0, 2.0], progress=False) for pair in parts]

    found, busy = timed(run)
    slender = np.array([each.verdict[18] for each in found])  # at 90 degrees
    bound = np.array([each.toppled for each in found])
    away = [abs(np.degrees(each.weakest[0]) - 90) for each in found]
    (one, two), (some, any_at_two) = ((x == 1).sum(axis=0) for x in (slender, bound))
    return [
        "An oval column (alpha 0.18 + 0.05 cos 2 azimuth) in 36 planes under both components of 22 records at two "
        f"scales: {busy:.1f} s of the processor. As recorded it topples under {one} records in its most slender plane "
        f"and under {some} in some plane; at twice that under {two} and {any_at_two}. The plane of the lowest margin "
        f"is {np.median(away):.0f} degrees (median) and up to {np.max(away):.0f} degrees from the most slender one.",
    ]


def main() -> None:
    """Write the report."""
    lines = [
        "# Real records",
        "",
        f"Written by `python -m benchmarks.records` ({jax.device_count()} device, double precision); times are",
        "those of the processor, on a machine that did other work at the same time.",
        "",
        f"## A file of {COUNT:,} samples",
        "",
        table(("format", "read in", "every sample right"), reading()),
        "",
    ]
    header = "one block", "memory, 1,000 samples", f"memory, {COUNT:,} samples", "time, with compiling"
    lines += [
        "Answered, each in a process of its own: the largest memory that it held, Python and JAX included.",
        "",
        table(header, answering()),
        "",
    ]
    print("\n".join(lines), flush=True)
    if len(sys.argv) > 1:
        header = "file", "samples", "step", "peak", "cut short", "mislabelled"
        lines += [
            "## Files of agencies, damaged",
            "",
            "Cut at 150 places and at each of the last 60 bytes, or with another count or unit: how many were refused,",
            "read as the same samples (what is lost comes after them, or is not used), and read as others.",
            "",
            table(header, damaged(Path(sys.argv[1]))),
            "",
        ]
        print("\n".join(lines[-3:]), flush=True)
    lines += [
        "## Measures of intensity beside eqsig",
        "",
        "Of the built-in record; eqsig gets it with twenty times the samples.",
        "",
    ]
    lines += [table(("measure", "here", "eqsig", "relative difference"), measures()), ""]
    lines += ["## Fragilities of real records", "", *fragilities()]
    (Path(__file__).parent / "records.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
