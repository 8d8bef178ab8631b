"""The command `jaxrock fragility`: the probability that a block topples, from records scaled to levels."""

import argparse
import csv
from typing import Any

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import (
    add_description,
    add_restitution,
    check_points,
    check_range,
    file_description,
    files_of,
    model_of,
    plain_float,
)
from jaxrock.command_line.output import Entry, Report, save, write_table
from jaxrock.command_line.results import ResultFolder


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "records", nargs="+", metavar="RECORD", help="files of accelerograms of any format, folders, patterns"
    )
    parser.add_argument("--width", type=plain_float, default=0.6, help="full width [m] (default 0.6)")
    parser.add_argument("--height", type=plain_float, default=3.0, help="full height [m] (default 3)")
    parser.add_argument(
        "--measure",
        default="PGA",
        help="of PGA [g], PGV [m/s], PGD [m], IA [m/s], CAV [m/s], SA(0.5) [g], SV(0.5) [m/s] (default PGA)",
    )
    ends: dict[str, Any] = {"type": plain_float, "nargs": 2, "metavar": ("FROM", "TO")}
    parser.add_argument("--levels", default=(0.1, 2.0), help="range of the measure (default 0.1 2)", **ends)
    parser.add_argument("--points", type=int, default=24, help="levels, in equal ratios (default 24)")
    parser.add_argument(
        "--scatter", type=plain_float, default=0.0, help="standard deviation of ln slenderness (default 0)"
    )
    parser.add_argument("--draws", type=int, default=32, help="blocks that are drawn if it is not 0 (default 32)")
    add_restitution(parser)
    add_description(parser)


def _run(arguments: argparse.Namespace, report: Report) -> None:
    check_points(arguments.points, 3)
    check_range("--levels", arguments.levels)
    suite = rk.motions.Suite(
        [rk.read_record(path, **file_description(arguments)) for path in files_of(arguments.records)]
    )
    size = arguments.width, arguments.height
    block = rk.Block.from_dimensions(*size, arguments.restitution, opens=arguments.opens)
    if arguments.scatter != 0:
        block = rk.blocks.draw_blocks(block, arguments.draws, alpha=arguments.scatter)
    levels = np.geomspace(*arguments.levels, arguments.points)
    found = rk.hazard.simulated_fragility(block, suite, levels, model_of(arguments), measure=arguments.measure.upper())
    fits = {bound: found.fit(bound) for bound in ("lower", "upper", "share")}
    report.title(f"{len(suite)} records")
    report.table(_entries(found, fits))
    good = all(fit.status == rk.hazard.FitStatus.successful for fit in fits.values())
    if not good:
        worse = next(fit for fit in fits.values() if fit.status != rk.hazard.FitStatus.successful)
        report.failed(f"no lognormal fit: {rk.hazard.FitStatus[worse.status]}")
    _write(report, arguments, found, fits["upper"].fragility if good else None)


def _entries(found: rk.hazard.SimulatedFragility, fits: dict) -> list[Entry]:
    """Return the lines of the table."""
    unit = found.unit
    again = int(np.sum(~found.monotone))
    entries = [
        Entry("scenes", "scenes", found.verdict.size),
        Entry("undecided", "of these undecided", found.undecided),
        Entry("stand_again", "pairs of motion and block that stand again at a higher level", again),
    ]
    for bound, fit in fits.items():
        if bound != "lower" and not found.undecided:
            continue
        errors = np.sqrt(np.diag(np.asarray(fit.covariance)))
        counted = {"lower": "standing", "upper": "toppled", "share": "shares"}[bound]
        words, key = ("", "") if not found.undecided else (f", undecided as {counted}", f"_{bound}")
        said = "standard errors of their logarithms"
        known = f"{errors[0]:.3f}, {errors[1]:.3f}" if np.isfinite(errors).all() else "not known"  # one record has none
        entries += [
            Entry(f"median{key}", f"median {found.measure}{words}", float(fit.fragility.median), ".4f", unit),
            Entry(f"dispersion{key}", f"dispersion{words}", float(fit.fragility.dispersion), ".4f"),
            Entry(f"standard_errors{key}", f"{said}{words}", errors, shown=known),
        ]
        intervals = found.intervals(bound)
        for name, ends in (("median", intervals.median), ("dispersion", intervals.dispersion)):
            if intervals.status == rk.hazard.FitStatus.successful:
                shown = f"{float(ends[0]):.3f} to {float(ends[1]):.3f}"
                entries.append(Entry(f"{name}_interval{key}", f"95 % interval of the {name}{words}", ends, shown=shown))
    return entries


def _write(
    report: Report,
    arguments: argparse.Namespace,
    found: rk.hazard.SimulatedFragility,
    fit: rk.hazard.LogNormalFragility | None,
) -> None:
    """Write tables, the figure, and NRML if there is a fit."""
    folder: ResultFolder = arguments.out
    header = f"{found.measure},lower,upper"
    write_table(report, folder, "fragility.csv", header, found.levels, found.lower, found.upper)
    columns = found.table()
    with folder.whole("stripes.csv") as aside, aside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values())))
    report.wrote(folder.path / "stripes.csv")
    folder.discard("fragility.xml")  # an earlier run may have had a fit
    if fit is not None and found.measure.startswith("SV("):
        report.say(f"no fragility.xml: OpenQuake knows no {found.measure}")
    elif fit is not None:
        with folder.whole("fragility.xml") as aside:
            rk.hazard.write_nrml({"topples": fit}, aside, found.measure)
        report.wrote(folder.path / "fragility.xml")
    save(report, folder, "fragility.png", rk.plot.fragility(found, fit).figure)


FRAGILITY = Command(
    "fragility",
    "how probable it is that a block topples under scaled records",
    _add_options,
    _run,
    writes=lambda _: ("fragility.csv", "stripes.csv", "fragility.xml", "fragility.png"),
)
