"""The command `jaxrock spectrum`: the rocking spectrum of a record, or of a suite of them."""

import argparse
import os

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import (
    add_records,
    add_restitution,
    as_typed,
    check_points,
    check_range,
    each_once,
    files_of,
    left_out_of_folders,
    model_of,
    plain_float,
    scaled_record,
)
from jaxrock.command_line.output import Entry, Report, check_surface, save, write_named_table, write_table

_HEADER = "two_pi_over_p_s,rotation_ratio,velocity_ratio,impacts,overturned,margin"


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--slenderness", type=plain_float, default=5.0, help="height/width of the blocks (default 5)")
    parser.add_argument("--shortest", type=plain_float, default=0.5, help="shortest 2 pi/p [s] (default 0.5)")
    parser.add_argument("--longest", type=plain_float, default=8.0, help="longest 2 pi/p [s] (default 8)")
    parser.add_argument("--points", type=int, default=200, help="number of block sizes (default 200)")
    add_restitution(parser)
    add_records(parser)


def _run(arguments: argparse.Namespace, report: Report) -> None:
    check_points(arguments.points, 1)
    if not arguments.slenderness > 0:
        raise ValueError(f"Argument `--slenderness` must be positive, but is {arguments.slenderness}.")
    check_range("--shortest, --longest", (arguments.shortest, arguments.longest))
    files = each_once(files_of(arguments.records))
    motion = scaled_record(next(iter(files), None), arguments) if len(files) < 2 else _suite(files, arguments, report)
    period = np.linspace(arguments.shortest, arguments.longest, arguments.points)
    alpha = np.arctan(1 / arguments.slenderness)
    result = rk.rocking_spectrum(
        alpha, motion, period, arguments.restitution, model_of(arguments), opens=arguments.opens
    )
    known = ~np.asarray(result.is_open)
    lost = np.asarray(result.overturned) & known
    entries = [
        Entry("slenderness", "slenderness, height/width", arguments.slenderness, "g"),
        Entry("block_sizes", "block sizes", period.size),
    ]
    if isinstance(motion, rk.motions.Suite):
        report.title(f"{len(motion)} records")
        left_out = left_out_of_folders(arguments.records)
        entries += _entries_of_suite(result, period, lost, len(files) - len(motion), left_out)
    else:
        report.title(motion.name or "unnamed record")
        entries += [
            Entry("overturned", "of these overturn", int(lost.sum())),
            _longest("longest_overturned", "longest 2 pi/p that overturns", period[lost]),
        ]
    report.table([*entries, Entry("not_computed", "not computed", int(np.sum(~known)))])
    peaks = (result.rotation_ratio, result.velocity_ratio, result.impact_count, lost, result.margin)
    columns = [np.where(known, np.asarray(each, float), np.nan) for each in peaks]  # NaN marks what is not a result
    if isinstance(motion, rk.motions.Suite):
        names, sizes = np.repeat(motion.names, period.size), np.tile(period, len(motion))
        columns = [sizes, *map(np.ravel, columns)]
        write_named_table(report, arguments.out, "spectrum.csv", f"record,{_HEADER}", names, *columns)
    else:
        write_table(report, arguments.out, "spectrum.csv", _HEADER, period, *columns)
    save(report, arguments.out, "spectrum.png", rk.plot.spectrum(result)[0].figure)
    check_surface(report, result.status)


def _entries_of_suite(
    result: rk.studies.Spectrum, period: np.ndarray, lost: np.ndarray, not_read: int, left_out: int
) -> list[Entry]:
    """Return lines of the table for several records."""
    median, _ = result.percentiles(50.0)
    return [
        Entry("records", "records", len(lost)),
        Entry("not_read", "files that could not be read", not_read),
        Entry("left_out", "files of folders without an ending of records", left_out),
        Entry("scenes", "scenes", lost.size),
        Entry("overturned", "of these overturn", int(lost.sum())),
        _longest("longest_overturned", "longest 2 pi/p that overturns", period[lost.any(axis=0)]),
        _longest("longest_half_overturned", "longest 2 pi/p that half overturn", period[np.isinf(median[0])]),
    ]


def _longest(key: str, label: str, periods: np.ndarray) -> Entry:
    """Return a line with the longest of some periods, or "none"."""
    return Entry(key, label, periods.max(), ".3f", "s") if periods.size else Entry(key, label, None, shown="none")


def _suite(files: list[str], arguments: argparse.Namespace, report: Report) -> rk.motions.Suite:
    """Read files into a suite; report each that cannot be read, or with `--strict` raise for the first."""
    read = {}
    for path in files:
        try:
            read[path] = scaled_record(path, arguments)
            rk.motions.Suite([read[path]])  # raises for a record that does not move
        except (ValueError, OSError) as error:
            read.pop(path, None)
            reason = f"{path} was not read: {as_typed(str(error), arguments)}"
            if arguments.strict:
                raise ValueError(reason) from error
            report.failed(reason)
    if not read:
        raise ValueError(f"None of {len(files)} files could be read.")
    return rk.motions.Suite(list(read.values()), _names(list(read)))


def _names(paths: list[str]) -> list[str]:
    """Return names of files, or their paths where two files have one name."""
    names = [os.path.basename(path) for path in paths]
    return names if len(set(names)) == len(names) else paths


SPECTRUM = Command(
    "spectrum",
    "rocking spectrum of records: peak response against block size",
    _add_options,
    _run,
    writes=lambda _: ("spectrum.csv", "spectrum.png"),
)
