"""The command `jaxrock run`: one block under a record, with its history, impacts and figures."""

import argparse

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import add_record, add_restitution, model_of, plain_float, record_of
from jaxrock.command_line.output import Entry, Report, save, write_table
from jaxrock.command_line.results import ResultFolder
from jaxrock.status import is_decided

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
    width, height = arguments.width, arguments.height
    block = rk.Block.from_dimensions(width, height, arguments.restitution, opens=arguments.opens)
    response = rk.simulate(block, record, model, duration=arguments.duration)
    result = rk.outcome(block, record, model)
    report.title(record.name or "unnamed record")
    size = Entry("width_and_height", "block, width x height", (width, height), unit="m",
                 shown=f"{width:g} x {height:g}")  # fmt: skip
    report.table(_entries(size, block, record, model, result, response))
    _write(report, arguments.out, response)
    if arguments.animate:
        _film(report, arguments.out, _film_of(arguments.animate), response, block)
    _say_what_is_known(report, result, response)


def _say_what_is_known(report: Report, result: rk.responses.Outcome, response: rk.responses.Response) -> None:
    """Report a failure where the numbers are not results, and say what chaotic rocking leaves unknown."""
    # The verdict of the history is that of the outcome, which tells more.
    failed = not (is_decided(response.status) or response.status == rk.Status.undecided)
    for status, lost in ((response.status, failed), (result.status, not is_decided(result.status))):
        if lost:
            return report.failed(f"these are not results: {rk.Status[status]}")
    if result.status == rk.Status.chaotic:
        report.say(rk.Status[result.status])


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
        *_impacts(result, len(response.impact_times), float(response.duration)),
        Entry("peak_rotation", "peak rotation", unless_lost(result.max_rotation), ".6f", "rad", instead),
        Entry("peak_rotation_over_alpha", "peak rotation / alpha", unless_lost(ratio), ".6f", shown=instead),
        *_error_of_peak(result),
        Entry("time_of_peak", "at time", unless_lost(result.time_of_max), ".4f", "s", "-" if lost else None),
        Entry("peak_velocity", "peak angular velocity", unless_lost(result.max_velocity), ".6f", "rad/s", instead),
        Entry("margin", "margin (0: boundary)", float(result.margin), "+.4f"),
        Entry("overturned", "verdict", lost, shown="OVERTURNS" if lost else "stands"),
        *_what_is_open(result),
    ]


def _impacts(result: rk.responses.Outcome, of_history: int, duration: float) -> list[Entry]:
    """Return numbers of impacts: of large ones, of all, and of all in the history of the files if it differs."""
    large, every = int(result.large_impact_count), int(result.impact_count)
    entries = [
        Entry("impacts", "impacts during the motion, above 1e-6 alpha", large),
        Entry("impacts_to_rounding", "with hops down to rounding", every),
    ]
    if of_history != every:
        entries.append(Entry("impacts_of_history", f"with these in {duration:g} s of history", of_history))
    return entries


def _error_of_peak(result: rk.responses.Outcome) -> list[Entry]:
    """Return the error of the peak, where chaotic rocking makes it large."""
    if result.status != rk.Status.chaotic or bool(result.overturned):
        return []
    return [Entry("peak_rotation_error", "known to a standard error of", float(result.error), ".6f", "rad")]


def _what_is_open(result: rk.responses.Outcome) -> list[Entry]:
    """Return the share that overturns where the verdict is open, and the time at which errors outgrow the rotation."""
    entries = []
    if result.status == rk.Status.undecided:
        share = float(result.overturned_share)
        entries = [Entry("overturned_share", "share of possible motions that overturns", share, ".2f")]
    until = float(result.known_until)
    return entries + ([Entry("known_until", "one of many motions after", until, ".2f", "s")] if until < np.inf else [])


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
