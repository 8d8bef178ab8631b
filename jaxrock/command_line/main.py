"""The command line: simulate a block under a record, its spectrum, an overturning map; motions that rocks allow."""

import argparse
import contextlib
import sys
from pathlib import Path

import jax
import numpy as np

from jaxrock.command_line.invert import add_options, invert

_EPILOG = """examples:
  jaxrock run                                     a 0.6 m x 3 m block under the built-in 1979 record
  jaxrock run motion.AT2 --width 0.5 --height 2   the same for your block and record
  jaxrock run data.csv --dt 0.01 --unit cm/s2     a column of numbers
  jaxrock spectrum motion.AT2 --slenderness 5     blocks of height/width 5, every size
  jaxrock map --pulse cosine --points 200         who overturns under a pulse
  jaxrock invert rocks.csv --scatter 0.2          what motion rocks that stand or fell allow
"""


_PULSES = {
    "sine": "SinePulse",
    "cosine": "CosinePulse",
    "ricker": "RickerPulse",
    "half-sine": "HalfSinePulse",
    "rectangle": "RectangularPulse",
    "triangle": "TriangularPulse",
}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jaxrock",
        description="Rocking and overturning of free-standing blocks under earthquakes.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name, help=text, description=text, epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        sub.add_argument("--model", choices=("housner", "linear"), default="housner", help="equation of motion")
        sub.add_argument("--out", type=Path, default=Path("results"), help="folder for figures and tables")
        return sub

    run = command("run", "simulate one block under a record")
    run.add_argument("--width", type=float, default=0.6, help="full width [m] (default 0.6)")
    run.add_argument("--height", type=float, default=3.0, help="full height [m] (default 3)")
    run.add_argument(
        "--duration", type=float, help="how long to follow the block [s] (default: a little past the record)"
    )
    spectrum = command("spectrum", "rocking spectrum of a record: peak response against block size")
    spectrum.add_argument("--slenderness", type=float, default=5.0, help="height/width of the blocks (default 5)")
    spectrum.add_argument("--shortest", type=float, default=0.5, help="shortest 2 pi/p [s] (default 0.5)")
    spectrum.add_argument("--longest", type=float, default=8.0, help="longest 2 pi/p [s] (default 8)")
    spectrum.add_argument("--points", type=int, default=200, help="number of block sizes (default 200)")
    surface = command("map", "overturning map: intensity against frequency of a pulse")
    for sub in (run, spectrum, surface):
        sub.add_argument("--restitution", type=float, help="angular velocity after/before impact (default: Housner's)")
    for sub in (run, spectrum):
        sub.add_argument(
            "record", nargs="?", help="PEER AT2, CSMIP V2, CSV or text file (default: the built-in record)"
        )
        sub.add_argument("--dt", type=float, help="time between samples [s], for files that do not say")
        sub.add_argument("--unit", help="g, m/s2 or cm/s2, for files that do not say")
        sub.add_argument("--column", type=int, help="column of a CSV, or channel of a V2 file, from 0")
        sub.add_argument("--scale", type=float, default=1.0, help="factor on the acceleration (default 1)")
    rocks = command("invert", "motions that rocks which stand, or fell, allow: estimates, intervals, maps")
    add_options(rocks)
    surface.add_argument("--pulse", choices=tuple(_PULSES), default="sine", help="shape of the pulse (default sine)")
    surface.add_argument("--alpha", type=float, default=0.2, help="slenderness angle [rad] (default 0.2)")
    surface.add_argument("--frequency-ratio", type=float, nargs=2, default=(0.3, 8.0), metavar=("FROM", "TO"))
    surface.add_argument("--intensity", type=float, nargs=2, default=(1.02, 10.0), metavar=("FROM", "TO"))
    surface.add_argument("--points", type=int, default=128, help="points along each axis (default 128)")
    return parser


def _motion(arguments):
    import jaxrock as rk

    if arguments.record is None:
        for option in ("dt", "unit", "column"):
            if getattr(arguments, option) is not None:
                raise ValueError(f"Option --{option} describes a file, but no RECORD is given.")
        record = rk.example_record()
    else:
        record = rk.read_record(arguments.record, dt=arguments.dt, unit=arguments.unit, column=arguments.column)
    samples = record.samples * arguments.scale
    return rk.Record(samples, record.dt, record.name)


def _model(arguments):
    import jaxrock as rk

    return rk.Linear() if arguments.model == "linear" else rk.Housner()


def _check_range(option: str, ends) -> None:
    """Both ends of a range are positive, finite and in order."""
    low, high = ends
    if not 0 < low <= high < float("inf"):
        raise ValueError(f"Argument `{option}` must be positive, finite and in order, but is {low:g} to {high:g}.")


def _complete(status) -> int:
    """Exit status of a surface: 1, with a message, where some scenes were not computed."""
    import jaxrock as rk

    if bool(np.all(np.asarray(status == rk.Status.successful))):
        return 0
    print("jaxrock: some scenes were not computed (impacts that do not die out)", file=sys.stderr)
    return 1


def _table(rows: list[tuple[str, str, str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in (0, 1)]
    return "\n".join(f"  {name:<{widths[0]}}  {value:>{widths[1]}}  {unit}".rstrip() for name, value, unit in rows)


def _write_csv(path: Path, header: str, *columns) -> None:
    np.savetxt(path, np.column_stack([np.asarray(c, dtype=float) for c in columns]), delimiter=",", header=header,
               comments="", fmt="%.12g")  # fmt: skip


def _save(figure, path: Path) -> None:
    figure.savefig(path, dpi=150)
    print(f"wrote {path}")


def _run(arguments) -> int:
    import jaxrock as rk

    record, model = _motion(arguments), _model(arguments)
    block = rk.Block.from_dimensions(arguments.width, arguments.height, arguments.restitution)
    response = rk.simulate(block, record, model, duration=arguments.duration)
    result = rk.outcome(block, record, model)
    alpha, p = float(block.alpha), float(block.p)
    lost = bool(result.overturned)
    peak = float(np.max(np.abs(record.samples)))
    rows = [
        ("peak ground acceleration", f"{peak:.4f}", "g"),
        ("block, width x height", f"{arguments.width:g} x {arguments.height:g}", "m"),
        ("slenderness alpha", f"{alpha:.4f}", "rad"),
        ("frequency parameter p", f"{p:.4f}", "rad/s"),
        ("restitution", f"{float(block.restitution):.4f}", ""),
        ("uplift threshold", f"{float(model.moments(block).threshold):.4f}", "g"),
        ("impacts", f"{int(result.impact_count)}", ""),
        ("peak rotation", "overturned" if lost else f"{float(result.max_rotation):.6f}", "" if lost else "rad"),
        ("peak rotation / alpha", "overturned" if lost else f"{float(result.max_rotation) / alpha:.6f}", ""),
        ("at time", "-" if lost else f"{float(result.time_of_max):.4f}", "" if lost else "s"),
        (
            "peak angular velocity",
            "overturned" if lost else f"{float(result.max_velocity):.6f}",
            "" if lost else "rad/s",
        ),
        ("margin (0: boundary)", f"{float(result.margin):+.4f}", ""),
        ("verdict", "OVERTURNS" if lost else "stands", ""),
    ]
    print(f"{record.name or 'unnamed record'}\n{_table(rows)}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    _write_csv(arguments.out / "history.csv", "time_s,rotation_rad,velocity_rad_per_s", response.time,
               response.rotation, response.velocity)  # fmt: skip
    _write_csv(arguments.out / "impacts.csv", "time_s,velocity_before_rad_per_s", response.impact_times,
               response.impact_velocities)  # fmt: skip
    print(f"wrote {arguments.out / 'history.csv'}\nwrote {arguments.out / 'impacts.csv'}")
    _save(rk.plot.history(response)[0].figure, arguments.out / "history.png")
    _save(rk.plot.phase(response).figure, arguments.out / "phase.png")
    good = (result.status == rk.Status.successful) & (response.status == rk.Status.successful)
    if not good:
        worse = response.status if response.status != rk.Status.successful else result.status
        print(f"jaxrock: these are not results: {rk.Status[worse]}", file=sys.stderr)
    return 0 if good else 1


def _spectrum(arguments) -> int:
    import jaxrock as rk

    if arguments.points < 1:
        raise ValueError(f"Argument `--points` must be at least 1, but is {arguments.points}.")
    if not arguments.slenderness > 0:
        raise ValueError(f"Argument `--slenderness` must be positive, but is {arguments.slenderness}.")
    _check_range("--shortest, --longest", (arguments.shortest, arguments.longest))
    record = _motion(arguments)
    period = np.linspace(arguments.shortest, arguments.longest, arguments.points)
    alpha = np.arctan(1 / arguments.slenderness)
    result = rk.rocking_spectrum(alpha, record, period, arguments.restitution, _model(arguments))
    lost = np.asarray(result.overturned)
    rows = [
        ("slenderness, height/width", f"{arguments.slenderness:g}", ""),
        ("block sizes", f"{period.size}", ""),
        ("of these overturn", f"{int(lost.sum())}", ""),
        (
            "longest 2 pi/p that overturns",
            f"{period[lost].max():.3f}" if lost.any() else "none",
            "s" if lost.any() else "",
        ),
        ("not computed", f"{int(np.sum(~np.asarray(result.status == rk.Status.successful)))}", ""),
    ]
    print(f"{record.name or 'unnamed record'}\n{_table(rows)}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    header = "two_pi_over_p_s,max_rotation_over_alpha,max_velocity_over_p_alpha,impacts,overturned,margin"
    _write_csv(arguments.out / "spectrum.csv", header, period, result.max_rotation, result.max_velocity,
               result.impact_count, lost, result.margin)  # fmt: skip
    print(f"wrote {arguments.out / 'spectrum.csv'}")
    _save(rk.plot.spectrum(result)[0].figure, arguments.out / "spectrum.png")
    return _complete(result.status)


def _map(arguments) -> int:
    import jaxrock as rk

    if arguments.points < 2:
        raise ValueError(f"Argument `--points` must be at least 2, but is {arguments.points}.")
    _check_range("--frequency-ratio", arguments.frequency_ratio)
    _check_range("--intensity", arguments.intensity)
    ratio = np.linspace(*arguments.frequency_ratio, arguments.points)
    intensity = np.linspace(*arguments.intensity, arguments.points)
    result = rk.overturning_map(
        ratio,
        intensity,
        alpha=arguments.alpha,
        restitution=arguments.restitution,
        pulse=getattr(rk, _PULSES[arguments.pulse]),
        model=_model(arguments),
    )
    state = np.asarray(result.state)
    names = {0: "safe", 1: "overturned without impact", 2: "overturned after impacts", -1: "not computed"}
    print(_table([(name, f"{int((state == key).sum())}", "scenes") for key, name in names.items()]))
    arguments.out.mkdir(parents=True, exist_ok=True)
    columns, rows = np.meshgrid(ratio, intensity)
    _write_csv(arguments.out / "map.csv", "frequency_ratio,intensity,state,max_rotation_over_alpha,impacts,margin",
               *(np.ravel(x) for x in (columns, rows, state, result.max_rotation, result.impact_count, result.margin)),
               )  # fmt: skip
    print(f"wrote {arguments.out / 'map.csv'}")
    _save(rk.plot.overturning(result).figure, arguments.out / "map.png")
    return _complete(result.status)


def _invert(arguments) -> int:
    text, files, wrong = invert(arguments, _model(arguments))
    print(text)
    for path in files:
        print(f"wrote {path}")
    if wrong:
        print(f"jaxrock: {wrong}", file=sys.stderr)
    return 1 if wrong else 0


def main(words: list[str] | None = None) -> int:
    """Run the command line; return its exit status: 0 good, 1 not computed, 2 bad input."""
    arguments = _parser().parse_args(words)
    jax.config.update("jax_enable_x64", True)
    import matplotlib

    from jaxrock.sweeps.devices import use_cpu_devices

    matplotlib.use("Agg")
    with contextlib.suppress(RuntimeError):  # called by a program that computes already
        use_cpu_devices()
    try:
        if arguments.out.exists() and not arguments.out.is_dir():  # said before the work, not after it
            raise NotADirectoryError(f"Argument `--out` must be a folder, but {arguments.out} is a file.")
        return {"run": _run, "spectrum": _spectrum, "map": _map, "invert": _invert}[arguments.command](arguments)
    except (ValueError, OSError) as error:
        print(f"jaxrock: error: {error}", file=sys.stderr)
        return 2
