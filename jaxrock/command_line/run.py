"""The command `jaxrock run`: one block under a record, with its history, impacts and figures."""

import argparse

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import add_record, add_restitution, model_of, plain_float, record_of
from jaxrock.command_line.output import Entry, Report, save, write_table
from jaxrock.command_line.results import ResultFolder

_FILMS = ("gif", "html", "mp4")


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--width", type=plain_float, default=0.6, help="full width [m] (default 0.6)")
    parser.add_argument("--height", type=plain_float, default=3.0, help="full height [m] (default 3)")
    parser.add_argument(
        "--duration",
        type=plain_float,
        help="of the history that is drawn and written [s] (default: a little past the record); the table is of the "
        "whole motion and of what follows",
    )
    parser.add_argument(
        "--animate",
        nargs="?",
        const="gif",
        choices=_FILMS,
        help="also write a film: a GIF, or as said; none of a block that never uplifts",
    )
    add_restitution(parser)
    add_record(parser)


def _run(arguments: argparse.Namespace, report: Report) -> None:
    record, model = record_of(arguments), model_of(arguments)
    block = rk.Block.from_dimensions(arguments.width, arguments.height, arguments.restitution)
    response = rk.simulate(block, record, model, duration=arguments.duration)
    result = rk.outcome(block, record, model)
    report.title(record.name or "unnamed record")
    size = Entry("width_and_height", "block, width x height", (arguments.width, arguments.height), unit="m",
                 shown=f"{arguments.width:g} x {arguments.height:g}")  # fmt: skip
    report.table(_entries(size, block, record, model, result, response))
    _write(report, arguments.out, response)
    if arguments.animate:
        _film(report, arguments.out, _film_of(arguments.animate), response, block)
    for status in (response.status, result.status):
        if status != rk.Status.successful:
            return report.failed(f"these are not results: {rk.Status[status]}")


def _entries(
    size: Entry,
    block: rk.Block,
    record: rk.Record,
    model: rk.models.AbstractEquation,
    result: rk.responses.Outcome,
    response: rk.responses.Response,
) -> list[Entry]:
    """Return the lines of the table."""
    alpha, lost = float(block.alpha), bool(result.overturned)
    ratio, instead = float(result.max_rotation) / alpha, "overturned" if lost else None

    def unless_lost(x) -> float | None:
        return None if lost else float(x)

    return [
        Entry("peak_ground_acceleration", "peak ground acceleration", float(np.abs(record.samples).max()), ".4f", "g"),
        size,
        Entry("alpha", "slenderness alpha", alpha, ".4f", "rad"),
        Entry("p", "frequency parameter p", float(block.p), ".4f", "rad/s"),
        Entry("restitution", "restitution", float(block.restitution), ".4f"),
        Entry("uplift_threshold", "uplift threshold", float(model.moments(block).threshold), ".4f", "g"),
        *_impacts(int(result.impact_count), len(response.impact_times), float(response.duration)),
        Entry("peak_rotation", "peak rotation", unless_lost(result.max_rotation), ".6f", "rad", instead),
        Entry("peak_rotation_over_alpha", "peak rotation / alpha", unless_lost(ratio), ".6f", shown=instead),
        Entry("time_of_peak", "at time", unless_lost(result.time_of_max), ".4f", "s", "-" if lost else None),
        Entry("peak_velocity", "peak angular velocity", unless_lost(result.max_velocity), ".6f", "rad/s", instead),
        Entry("margin", "margin (0: boundary)", float(result.margin), "+.4f"),
        Entry("overturned", "verdict", lost, shown="OVERTURNS" if lost else "stands"),
    ]


def _impacts(of_motion: int, of_history: int, duration: float) -> list[Entry]:
    """Return the number of impacts during the motion, and that of the history in the files if it differs."""
    entries = [Entry("impacts", "impacts during the motion", of_motion)]
    if of_history != of_motion:
        entries.append(Entry("impacts_of_history", f"impacts in {duration:g} s of history", of_history))
    return entries


def _write(report: Report, folder: ResultFolder, response: rk.responses.Response) -> None:
    """Write files and figures of the response."""
    for ending in _FILMS:
        folder.discard(_film_of(ending))  # a film of an earlier run may show another block
    write_table(report, folder, "history.csv", "time_s,rotation_rad,velocity_rad_per_s", response.time,
              response.rotation, response.velocity)  # fmt: skip
    write_table(report, folder, "impacts.csv", "time_s,velocity_before_rad_per_s", response.impact_times,
              response.impact_velocities)  # fmt: skip
    save(report, folder, "history.png", rk.plot.history(response)[0].figure)
    save(report, folder, "phase.png", rk.plot.phase(response).figure)


def _writes(arguments: argparse.Namespace) -> tuple[str, ...]:
    film = (_film_of(arguments.animate),) if arguments.animate else ()
    return "history.csv", "impacts.csv", "history.png", "phase.png", *film


def _film_of(ending: str) -> str:
    return f"animation.{ending}"


def _film(report: Report, folder: ResultFolder, name: str, response: rk.responses.Response, block: rk.Block) -> None:
    """Write the film, which takes a minute, unless the block never moves."""
    if response.status == rk.Status.successful and float(response.max_rotation) == 0:
        return report.say("no film: the block never uplifts")
    with folder.whole(name) as aside:
        rk.plot.save_animation(rk.plot.animate(response, block, fps=12), aside)
    report.wrote(folder.path / name)


RUN = Command("run", "simulate one block under a record", _add_options, _run, writes=_writes)
