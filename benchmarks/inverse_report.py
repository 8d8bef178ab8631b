"""The report of `inverse.py`: what it has measured, as tables."""

import numpy as np


def text(kept: dict, truth: dict[str, float]) -> str:
    """The report of all that was measured; `truth`: the parameters of the motion that was to be found."""
    lines = ["# Inverse estimates: what was measured", "", "Written by `benchmarks/inverse.py`, whose head says how."]
    for key, rows in kept.get("coverage", {}).items():
        lines += ["", f"## Sine pulses: {key}", "", *_coverage_text(rows, truth)]
    if "times" in kept:
        lines += ["", "## Exponential pulses, three parameters: time of a whole fit with its intervals", ""]
        lines += ["| fit | time [s] | processor time [s] | responses |", "| --- | ---: | ---: | ---: |"]
        lines += [
            f"| {key} | {row['wall']:.0f} | {row['cpu']:.0f} | {row['responses']:,} |"
            for key, row in kept["times"].items()
        ]
        lines += [
            "",
            "The first fit compiles. Both cores work in parts of it: processor time may be up to twice the time.",
        ]
    if "posterior" in kept:
        lines += ["", "## Exponential pulses, three parameters: samples of the posterior", ""]
        lines += [
            "| rocks | time [s] | processor time [s] | responses | samples | smallest effective size | largest R-hat |",
            "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
        ]
        lines += [
            f"| {key} | {row['wall']:.0f} | {row['cpu']:.0f} | {row['responses']:,} | {row['samples']:,} | "
            f"{row['size']:.0f} | {row['r_hat']:.4f} |"
            for key, row in kept["posterior"].items()
        ]
        lines += ["", "Compilation is in it, the fit in whose maxima it begins is not."]
    if "samplers" in kept:
        lines += ["", "## Samples beside those of other libraries (20 rocks, three parameters)", ""]
        columns = "points | smallest effective size | largest R-hat | processor time [s] | effective samples a second"
        lines += [f"| method | {columns} | ln amplitude |"]
        lines += ["| --- | ---: | ---: | ---: | ---: | ---: | --- |"]
        lines += [_sampler_text(name, row) for name, row in kept["samplers"].items()]
        lines += [
            "",
            "Compilation and the points with which chains learned are counted. Of tempered particles those that are "
            "alike count once, and the others as if they were independent: that is the most they can be worth.",
        ]
    if "probabilities" in kept:
        lines += ["", "## Probabilities that rocks stand, beside 10,000 drawn scenes", ""]
        lines += ["60 rocks and sine pulses; the drawing itself is uncertain by up to 0.005.", ""]
        lines += ["| scatter | sd of ln alpha | sd of ln p | root of mean square | worst | mean |"]
        lines += ["| ---: | ---: | ---: | ---: | ---: | ---: |"]
        lines += [
            f"| {row['scatter']:g} | {row['alpha']:g} | {row['p']:g} | {row['rms']:.3f} | {row['worst']:.3f} | "
            f"{row['mean']:+.4f} |"
            for row in kept["probabilities"]
        ]
    for key, rows in kept.get("optimizers", {}).items():
        highest = max(value for value, *_ in rows.values())
        lines += ["", f"## Searches from the same starts ({key})", ""]
        lines += ["| method | below the highest | points | processor time [s] |", "| --- | ---: | ---: | ---: |"]
        lines += [
            f"| {name} | {highest - value:.1e} | {points:,} | {spent:.2g} |"
            for name, (value, points, spent) in rows.items()
        ]
        lines += ["", "Own climbers give up those that are far below the best; others go on until each has arrived."]
    if "grid" in kept:
        lines += ["", "## Beside a grid", "", *_grid_text(kept["grid"])]
    return "\n".join(lines) + "\n"


def _sampler_text(name: str, row: dict) -> str:
    r_hat = "" if row["r_hat"] is None else f"{row['r_hat']:.3f}"
    return (
        f"| {name} | {row['points']:,} | {row['size']:.0f} | {r_hat} | {row['cpu']:.0f} | "
        f"{row['size'] / row['cpu']:.3g} | {row['mean']:+.3f} +- {row['sd']:.3f} |"
    )


def _grid_text(row: dict) -> list[str]:
    plain, fine = row["points"] ** 2, row["fine_points"]
    return [
        f"{row['rocks']} rocks and a sine pulse; log-likelihoods of the best point, and the points that it took "
        "(each as many responses a rock as its quadrature has scenes):",
        "",
        "| | log-likelihood | below the best | points | fit's share of them |",
        "| --- | ---: | ---: | ---: | ---: |",
        f"| fit, with its intervals | {row['fit']:.7f} | {max(row['fine'], row['plain']) - row['fit']:+.1e} | "
        f"{row['fit_points']:,} | |",
        f"| plain grid, {row['points']} x {row['points']} | {row['plain']:.7f} | {row['fit'] - row['plain']:.1e} | "
        f"{plain:,} | 1/{plain / row['fit_points']:.0f} |",
        f"| grid for 1e-6, steps of {100 * row['spacing']:.2g} % | {row['fine']:.7f} | "
        f"{row['fit'] - row['fine']:.1e} | {fine:.2g} | 1/{fine / row['fit_points']:.2g} |",
        "",
        f"Of the last grid the {plain:,} points around the maximum were computed; the number is that of all.",
    ]


def _coverage_text(rows: list[dict], truth: dict[str, float]) -> list[str]:
    true = np.array(list(truth.values()))
    interval = np.array([row["interval"] for row in rows])
    held = (interval[..., 0] <= true) & (true <= interval[..., 1])
    errors = np.log(np.array([row["values"] for row in rows]) / true)
    share, count = held.mean(axis=0), len(rows)
    doubt = 1.96 * np.sqrt(share * (1 - share) / count)
    lines = [
        f"{count} repetitions; truth {truth['amplitude']} g and {truth['period']} s.",
        "",
        "| parameter | 95 % interval holds the truth | median of ln(estimate/truth) | median of its size | "
        "least possible (Cramer-Rao) | geometric mean of estimate/truth |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for i, name in enumerate(truth):
        median, size = np.median(errors[:, i]), np.median(np.abs(errors[:, i]))
        # Half of normal errors are below 0.6745 standard deviations.
        least = 0.6745 * np.median([row["least"][i] for row in rows])
        lines.append(
            f"| {name} | {share[i]:.3f} +- {doubt[i]:.3f} | {median:+.3f} | {size:.3f} | {least:.3f} | "
            f"{np.exp(errors[:, i].mean()):.3f} |"
        )
    points, spent = (np.array([row[name] for row in rows if row[name] is not None]) for name in ("points", "cpu"))
    lines += [
        "",
        f"- An interval is open in {np.mean([row['open'] for row in rows]):.2f} of them; "
        f"{sum(row['contradictory'] for row in rows)} were called contradictory (they count as not held).",
        f"- A fit with its intervals took a median of {np.median(points):.0f} points, "
        f"1/{65536 / np.median(points):.0f} of those of a plain grid of 256 x 256 points, whose steps are 1.4 % of the "
        "amplitude and 1.1 % of the period.",
    ]
    if spent.size:
        lines.append(f"- Median processor time of a fit, compiled: {np.median(spent):.1f} s.")
    return lines
