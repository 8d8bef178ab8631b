"""The command `jaxrock critical`: the scales of a record at which a block topples, and stands again."""

import argparse

import numpy as np

import jaxrock as rk
from jaxrock._arguments.annotations import known
from jaxrock._arguments.ranges import not_negative
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import add_record, add_restitution, check_range, model_of, plain_float, record_of
from jaxrock.command_line.output import Entry, Report, plain, save, write_table
from jaxrock.studies.critical_ends import intervals_of

_INTENSITY = (1.0, 10.0)  # over the uplift threshold: the range that is searched without --range


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--width", type=plain_float, default=0.6, help="full width [m] (default 0.6)")
    parser.add_argument("--height", type=plain_float, default=3.0, help="full height [m] (default 3)")
    parser.add_argument(
        "--range",
        type=plain_float,
        nargs=2,
        metavar=("FROM", "TO"),
        help="factors on the record to search (default: those of 1 to 10 times the uplift threshold); wide ranges take "
        "a minute and more",
    )
    parser.add_argument(
        "--narrowest",
        type=plain_float,
        help="merge intervals and safe gaps that are narrower than this, over their lower end, into what surrounds "
        "them, and list them apart (default: none)",
    )
    add_restitution(parser)
    add_record(parser)


def _run(arguments: argparse.Namespace, report: Report) -> None:
    narrowest = None if arguments.narrowest is None else known(not_negative)("narrowest", arguments.narrowest)
    _check_range(arguments.range)
    record, model = record_of(arguments), model_of(arguments)
    width, height = arguments.width, arguments.height
    block = rk.Block.from_dimensions(width, height, arguments.restitution, opens=arguments.opens)
    peak, threshold = float(rk.intensity.peak_acceleration(record)), float(model.moments(block).threshold)
    if not peak > 0:
        raise ValueError(f"The record must move the ground, but its peak is {peak:g} g.")
    searched = arguments.range or tuple(x * threshold / peak for x in _INTENSITY)
    intensity = tuple(x * peak / threshold for x in searched)
    if intensity[1] > _INTENSITY[0]:  # nothing moves below the threshold
        intensity = max(intensity[0], _INTENSITY[0]), intensity[1]
    found = rk.critical_amplitudes(block, record, model, intensity=intensity, derivatives=False)
    ends = found if narrowest is None else found.without_thin(narrowest)
    report.title(record.name or "unnamed record")
    size = Entry("width_and_height", "block, width x height", (width, height), unit="m",
                 shown=f"{width:g} x {height:g}")  # fmt: skip
    report.table([size, *_entries(ends, peak, threshold, searched)])
    _tell(report, "intervals", "overturns", _rows(ends, intervals_of(ends), peak), searched)
    if narrowest is not None:
        _tell(report, "thin", f"narrower than {narrowest:g}", _thin(found, narrowest, peak), searched)
    _write(report, arguments, found, ends, searched)
    if not found.complete:
        report.failed("the search is not complete: scales whose verdict is open may hide ends beside them")


def _check_range(ends) -> None:
    """Raise ValueError unless a range, if it is given, is positive, finite and rising."""
    if ends is None:
        return
    check_range("--range", ends)
    if ends[0] == ends[1]:
        raise ValueError(f"Argument `--range` must be rising, but is {ends[0]:g} to {ends[1]:g}.")


def _entries(ends: rk.studies.Critical, peak: float, threshold: float, searched: tuple) -> list[Entry]:
    """Return the lines of the table."""
    intervals, lowest = intervals_of(ends), float(ends.lowest) / peak
    below = bool(ends.from_the_least)
    instead = f"below {searched[0]:.6g}" if below else None if np.isfinite(lowest) else "none"
    return [
        Entry("peak_ground_acceleration", "peak ground acceleration", peak, ".4f", "g"),
        Entry("uplift_threshold", "uplift threshold", threshold, ".4f", "g"),
        Entry("uplift_scale", "scale that uplifts", threshold / peak, ".6g"),
        Entry("searched", "scales searched", searched, shown=f"{searched[0]:.6g} to {searched[1]:.6g}"),
        Entry("complete", "search complete", bool(ends.complete), shown="yes" if ends.complete else "no"),
        Entry("interval_count", "intervals that overturn", len(intervals)),
        Entry("merged", "thin intervals and gaps merged", int(ends.merged)),
        Entry("lowest_scale", "lowest scale that overturns", lowest, ".8g", "", instead),
    ]


def _rows(ends: rk.studies.Critical, pairs: list[tuple], peak: float) -> list[dict]:
    """Return pairs of ends as JSON tells them; null: beyond what was searched."""

    scales = np.asarray(ends.scale)

    def told(k, end: str) -> dict:
        scale, impacts = (None, None) if k is None else (float(scales[k]), int(ends.impacts[k]))
        return {f"{end}_scale": scale, f"{end}_g": None if scale is None else scale * peak, f"{end}_impacts": impacts}

    rows = [told(low, "from") | told(high, "to") for low, high in pairs]
    for row in rows:
        low, high = row["from_scale"], row["to_scale"]
        row["relative_width"] = None if low is None or high is None else high / low - 1
    return rows


def _thin(found: rk.studies.Critical, narrowest: float, peak: float) -> list[dict]:
    """Return intervals and gaps between neighbouring ends that are narrower than `narrowest`."""
    rows = _rows(found, [(k, k + 1) for k in range(int(found.count) - 1)], peak)
    told = [row | {"overturns": bool(rising)} for row, rising in zip(rows, np.asarray(found.rising))]
    return [row for row in told if row["relative_width"] < narrowest]


def _tell(report: Report, key: str, title: str, rows: list[dict], searched: tuple) -> None:
    """Record rows, and print them as columns."""
    report.results[key] = plain(rows)
    if not rows:
        return
    names = ("from scale", "to scale", "from [g]", "to [g]", "width", "impacts")
    report.say(f"{title}:")
    report.say("  " + f"{'':<9}  " + "  ".join(f"{name:>12}" for name in names))
    for k, row in enumerate(rows):
        ends = row["from_scale"], row["to_scale"]
        shown = [
            f"{end:.8g}" if end is not None else f"{sign}{limit:.6g}" for end, sign, limit in zip(ends, "<>", searched)
        ]
        shown += ["-" if row[name] is None else f"{row[name]:.5f}" for name in ("from_g", "to_g")]
        shown += ["-" if row["relative_width"] is None else f"{row['relative_width']:.2e}"]
        shown += [", ".join("-" if row[name] is None else str(row[name]) for name in ("from_impacts", "to_impacts"))]
        verdict = {True: "overturns", False: "stands", None: str(k + 1)}[row.get("overturns")]
        report.say("  " + f"{verdict:<9}  " + "  ".join(f"{each:>12}" for each in shown))


def _write(report: Report, arguments: argparse.Namespace, found, ends, searched: tuple) -> None:
    """Write the table of all ends, and the figure."""
    merged = ~np.isin(np.asarray(found.scale), np.asarray(ends.scale))
    header = "scale,peak_acceleration_g,intensity,overturns_above,impacts,balanced,merged"
    columns = found.scale, found.value, found.intensity, found.rising, found.impacts, found.balanced, merged
    write_table(report, arguments.out, "critical.csv", header, *columns)
    save(report, arguments.out, "critical.png", rk.plot.critical_scales(ends, between=searched).figure)


CRITICAL = Command(
    "critical",
    "scales of a record at which a block topples, and stands again",
    _add_options,
    _run,
    writes=lambda _: ("critical.csv", "critical.png"),
)
