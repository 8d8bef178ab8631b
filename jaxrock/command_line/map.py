"""The command `jaxrock map`: who overturns under a pulse, over its frequency and intensity."""

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
    number,
    pulse_of,
)
from jaxrock.command_line.output import save, status_of_surface, table, write_csv


def _add_options(parser: argparse.ArgumentParser) -> None:
    add_restitution(parser)
    parser.add_argument("--alpha", type=number, default=0.2, help="slenderness angle [rad] (default 0.2)")
    parser.add_argument("--frequency-ratio", type=number, nargs=2, default=(0.3, 8.0), metavar=("FROM", "TO"))
    parser.add_argument("--intensity", type=number, nargs=2, default=(1.02, 10.0), metavar=("FROM", "TO"))
    parser.add_argument("--points", type=int, default=128, help="points along each axis (default 128)")
    add_pulse(parser)


def _run(arguments: argparse.Namespace) -> int:
    check_points(arguments.points, 2)
    check_range("--frequency-ratio", arguments.frequency_ratio)
    check_range("--intensity", arguments.intensity)
    ratio = np.linspace(*arguments.frequency_ratio, arguments.points)
    intensity = np.linspace(*arguments.intensity, arguments.points)
    result = rk.overturning_map(
        ratio,
        intensity,
        alpha=arguments.alpha,
        restitution=arguments.restitution,
        pulse=pulse_of(arguments),
        model=model_of(arguments),
    )
    state = np.asarray(result.state)
    names = {0: "safe", 1: "overturned without impact", 2: "overturned after impacts", -1: "not computed"}
    print(table([(name, f"{int((state == key).sum())}", "scenes") for key, name in names.items()]))
    arguments.out.mkdir(parents=True, exist_ok=True)
    columns, rows = np.meshgrid(ratio, intensity)
    write_csv(arguments.out / "map.csv", "frequency_ratio,intensity,state,max_rotation_over_alpha,impacts,margin",
              *(np.ravel(x) for x in (columns, rows, state, result.max_rotation, result.impact_count, result.margin)),
              )  # fmt: skip
    print(f"wrote {arguments.out / 'map.csv'}")
    save(rk.plot.overturning(result).figure, arguments.out / "map.png")
    return status_of_surface(result.status)


MAP = Command("map", "overturning map: intensity against frequency of a pulse", _add_options, _run)
