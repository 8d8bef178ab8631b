"""The command `jaxrock invert`: estimate the pulse that a table of rocks allows, with figures and tables."""

import argparse
from collections.abc import Iterator
from inspect import Parameter
from pathlib import Path
from typing import Any

import numpy as np

import jaxrock as rk
from jaxrock.command_line.command import Command
from jaxrock.command_line.options import check_points, check_range, extent_of, model_of, other_parameters, plain_float
from jaxrock.command_line.output import Report, plain
from jaxrock.command_line.results import ResultFolder
from jaxrock.inverse.observation_files import EXAMPLE
from jaxrock.inverse.observations import SEEN, SEEN_TOPPLED
from jaxrock.motions.pulses import PULSES, UNITS

_FILES, _WALL = ("estimate.csv", "probabilities.csv", "region.csv", "region.png"), "unexceeded.csv"
# Default ranges of parameters that have no default value, and are therefore estimated, too.
_RANGES = {"shape": (-6.0, 6.0)}


def _estimated(word: str) -> list[str]:
    """Return the unknown parameters of a pulse beyond amplitude and period or duration: those without a default."""
    return [name for name, default in other_parameters(PULSES[word]).items() if default is Parameter.empty]


def _all_estimated() -> list[str]:
    """Return the parameters that are unknown for at least one pulse."""
    return list(dict.fromkeys(name for word in PULSES for name in _estimated(word)))


class _Example(argparse.Action):
    """Option that prints an example of a file of rocks and exits, without the required arguments."""

    def __init__(self, **given):
        super().__init__(nargs=0, **given)

    def __call__(self, parser, *_):
        print(EXAMPLE, end="")
        parser.exit()


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--example", action=_Example, help="print an example of such a file, and leave")
    parser.add_argument(
        "rocks",
        help="CSV file of rocks (--example prints one). Columns: name; alpha_deg or alpha_rad, with half_diagonal_m or "
        "p_rad_per_s, or else width_m and height_m; restitution; observed (survived, toppled, rotation); rotation_deg "
        "or rotation_rad. Of two unlike sides: alpha1_deg and alpha2_deg or alpha1_rad and alpha2_rad, with radius1_m "
        "and radius2_m or p1_rad_per_s and p2_rad_per_s; inertia_ratio; facing. Standard deviations: alpha_deg_sd etc.",
    )
    parser.add_argument("--pulse", choices=tuple(PULSES), default="sine", help="kind of motion (default sine)")
    ends: dict[str, Any] = {"type": plain_float, "nargs": 2, "metavar": ("FROM", "TO")}
    parser.add_argument("--amplitude", default=(0.02, 3.0), help="range of the amplitude [g] (default 0.02 3)", **ends)
    parser.add_argument(
        "--duration", default=(0.1, 5.0), help="range of duration or period [s] (default 0.1 5)", **ends
    )
    for name in _all_estimated():
        words = ", ".join(word for word in PULSES if name in _estimated(word))
        known = _RANGES.get(name)
        shown = "" if known is None else f" (default {known[0]:g} {known[1]:g})"
        parser.add_argument(f"--{name}", help=f"range of the {name} of the pulse {words}{shown}", **ends)
    parser.add_argument(
        "--scatter",
        type=plain_float,
        default=0.3,
        help="standard deviation of ln amplitude from rock to rock (default 0.3)",
    )
    parser.add_argument(
        "--lapse",
        type=plain_float,
        default=0.02,
        help="probability that what was seen of a rock says nothing: moved, misjudged (default 0.02)",
    )
    parser.add_argument(
        "--prior",
        nargs=3,
        action="append",
        default=[],
        metavar=("PARAMETER", "MEDIAN", "SD"),
        help="what is known beforehand of amplitude, duration (or period) or shape, with the standard deviation of its "
        "logarithm (of the shape itself): the estimate is the most probable motion then; once for each",
    )
    parser.add_argument(
        "--starts", type=int, default=64, help="points from which the maximum is looked for (default 64)"
    )
    parser.add_argument("--points", type=int, default=48, help="points along each axis of the map (default 48)")


def _run(arguments: argparse.Namespace, report: Report) -> None:
    observations, model = rk.inverse.read_observations(arguments.rocks), model_of(arguments)
    check_points(arguments.points, 2)
    pulse, scatter, lapse = PULSES[arguments.pulse], arguments.scatter, arguments.lapse
    extent = extent_of(pulse)
    priors = _priors(arguments.prior, arguments.pulse)
    unknowns = _unknowns(arguments, priors)
    starts = arguments.starts
    estimate = rk.inverse.estimate_motion(
        observations, pulse, unknowns, scatter, lapse=lapse, starts=starts, model=model
    )
    fixed = {name: estimate[name] for name in estimate.names[2:]}
    axes = {
        "amplitude": np.geomspace(*arguments.amplitude, arguments.points),
        extent: np.geomspace(*arguments.duration, arguments.points),
    }
    likelihood = rk.inverse.Likelihood(observations, pulse, scatter, model, lapse=lapse)
    region = rk.inverse.feasible_region(likelihood, axes, fixed)
    wall = None
    if np.any(np.asarray(observations.seen) != SEEN_TOPPLED):
        wall = rk.inverse.unexceeded_motion(observations, lambda a, t: pulse(a, t, **fixed), axes[extent], model=model)
    files = _write(arguments.out, observations, estimate, region, wall)
    report.say(_text(observations, estimate, ", with the priors" if priors else ""))
    report.results |= _results(observations, estimate)
    _report_rest(report, estimate.status, files)


def _unknowns(arguments: argparse.Namespace, priors: dict) -> dict[str, rk.inverse.Unknown]:
    """Return the unknown parameters with their ranges and priors."""
    for name in ("amplitude", "duration"):
        check_range(f"--{name}", getattr(arguments, name))
    for name in _all_estimated():
        if getattr(arguments, name) is not None and name not in _estimated(arguments.pulse):
            raise ValueError(f"Argument `--{name}` is not a parameter of the pulse {arguments.pulse}.")
    unknowns = {
        "amplitude": rk.inverse.Unknown(*arguments.amplitude, prior=priors.get("amplitude")),
        extent_of(PULSES[arguments.pulse]): rk.inverse.Unknown(*arguments.duration, prior=priors.get("duration")),
    }
    for name in _estimated(arguments.pulse):
        ends = getattr(arguments, name) or _RANGES.get(name)
        if ends is None:
            raise ValueError(f"Argument `--{name}` must be given for the pulse {arguments.pulse}, but is None.")
        unknowns[name] = rk.inverse.Unknown(*ends, log=False, prior=priors.get(name))
    return unknowns


def _report_rest(report: Report, status: rk.inverse.EstimateStatus, files: list[Path]) -> None:
    """Tell what became of an estimate, and the files; without a result it has failed."""
    kinds = rk.inverse.EstimateStatus
    if status != kinds.successful:
        report.say(kinds[status])
    for path in files:
        report.wrote(path)
    if any(bool(status == kind) for kind in (kinds.contradictory, kinds.not_converged, kinds.not_computed)):
        report.failed(kinds[status])


def _priors(given: list[list[str]], pulse: str) -> dict[str, tuple[float, float]]:
    """Return the median and standard deviation of each prior by name."""
    known = ("amplitude", "duration", *_estimated(pulse))
    priors = {}
    for word, *numbers in given:
        name = "duration" if word == "period" else word  # users may give the name that the estimate prints
        if name not in known:
            raise ValueError(f"Argument `--prior` must name one of {', '.join(known)}, but names {word}.")
        if name in priors:
            raise ValueError(f"Argument `--prior` must name {name} at most once, but does so twice.")
        try:
            median, deviation = plain_float(numbers[0]), plain_float(numbers[1])
        except ValueError:
            said = f"{name} {' '.join(numbers)}"
            raise ValueError(f"Argument `--prior` must end with two numbers, but is {said}.") from None
        if not deviation > 0 or not (median > 0 or name in _RANGES):
            said = f"{name} {' '.join(numbers)}"
            raise ValueError(f"Argument `--prior` must end with a positive median and deviation, but is {said}.")
        priors[name] = median, deviation
    return priors


def _write(
    folder: ResultFolder,
    observations: rk.inverse.Observations,
    estimate: rk.inverse.Estimate,
    region: rk.inverse.FeasibleRegion,
    wall: rk.inverse.Unexceeded | None,
) -> list[Path]:
    """Write tables and the figure; return their paths."""
    files = list(_FILES)
    with folder.whole(files[0]) as aside, aside.open("w", encoding="utf-8") as file:
        print("parameter,unit,value,low,high,low_is_open,high_is_open", file=file)
        for name, value, interval, open_ in _rows(estimate):
            ends = ",".join(f"{float(x):.6g}" for x in interval)
            flags = ",".join(str(int(x)) for x in open_)
            print(f"{name},{UNITS.get(name, '')},{float(value):.6g},{ends},{flags}", file=file)
    with folder.whole(files[1]) as aside, aside.open("w", encoding="utf-8") as file:
        shapes = _shapes(observations)
        print(f"name,{','.join(shapes)},observed,probability", file=file)
        known = np.asarray(observations.seen), np.asarray(estimate.probability)
        rows = zip(observations.names, zip(*shapes.values()), *known)
        for name, shape, seen, probability in rows:
            numbers = ",".join(f"{float(x):.6g}" for x in shape)
            print(f"{_quoted(name)},{numbers},{SEEN[int(seen)]},{float(probability):.4g}", file=file)
    rows, columns = np.meshgrid(*region.values, indexing="ij")
    header = ",".join(f"{name}_{UNITS.get(name, '')}" for name in region.names) + ",log_likelihood,allowed"
    flat = (np.ravel(x).astype(float) for x in (rows, columns, region.log_likelihood, region.allowed))
    with folder.whole(files[2]) as aside:
        np.savetxt(aside, np.column_stack(list(flat)), delimiter=",", header=header, comments="", fmt="%.8g")
    folder.discard(_WALL)  # left by an earlier run
    if wall is not None:
        files.append(_WALL)
        with folder.whole(_WALL) as aside, aside.open("w", encoding="utf-8") as file:
            print("duration_s,amplitude_g,rock,complete", file=file)
            columns = map(np.asarray, (wall.durations, wall.amplitude, wall.weakest, wall.complete))
            for duration, amplitude, rock, complete in zip(*columns):
                name = _quoted(observations.names[int(rock)]) if rock >= 0 else ""
                print(f"{float(duration):.8g},{float(amplitude):.8g},{name},{int(complete)}", file=file)
    figure: Any = rk.plot.feasible_region(region, estimate, wall).figure
    with folder.whole(files[3]) as aside:
        figure.savefig(aside, dpi=150, format="png")
    return [folder.path / name for name in files]


def _rows(estimate: rk.inverse.Estimate) -> Iterator[tuple]:
    """Iterate over name, value, interval and open ends of all parameters."""
    return zip(estimate.names, *map(np.asarray, (estimate.values, estimate.interval, estimate.open)))


def _shapes(observations: rk.inverse.Observations) -> dict[str, np.ndarray]:
    """Return slenderness angles and frequency parameters by column."""
    blocks = observations.blocks
    names = ("alpha", "p") if observations.other is None else ("alpha1", "alpha2", "p1", "p2")
    units = {"a": "rad", "p": "rad_per_s"}
    return {f"{name}_{units[name[0]]}": np.asarray(getattr(blocks, name)) for name in names}


def _quoted(name: str) -> str:
    """Quote a name as a field of a CSV file."""
    return '"' + name.replace('"', '""') + '"'


def _text(observations: rk.inverse.Observations, estimate: rk.inverse.Estimate, more: str) -> str:
    seen = np.asarray(observations.seen)
    lines = [f"{seen.size} rocks: " + ", ".join(f"{int(np.sum(seen == k))} {word}" for k, word in enumerate(SEEN))]
    ways = np.asarray(observations.ways)
    unknown = int(np.sum(ways[0] != ways[-1]))
    if unknown:
        lines.append(f"  {unknown} of them may stand either way round in the direction of the shaking")
    for name, value, (low, high), (below, above) in _rows(estimate):
        ends = f"{'<' if below else ''}{float(low):.4g} to {'>' if above else ''}{float(high):.4g}"
        ends = ends if np.isfinite(float(low)) else "no interval"
        lines.append(f"  {name:<10} {float(value):10.4g} {UNITS.get(name, ''):<2}  95 %: {ends}")
    lines.append(f"  log-likelihood {float(estimate.log_likelihood):.3f}{more}, scatter {float(estimate.scatter):g}")
    return "\n".join([*lines, *estimate.remarks])


def _results(observations: rk.inverse.Observations, estimate: rk.inverse.Estimate) -> dict:
    """Return the results for the JSON output, which programs read."""
    seen = np.asarray(observations.seen)
    parameters = {
        name: {"value": value, "unit": UNITS.get(name, ""), "interval_95": interval, "open": open_}
        for name, value, interval, open_ in _rows(estimate)
    }
    return plain({
        "rocks": {word: int(np.sum(seen == k)) for k, word in enumerate(SEEN)},
        "parameters": parameters,
        "log_likelihood": estimate.log_likelihood,
        "scatter": estimate.scatter,
        "status": rk.inverse.EstimateStatus[estimate.status],
        "remarks": estimate.remarks,
    })  # fmt: skip


INVERT = Command(
    "invert",
    "motions that rocks which stand, or fell, allow: estimates, intervals, maps",
    _add_options,
    _run,
    writes=lambda _: (*_FILES, _WALL),
)
