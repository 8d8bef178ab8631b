"""The command `jaxrock run`: one block under a record, with its history, impacts and figures."""

import argparse
import sys
from pathlib import Path

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import add_record, add_restitution, model_of, number, record_of
from jaxrock.command_line.output import save, table, write_csv


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--width", type=number, default=0.6, help="full width [m] (default 0.6)")
    parser.add_argument("--height", type=number, default=3.0, help="full height [m] (default 3)")
    parser.add_argument(
        "--duration", type=number, help="how long to follow the block [s] (default: a little past the record)"
    )
    parser.add_argument(
        "--animate", nargs="?", const="gif", choices=("gif", "html", "mp4"), help="also write a film (default gif)"
    )
    add_restitution(parser)
    add_record(parser)


def _run(arguments: argparse.Namespace) -> int:
    record, model = record_of(arguments), model_of(arguments)
    block = rk.Block.from_dimensions(arguments.width, arguments.height, arguments.restitution)
    response = rk.simulate(block, record, model, duration=arguments.duration)
    result = rk.outcome(block, record, model)
    size = ("block, width x height", f"{arguments.width:g} x {arguments.height:g}", "m")
    print(f"{record.name or 'unnamed record'}\n{table(_rows(size, block, record, model, result))}")
    _write(arguments.out, response)
    if arguments.animate:
        path = arguments.out / f"animation.{arguments.animate}"
        rk.plot.save_animation(rk.plot.animate(response, block, fps=12), path)
        print(f"wrote {path}")
    good = (result.status == rk.Status.successful) & (response.status == rk.Status.successful)
    if not good:
        worse = response.status if response.status != rk.Status.successful else result.status
        print(f"jaxrock: these are not results: {rk.Status[worse]}", file=sys.stderr)
    return 0 if good else 1


def _rows(size: tuple[str, str, str], block: rk.Block, record: rk.Record, model, result: rk.responses.Outcome) -> list:
    """Lines of the table that is printed."""
    alpha, lost = float(block.alpha), bool(result.overturned)
    peak = float(np.max(np.abs(record.samples)))

    def unless_lost(value: str, unit: str, otherwise: str = "overturned") -> tuple[str, str]:
        return (otherwise, "") if lost else (value, unit)

    return [
        ("peak ground acceleration", f"{peak:.4f}", "g"),
        size,
        ("slenderness alpha", f"{alpha:.4f}", "rad"),
        ("frequency parameter p", f"{float(block.p):.4f}", "rad/s"),
        ("restitution", f"{float(block.restitution):.4f}", ""),
        ("uplift threshold", f"{float(model.moments(block).threshold):.4f}", "g"),
        ("impacts", f"{int(result.impact_count)}", ""),
        ("peak rotation", *unless_lost(f"{float(result.max_rotation):.6f}", "rad")),
        ("peak rotation / alpha", *unless_lost(f"{float(result.max_rotation) / alpha:.6f}", "")),
        ("at time", *unless_lost(f"{float(result.time_of_max):.4f}", "s", otherwise="-")),
        ("peak angular velocity", *unless_lost(f"{float(result.max_velocity):.6f}", "rad/s")),
        ("margin (0: boundary)", f"{float(result.margin):+.4f}", ""),
        ("verdict", "OVERTURNS" if lost else "stands", ""),
    ]


def _write(folder: Path, response: rk.responses.Response) -> None:
    """Files and figures of the response."""
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "history.csv", "time_s,rotation_rad,velocity_rad_per_s", response.time,
              response.rotation, response.velocity)  # fmt: skip
    write_csv(folder / "impacts.csv", "time_s,velocity_before_rad_per_s", response.impact_times,
              response.impact_velocities)  # fmt: skip
    print(f"wrote {folder / 'history.csv'}\nwrote {folder / 'impacts.csv'}")
    save(rk.plot.history(response)[0].figure, folder / "history.png")
    save(rk.plot.phase(response).figure, folder / "phase.png")


RUN = Command("run", "simulate one block under a record", _add_options, _run)
