"""Compare measures of intensity by how well each alone explains overturning, with a probit fit for each."""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated

import numpy as np

from jaxrock._arguments.annotations import arguments, word_of
from jaxrock._core.arrays import shown
from jaxrock.hazard.fragility import FitStatus
from jaxrock.hazard.probit import fit_probit
from jaxrock.hazard.suites import SuiteOutcomes, measures_by_name
from jaxrock.studies.suite_scenes import BOUNDS, topples

_STATUSES = ("successful", "separable", "not_growing", "not_converged")


@arguments
def compare_measures(
    found: SuiteOutcomes,
    measures: Mapping[str, str | Callable] | Sequence[str],
    *,
    bound: Annotated[str, word_of(*BOUNDS)] = "lower",
    errors: Annotated[str, word_of("clusters", "jackknife")] = "clusters",
) -> dict[str, np.ndarray]:
    """Compare how well measures of intensity, each alone, explain the outcomes of a suite.

    **Arguments:**

    - `found`: from `suite_outcomes`.
    - `measures`: as in `SuiteOutcomes.table`.
    - `bound`: whether undecided scenes count as standing ("lower"), as toppled ("upper"), or by their share ("share").
    - `errors`: as in `fit_probit`; scenes of one record form a cluster.

    **Returns:** columns for `pandas.DataFrame`, by falling auc: measure; auc (probability that a toppled scene had a
    larger measure than a standing one); median (at which half topple) and dispersion; slope, standard_error, p_value,
    useless (the slope does not differ significantly from 0, or is negative); log_likelihood; status (a name of
    `FitStatus`). Numbers of a fit that failed are NaN. Where the status is "separable" and auc 1, the measure separates
    toppled from standing scenes.

    **Raises:** ValueError for outcomes of one record, and as `SuiteOutcomes.table`.
    """
    if not measures:
        raise ValueError(f"Argument `measures` must hold a measure, but is {shown(measures)}.")
    table = found.table(measures)
    toppled = topples(found.verdict, bound, found.share).ravel()
    clusters = np.indices(found.verdict.shape)[0].ravel() // found.suite.turns
    rows = [_row(name, table[name], toppled, clusters, errors) for name in measures_by_name(measures)]
    rows.sort(key=lambda row: -np.nan_to_num(row["auc"]))
    return {column: np.array([row[column] for row in rows]) for column in rows[0]}


def _row(name: str, values: np.ndarray, toppled: np.ndarray, clusters: np.ndarray, errors: str) -> dict:
    fit = fit_probit({name: values}, toppled, clusters=clusters, errors=errors)
    slope = float(fit.slopes[0])
    rises = slope > 0
    return {
        "measure": name,
        "auc": _auc(values, toppled),
        "median": float(np.exp(-float(fit.intercept) / slope)) if rises else np.nan,
        "dispersion": 1 / slope if rises else np.nan,
        "slope": slope,
        "standard_error": float(fit.standard_errors[1]),
        "p_value": float(fit.p_values[0]),
        "useless": bool(fit.useless),
        "log_likelihood": float(fit.log_likelihood),
        "status": next(word for word in _STATUSES if fit.status == getattr(FitStatus, word)),
    }


def _auc(values: np.ndarray, toppled: np.ndarray) -> float:
    """Return the probability that a toppled scene has the larger value (ties count half): Mann-Whitney statistic.

    Open scenes count with their share on both sides.
    """
    place = np.unique(values, return_inverse=True)[1]
    fell, stood = np.bincount(place, toppled), np.bincount(place, 1 - toppled)
    pairs = fell.sum() * stood.sum()
    return float(fell @ (np.cumsum(stood) - stood / 2) / pairs) if pairs > 0 else float("nan")
