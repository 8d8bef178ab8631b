"""The command `jaxrock map`: overturning of blocks under a pulse, over its frequency and intensity."""

import argparse

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import (
    add_pulse,
    add_restitution,
    check_points,
    check_range,
    model_of,
    plain_float,
    pulse_of,
)
from jaxrock.command_line.output import Entry, Report, check_surface, save, write_table

# Horizontal and vertical axes: whether they are those of single-lobe pulses, the default range, and the meaning.
_AXES = {
    "frequency_ratio": (False, (0.3, 8.0), "2 pi/period of the pulse over p"),
    "intensity": (False, (1.02, 10.0), "peak acceleration (amplitude of the pulse) over the uplift threshold"),
    "pulse_duration": (
        True,
        (0.05, 8.0),
        "p times the duration or period: with the strength of uplift, in place of the two above",
    ),
    "uplift_strength": (True, (0.02, 0.98), "uplift threshold over peak acceleration: with the duration of the pulse"),
}


def _add_options(parser: argparse.ArgumentParser) -> None:
    add_restitution(parser)
    parser.add_argument("--alpha", type=plain_float, default=0.2, help="slenderness angle [rad] (default 0.2)")
    for name, (_, ends, meaning) in _AXES.items():
        words = f"{meaning} (default {ends[0]:g} {ends[1]:g})"
        parser.add_argument(
            "--" + name.replace("_", "-"), type=plain_float, nargs=2, metavar=("FROM", "TO"), help=words
        )
    parser.add_argument("--points", type=int, default=128, help="points along each axis (default 128)")
    parser.add_argument("--pixels", action="store_true", help="draw the points' verdicts alone, not the exact borders")
    add_pulse(parser)


def _run(arguments: argparse.Namespace, report: Report) -> None:
    check_points(arguments.points, 2)
    by_duration, axes = _axes(arguments)
    result = rk.overturning_map(
        **axes,
        alpha=arguments.alpha,
        restitution=arguments.restitution,
        opens=arguments.opens,
        pulse=pulse_of(arguments),
        model=model_of(arguments),
    )
    state = np.asarray(result.state)
    names = {0: "safe", 1: "overturned without impact", 2: "overturned after impacts", -1: "not computed"}
    counts = {name: int((state == key).sum()) for key, name in names.items()}
    report.table([Entry(name.replace(" ", "_"), name, count, unit="scenes") for name, count in counts.items()])
    columns, rows = np.meshgrid(*axes.values())
    write_table(report, arguments.out, "map.csv", ",".join(axes) + ",state,rotation_ratio,impacts,margin",
              *(np.ravel(x) for x in (columns, rows, state, result.rotation_ratio, result.impact_count, result.margin)),
              )  # fmt: skip
    exact = False if arguments.pixels else None
    save(report, arguments.out, "map.png", rk.plot.overturning(result, by_duration=by_duration, exact=exact).figure)
    check_surface(report, result.status)


def _axes(arguments: argparse.Namespace) -> tuple[bool, dict[str, np.ndarray]]:
    """Return whether the axes are pulse duration and uplift strength, and both axes by name."""
    given = {name: getattr(arguments, name) for name in _AXES if getattr(arguments, name) is not None}
    kinds = {_AXES[name][0] for name in given} or {False}
    if len(kinds) > 1:
        options = ", ".join("--" + name.replace("_", "-") for name in given)
        raise ValueError(f"Options {options} must not go together: give frequency ratio and intensity, or the others.")
    (by_duration,) = kinds
    axes = {}
    for name, (of_lobes, ends, _) in _AXES.items():
        if of_lobes == by_duration:
            low, high = given.get(name, ends)
            check_range("--" + name.replace("_", "-"), (low, high))
            axes[name] = np.linspace(low, high, arguments.points)
    return by_duration, axes


MAP = Command(
    "map",
    "overturning map: intensity against frequency of a pulse",
    _add_options,
    _run,
    writes=lambda _: ("map.csv", "map.png"),
)
