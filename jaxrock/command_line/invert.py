"""The command `jaxrock invert`: from a table of rocks to the pulse that they allow, with figures and tables."""

import argparse
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxrock.inverse.estimate import Estimate, EstimateStatus, estimate_motion
from jaxrock.inverse.feasible import FeasibleRegion, Unexceeded, feasible_region, unexceeded_motion
from jaxrock.inverse.likelihood import Likelihood
from jaxrock.inverse.observation_files import read_observations
from jaxrock.inverse.observations import SEEN, TOPPLED, Observations
from jaxrock.inverse.unknowns import Unknown
from jaxrock.models.equation import AbstractEquation
from jaxrock.motions.pulses.exponential import ExponentialPulse, RectangularPulse
from jaxrock.motions.pulses.ricker import RickerPulse
from jaxrock.motions.pulses.sinusoidal import CosinePulse, HalfSinePulse, SinePulse

_UNITS = {"amplitude": "g", "period": "s", "duration": "s", "shape": ""}


_PULSES = {
    "sine": (SinePulse, "period"),
    "cosine": (CosinePulse, "period"),
    "ricker": (RickerPulse, "period"),
    "half-sine": (HalfSinePulse, "duration"),
    "rectangle": (RectangularPulse, "duration"),
    "exponential": (ExponentialPulse, "duration"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "rocks",
        help="CSV file of rocks; columns such as alpha_deg,alpha_deg_sd,half_diagonal_m,observed; of two unlike "
        "sides alpha1_deg,alpha2_deg,radius1_m,radius2_m,facing,observed",
    )
    parser.add_argument("--pulse", choices=tuple(_PULSES), default="sine", help="kind of motion (default sine)")
    ends = {"type": float, "nargs": 2, "metavar": ("FROM", "TO")}
    parser.add_argument("--amplitude", default=(0.02, 3.0), help="range of the amplitude [g] (default 0.02 3)", **ends)
    parser.add_argument(
        "--duration", default=(0.1, 5.0), help="range of duration or period [s] (default 0.1 5)", **ends
    )
    parser.add_argument("--shape", default=(-6.0, 6.0), help="range of an exponential pulse's shape", **ends)
    parser.add_argument(
        "--scatter", type=float, default=0.3, help="standard deviation of ln amplitude from rock to rock (default 0.3)"
    )
    parser.add_argument(
        "--lapse",
        type=float,
        default=0.02,
        help="probability that what was seen of a rock says nothing: moved, misjudged (default 0.02)",
    )
    parser.add_argument(
        "--prior",
        nargs=3,
        action="append",
        default=[],
        metavar=("PARAMETER", "MEDIAN", "SD"),
        help="what is known beforehand of amplitude, duration or shape, with the standard deviation of its logarithm "
        "(of the shape itself): the estimate is the most probable motion then; once for each",
    )
    parser.add_argument(
        "--starts", type=int, default=64, help="points from which the maximum is looked for (default 64)"
    )
    parser.add_argument("--points", type=int, default=48, help="points along each axis of the map (default 48)")


def invert(arguments: argparse.Namespace, model: AbstractEquation) -> tuple[str, list[Path], str | None]:
    """Fit, draw and write; return the text to print, the files, and what is wrong where there is no result."""
    observations = read_observations(arguments.rocks)
    if arguments.points < 2:
        raise ValueError(f"Argument `--points` must be at least 2, but is {arguments.points}.")
    pulse, extent = _PULSES[arguments.pulse]
    priors = _priors(arguments.prior, arguments.pulse)
    unknowns = {
        "amplitude": Unknown(*arguments.amplitude, prior=priors.get("amplitude")),
        extent: Unknown(*arguments.duration, prior=priors.get("duration")),
    }
    if arguments.pulse == "exponential":
        unknowns["shape"] = Unknown(*arguments.shape, log=False, prior=priors.get("shape"))
    scatter, lapse = arguments.scatter, arguments.lapse
    found = estimate_motion(observations, pulse, unknowns, scatter, lapse=lapse, starts=arguments.starts, model=model)
    fixed = {name: found[name] for name in found.names[2:]}
    axes = {
        "amplitude": np.geomspace(*arguments.amplitude, arguments.points),
        extent: np.geomspace(*arguments.duration, arguments.points),
    }
    region = feasible_region(Likelihood(observations, pulse, scatter, model, lapse=lapse), axes, fixed)
    wall = None
    if bool(jnp.any(observations.seen != TOPPLED)):
        wall = unexceeded_motion(observations, lambda a, t: pulse(a, t, *fixed.values()), axes[extent], model=model)
    files = _write(arguments.out, observations, found, region, wall)
    bad = (EstimateStatus.contradictory, EstimateStatus.not_converged, EstimateStatus.not_computed)
    unusable = any(bool(found.status == each) for each in bad)
    said = EstimateStatus[found.status]
    good = found.status == EstimateStatus.successful
    text = _text(observations, found, ", with the priors" if priors else "")
    return "\n".join([text, *([] if good else [said])]), files, said if unusable else None


def _priors(given: list[list[str]], pulse: str) -> dict[str, tuple[float, float]]:
    """Median and standard deviation by name."""
    known = ("amplitude", "duration", "shape") if pulse == "exponential" else ("amplitude", "duration")
    priors = {}
    for name, *numbers in given:
        if name not in known or name in priors:
            raise ValueError(f"Argument `--prior` must name each of {', '.join(known)} at most once, but names {name}.")
        try:
            priors[name] = float(numbers[0]), float(numbers[1])
        except ValueError:
            said = f"{name} {' '.join(numbers)}"
            raise ValueError(f"Argument `--prior` must end with two numbers, but is {said}.") from None
    return priors


def _write(
    folder: Path, observations: Observations, found: Estimate, region: FeasibleRegion, wall: Unexceeded | None
) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / name for name in ("estimate.csv", "probabilities.csv", "region.csv", "region.png")]
    with files[0].open("w") as file:
        print("parameter,unit,value,low,high,low_is_open,high_is_open", file=file)
        for name, value, interval, open_ in zip(found.names, found.values, found.interval, found.open):
            ends = ",".join(f"{float(x):.6g}" for x in interval)
            flags = ",".join(str(int(x)) for x in open_)
            print(f"{name},{_UNITS[name]},{float(value):.6g},{ends},{flags}", file=file)
    with files[1].open("w") as file:
        shapes = _shapes(observations)
        print(f"name,{','.join(shapes)},observed,probability", file=file)
        rows = zip(observations.names, zip(*shapes.values()), observations.seen, found.probability)
        for name, shape, seen, probability in rows:
            numbers = ",".join(f"{float(x):.6g}" for x in shape)
            print(f"{_quoted(name)},{numbers},{SEEN[int(seen)]},{float(probability):.4g}", file=file)
    rows, columns = np.meshgrid(*region.values, indexing="ij")
    header = ",".join(f"{name}_{_UNITS[name]}" for name in region.names) + ",log_likelihood,allowed"
    flat = (np.ravel(x).astype(float) for x in (rows, columns, region.log_likelihood, region.allowed))
    np.savetxt(files[2], np.column_stack(list(flat)), delimiter=",", header=header, comments="", fmt="%.8g")
    if wall is not None:
        files.append(folder / "unexceeded.csv")
        with files[-1].open("w") as file:
            print("duration_s,amplitude_g,rock,complete", file=file)
            for duration, amplitude, rock, complete in zip(wall.durations, wall.amplitude, wall.weakest, wall.complete):
                name = _quoted(observations.names[int(rock)]) if rock >= 0 else ""
                print(f"{float(duration):.8g},{float(amplitude):.8g},{name},{int(complete)}", file=file)
    draw(region, found, wall).figure.savefig(files[3], dpi=150)
    return files


def _shapes(observations: Observations) -> dict[str, np.ndarray]:
    """Slenderness angles and frequency parameters by column."""
    blocks = observations.blocks
    names = ("alpha", "p") if observations.other is None else ("alpha1", "alpha2", "p1", "p2")
    units = {"a": "rad", "p": "rad_per_s"}
    return {f"{name}_{units[name[0]]}": np.asarray(getattr(blocks, name)) for name in names}


def _quoted(name: str) -> str:
    """A name as a field of a CSV file."""
    return '"' + name.replace('"', '""') + '"'


def draw(region: FeasibleRegion, found: Estimate | None = None, wall: Unexceeded | None = None, axis=None):
    """Draw a feasible region: the log-likelihood below its best, the 95 % region, the estimate, the unexceeded motion.

    **Arguments:**

    - `region`: a `FeasibleRegion`, its first parameter upward; both axes logarithmic if all values are positive.
    - `found`: an `Estimate`; `wall`: an `Unexceeded`; None leaves them out.
    - `axis`: matplotlib axis; None makes a figure.

    **Returns:** the axis.
    """
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    if axis is None:
        _, axis = plt.subplots(figsize=(6, 4.5), layout="constrained")
    rows, columns = (np.asarray(x) for x in region.values)
    below = np.asarray(region.log_likelihood - region.log_likelihood.max())
    shade = axis.pcolormesh(columns, rows, np.maximum(below, -20), cmap="Blues", shading="nearest", rasterized=True)
    axis.figure.colorbar(shade, ax=axis, label="log-likelihood, less that of the best", extend="min")
    axis.contour(columns, rows, below, levels=[np.log(0.05)], colors="black", linewidths=1, linestyles="solid")
    if wall is not None:
        axis.plot(
            wall.durations, wall.amplitude, color="#b3352c", linewidth=1, label="up to here all that stand, stand"
        )
    if found is not None and set(region.names) <= set(found.names):
        axis.plot(found[region.names[1]], found[region.names[0]], "k+", markersize=9, label="most likely")
    for values, scale, ticks in ((rows, axis.set_yscale, axis.yaxis), (columns, axis.set_xscale, axis.xaxis)):
        if values.min() > 0:
            scale("log")
            ticks.set_major_locator(LogLocator(subs=(1, 2, 5)))
            ticks.set_major_formatter(StrMethodFormatter("{x:g}"))
            ticks.set_minor_formatter(NullFormatter())
    axis.set(xlim=(columns.min(), columns.max()), ylim=(rows.min(), rows.max()))
    unit = [f"{name} [{_UNITS[name]}]" if _UNITS.get(name) else name for name in region.names]
    axis.set(ylabel=unit[0], xlabel=unit[1])
    if wall is not None or found is not None:
        axis.legend(frameon=False, fontsize=8)
    return axis


def _text(observations: Observations, found: Estimate, more: str) -> str:
    seen = np.asarray(observations.seen)
    lines = [f"{seen.size} rocks: " + ", ".join(f"{int(np.sum(seen == k))} {word}" for k, word in enumerate(SEEN))]
    unknown = int(np.sum(observations.ways[0] != observations.ways[-1]))
    if unknown:
        lines.append(f"  {unknown} of them may stand either way round in the direction of the shaking")
    for name, value, (low, high), (below, above) in zip(found.names, found.values, found.interval, found.open):
        ends = f"{'<' if below else ''}{float(low):.4g} to {'>' if above else ''}{float(high):.4g}"
        ends = ends if np.isfinite(float(low)) else "no interval"
        lines.append(f"  {name:<10} {float(value):10.4g} {_UNITS[name]:<2}  95 %: {ends}")
    lines.append(f"  log-likelihood {float(found.log_likelihood):.3f}{more}, scatter {float(found.scatter):g}")
    return "\n".join([*lines, *found.remarks])
