"""The command `jaxrock fragility`: how probable it is that a block topples, from records that are scaled to levels."""

import argparse
import csv
import sys

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import add_description, add_restitution, check_points, check_range, model_of, number
from jaxrock.command_line.output import save, table, write_csv


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("records", nargs="+", metavar="RECORD", help="files of accelerograms, of any format")
    parser.add_argument("--width", type=number, default=0.6, help="full width [m] (default 0.6)")
    parser.add_argument("--height", type=number, default=3.0, help="full height [m] (default 3)")
    parser.add_argument("--measure", choices=("PGA", "PGV"), default="PGA", help="what levels are: PGA [g], PGV [m/s]")
    parser.add_argument(
        "--levels", type=number, nargs=2, default=(0.1, 2.0), metavar=("FROM", "TO"), help="(default 0.1 2)"
    )
    parser.add_argument("--points", type=int, default=24, help="levels, in equal ratios (default 24)")
    parser.add_argument("--scatter", type=number, default=0.0, help="standard deviation of ln slenderness (default 0)")
    parser.add_argument("--draws", type=int, default=32, help="blocks that are drawn if it is not 0 (default 32)")
    add_restitution(parser)
    add_description(parser)


def _run(arguments: argparse.Namespace) -> int:
    check_points(arguments.points, 3)
    check_range("--levels", arguments.levels)
    given = {"dt": arguments.dt, "unit": arguments.unit, "column": arguments.column}
    suite = rk.motions.Suite([rk.read_record(path, **given) for path in arguments.records])
    block = rk.Block.from_dimensions(arguments.width, arguments.height, arguments.restitution)
    if arguments.scatter != 0:
        block = rk.blocks.draw_blocks(block, arguments.draws, alpha=arguments.scatter)
    levels = np.geomspace(*arguments.levels, arguments.points)
    found = rk.hazard.simulated_fragility(block, suite, levels, model_of(arguments), measure=arguments.measure)
    fits = {bound: found.fit(bound) for bound in ("lower", "upper")}
    print(f"{len(suite)} records\n{table(_rows(found, fits))}")
    good = all(fit.status == rk.hazard.FitStatus.successful for fit in fits.values())
    if not good:
        worse = next(fit for fit in fits.values() if fit.status != rk.hazard.FitStatus.successful)
        print(f"jaxrock: no lognormal fit: {rk.hazard.FitStatus[worse.status]}", file=sys.stderr)
    _write(arguments, found, fits["upper"].fragility if good else None)
    return 0 if good else 1


def _rows(found: rk.hazard.SimulatedFragility, fits: dict) -> list[tuple[str, str, str]]:
    """Lines of the table that is printed."""
    unit = {"PGA": "g", "PGV": "m/s"}[found.measure]
    rows = [
        ("scenes", f"{found.verdict.size}", ""),
        ("of these undecided", f"{found.undecided}", ""),
        ("blocks that stand again at a higher level", f"{int(np.sum(~found.monotone))}", ""),
    ]
    for bound, fit in fits.items():
        if bound == "upper" and not found.undecided:
            continue
        errors = np.sqrt(np.diag(np.asarray(fit.covariance)))
        words = "" if not found.undecided else f", {bound} bound"
        rows += [
            (f"median {found.measure}{words}", f"{float(fit.fragility.median):.4f}", unit),
            (f"dispersion{words}", f"{float(fit.fragility.dispersion):.4f}", ""),
            (f"standard errors of their logarithms{words}", f"{errors[0]:.3f}, {errors[1]:.3f}", ""),
        ]
    return rows


def _write(
    arguments: argparse.Namespace, found: rk.hazard.SimulatedFragility, fit: rk.hazard.LogNormalFragility | None
) -> None:
    """Tables, the figure, and NRML where there is a fit."""
    folder = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "fragility.csv", f"{found.measure},lower,upper", found.levels, found.lower, found.upper)
    print(f"wrote {folder / 'fragility.csv'}")
    columns = found.table()
    with (folder / "stripes.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values())))
    print(f"wrote {folder / 'stripes.csv'}")
    if fit is not None:
        rk.hazard.write_nrml({"topples": fit}, folder / "fragility.xml", found.measure)
        print(f"wrote {folder / 'fragility.xml'}")
    save(rk.plot.fragility(found, fit).figure, folder / "fragility.png")


FRAGILITY = Command("fragility", "how probable it is that a block topples under scaled records", _add_options, _run)
