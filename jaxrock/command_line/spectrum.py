"""The command `jaxrock spectrum`: the rocking spectrum of a record."""

import argparse

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import (
    add_record,
    add_restitution,
    check_points,
    check_range,
    model_of,
    plain_float,
    record_of,
)
from jaxrock.command_line.output import Entry, Report, check_surface, save, write_table


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--slenderness", type=plain_float, default=5.0, help="height/width of the blocks (default 5)")
    parser.add_argument("--shortest", type=plain_float, default=0.5, help="shortest 2 pi/p [s] (default 0.5)")
    parser.add_argument("--longest", type=plain_float, default=8.0, help="longest 2 pi/p [s] (default 8)")
    parser.add_argument("--points", type=int, default=200, help="number of block sizes (default 200)")
    add_restitution(parser)
    add_record(parser)


def _run(arguments: argparse.Namespace, report: Report) -> None:
    check_points(arguments.points, 1)
    if not arguments.slenderness > 0:
        raise ValueError(f"Argument `--slenderness` must be positive, but is {arguments.slenderness}.")
    check_range("--shortest, --longest", (arguments.shortest, arguments.longest))
    record = record_of(arguments)
    period = np.linspace(arguments.shortest, arguments.longest, arguments.points)
    alpha = np.arctan(1 / arguments.slenderness)
    result = rk.rocking_spectrum(alpha, record, period, arguments.restitution, model_of(arguments))
    known = np.asarray(result.status == rk.Status.successful)
    lost = np.asarray(result.overturned) & known
    longest, instead = (period[lost].max(), None) if lost.any() else (None, "none")
    report.title(record.name or "unnamed record")
    report.table([
        Entry("slenderness", "slenderness, height/width", arguments.slenderness, "g"),
        Entry("block_sizes", "block sizes", period.size),
        Entry("overturned", "of these overturn", int(lost.sum())),
        Entry("longest_overturned", "longest 2 pi/p that overturns", longest, ".3f", "s", instead),
        Entry("not_computed", "not computed", int(np.sum(~known))),
    ])  # fmt: skip
    header = "two_pi_over_p_s,max_rotation_over_alpha,max_velocity_over_p_alpha,impacts,overturned,margin"
    peaks = (result.max_rotation, result.max_velocity, result.impact_count, lost, result.margin)
    columns = [np.where(known, np.asarray(each, float), np.nan) for each in peaks]  # NaN marks what is not a result
    write_table(report, arguments.out, "spectrum.csv", header, period, *columns)
    save(report, arguments.out, "spectrum.png", rk.plot.spectrum(result)[0].figure)
    check_surface(report, result.status)


SPECTRUM = Command(
    "spectrum",
    "rocking spectrum of a record: peak response against block size",
    _add_options,
    _run,
    writes=lambda _: ("spectrum.csv", "spectrum.png"),
)
