"""Results as tables of xarray and pandas: names, units, a status in words; of results that are made by hand."""

import jax
import numpy as np
import pytest

import jaxrock as rk
from jaxrock._arguments.tables import AbstractTable, items_of
from jaxrock.studies.sensitivities import Slopes, SlopeStatus

pytest.importorskip("xarray")
pytest.importorskip("pandas")

ONE = np.asarray(1.0)
STATUS = jax.tree.map(lambda *x: np.stack(x), rk.Status.successful, rk.Status.undecided, rk.Status.not_finite)
RECORD = rk.Record([0.1, 0.2, -0.3], 0.5)


def made(kind, **fields):
    """A result of which only some fields are known."""
    result = object.__new__(kind)
    for name, value in fields.items():
        object.__setattr__(result, name, value)
    return result


STATE = {
    "rotation": np.zeros((2, 3)), "velocity": np.ones((2, 3)), "overturned": np.zeros((2, 3), bool),
    "impact_count": np.ones((2, 3), np.int32), "known_periods": np.ones((2, 3), np.int32),
    "status": jax.tree.map(lambda x: np.tile(x, (2, 1)), STATUS),
}  # fmt: skip
_SLOPES = made(Slopes, value=ONE, derivative=np.ones(2), elasticity=np.ones(2), reach=ONE, status=SlopeStatus.useful)
SENSITIVITY = made(
    rk.studies.Sensitivity, names=("alpha", "p"), values=np.array([0.2, 2.5]), max_rotation=_SLOPES,
    max_velocity=_SLOPES, margin=_SLOPES, valid=ONE, condition=ONE, graze_distance=ONE, boundary_distance=ONE,
    outcome=made(rk.responses.Outcome, status=rk.Status.successful),
)  # fmt: skip

TABLES = {
    "spectrum": made(
        rk.studies.Spectrum, abscissa=np.array([1.0, 2.0, 3.0]), rotation_ratio=np.arange(3.0),
        velocity_ratio=np.ones(3), impact_count=np.arange(3), overturned=np.zeros(3, bool),
        margin=np.ones(3), status=STATUS, intensity=None,
        parameters={}, motions=None,
    ),
    "spectrum of a suite": made(
        rk.studies.Spectrum, abscissa=np.array([1.0, 2.0, 3.0]), rotation_ratio=np.ones((2, 3)),
        velocity_ratio=np.ones((2, 3)), impact_count=np.ones((2, 3)), overturned=np.zeros((2, 3), bool),
        margin=np.ones((2, 3)), status=jax.tree.map(lambda x: np.tile(x, (2, 1)), STATUS), intensity=None,
        parameters={}, motions=("one", "two"),
    ),
    "self-similar spectrum": made(
        rk.studies.Spectrum, abscissa=np.array([1.0, 2.0, 3.0]), rotation_ratio=np.ones((2, 1, 3)),
        velocity_ratio=np.ones((2, 1, 3)), impact_count=np.ones((2, 1, 3)), overturned=np.zeros((2, 1, 3), bool),
        margin=np.ones((2, 1, 3)), status=jax.tree.map(lambda x: np.tile(x, (2, 1, 1)), STATUS),
        intensity=np.array([1.5]), parameters={"shape": np.array([0.0, 1.0])}, motions=None,
    ),
    "map": made(
        rk.studies.OverturningMap, frequency_ratio=np.array([1.0, 2.0, 3.0]), intensity=np.array([2.0]),
        state=np.ones((1, 3)), rotation_ratio=np.ones((1, 3)), impact_count=np.ones((1, 3)), margin=np.ones((1, 3)),
        status=jax.tree.map(lambda x: x[None], STATUS), parameters={},
    ),
    "critical amplitudes": made(
        rk.studies.Critical, count=np.array([2]), value=np.ones((1, 2)), intensity=np.ones((1, 2)),
        rising=np.ones((1, 2)), impacts=np.ones((1, 2)), balanced=np.ones((1, 2)), derivative=np.ones((1, 2, 1)),
        complete=np.array([True]), from_the_least=np.array([False]), names=("alpha",), scale=np.ones((1, 2)),
        merged=np.array([1]),
    ),
    "fragility intervals": rk.hazard.fragility_intervals([0.2, 0.3, 0.4, 0.5], [0, 1, 0, 1]),
    "estimate": made(
        rk.inverse.Estimate, names=("amplitude", "period"), values=np.array([0.3, 0.8]), interval=np.ones((2, 2)),
        open=np.zeros((2, 2), bool), log_likelihood=ONE, surprise=ONE, scatter=ONE,
        status=rk.inverse.EstimateStatus.open_interval,
    ),
    "posterior": made(
        rk.inverse.Posterior, names=("amplitude",), samples=np.ones((2, 3, 1)), log_density=np.ones((2, 3)),
        status=rk.inverse.PosteriorStatus.not_converged,
    ),
    "region": made(
        rk.inverse.FeasibleRegion, names=("amplitude", "period"), values=(np.ones(2), np.ones(3)),
        log_likelihood=np.ones((2, 3)), allowed=np.ones((2, 3), bool),
    ),
    "unexceeded": made(
        rk.inverse.Unexceeded, durations=np.ones(3), amplitude=np.ones(3), by_rock=np.ones((2, 3)),
        weakest=np.ones(3), complete=np.ones(3, bool),
    ),
    "found record": made(
        rk.inverse.FoundRecord, record=RECORD, start=RECORD, change=ONE, scaling=ONE,
        status=rk.inverse.RecordStatus.useless_slopes,
    ),
    "outcomes": made(
        rk.responses.Outcome, max_rotation=np.ones(3), max_velocity=np.ones(3), time_of_max=np.ones(3),
        impact_count=np.arange(3), large_impact_count=np.arange(3), overturned=np.zeros(3, bool),
        overturned_share=np.zeros(3), margin=np.ones(3), differentiable=np.ones(3, bool), clearance=np.ones(3),
        error=np.ones(3), known_until=np.ones(3), status=STATUS,
    ),
    "outcome of a column": made(
        rk.responses.FlexibleOutcome, max_rotation=ONE, max_displacement=ONE, max_bending=ONE, impact_count=ONE,
        overturned=ONE, margin=ONE, energy=ONE, status=rk.Status.successful,
    ),
    "history": made(
        rk.responses.Response, time=np.arange(4.0), rotation=np.zeros(4), velocity=np.ones(4)
    ),
    "history of a column": made(
        rk.responses.FlexibleResponse, time=np.ones((2, 4)), rotation=np.zeros((2, 4)),
        displacement=np.ones((2, 4)), bending=np.ones((2, 4)),
    ),
    "contact": made(
        rk.responses.Contact, time=np.arange(4.0), horizontal=np.ones(4), normal=np.ones(4), friction=np.ones(4)
    ),
    "sensitivity": SENSITIVITY,
    "sensitivities": made(
        rk.studies.SensitivityMap, uplift_strength=np.ones(2), pulse_duration=np.ones(3),
        sensitivity=jax.tree.map(lambda x: np.broadcast_to(x, (2, 3, *np.shape(x))), SENSITIVITY),
    ),
    "suite": made(
        rk.hazard.SuiteOutcomes, suite=made(rk.motions.Suite, names=("one", "two")), facing=(1, -1),
        scale=np.array([1.0, 2.0, 3.0]), verdict=np.zeros((2, 3, 2, 4), np.int8), rotation_ratio=np.ones((2, 3, 2, 4)),
        margin=np.ones((2, 3, 2, 4)),
    ),
    "simulated fragility": made(
        rk.hazard.SimulatedFragility, levels=np.array([0.1, 0.2]), verdict=np.ones((3, 2, 5), np.int8),
        peak_acceleration=np.ones(3), peak_velocity=np.ones(3), names=("a", "b", "c"), measure="PGA",
    ),
    "azimuths": made(
        rk.studies.AzimuthOutcomes, azimuth=np.arange(3.0), scale=np.array([1.0, 2.0]),
        verdict=np.zeros((3, 2), np.int8), rotation_ratio=np.ones((3, 2)), margin=np.ones((3, 2)),
    ),
    "state": made(rk.studies.StroboscopicState, **STATE),
    "basins": made(
        rk.studies.Basins, rotation=np.arange(3.0), velocity=np.arange(2.0), attractor=np.ones((2, 3), np.int32),
        orbits=(np.zeros((1, 2)),), final=made(rk.studies.StroboscopicState, **STATE),
    ),
    "bifurcation": made(
        rk.studies.Bifurcation, parameter=np.arange(3.0), rotation=np.zeros((3, 4)), velocity=np.ones((3, 4)),
        period=np.ones(3, np.int32), overturned=np.zeros(3, bool), status=STATUS,
    ),
    "fragility": made(
        rk.hazard.FragilityFit, fragility=rk.hazard.LogNormalFragility(0.3, 0.4), covariance=np.eye(2),
        log_likelihood=ONE, highest_survived=ONE, lowest_toppled=ONE, p_value=ONE,
        status=rk.hazard.FitStatus.separable,
    ),
    "probit": made(
        rk.hazard.ProbitFit, names=("PGA", "PGV"), intercept=ONE, slopes=np.ones(2), covariance=np.eye(3),
        p_values=np.ones(2), log_likelihood=ONE, status=rk.hazard.FitStatus.successful,
    ),
    "calibration": made(
        rk.inverse.BlockCalibration, values={"alpha": ONE, "alpha_sd": ONE}, covariance=np.eye(2), log_likelihood=ONE,
        status=rk.inverse.CalibrationStatus.at_an_end,
    ),
    "history fit": made(
        rk.inverse.HistoryFit, names=("p",), values=np.ones(1), covariance=np.eye(1), robust_covariance=np.eye(1),
        scatter=0.1, residuals=np.ones(9), misfit=1.0, correlated=False, status=rk.inverse.HistoryStatus.not_identified,
    ),
}  # fmt: skip


def kinds(kind):
    return {kind} | {below for each in kind.__subclasses__() for below in kinds(each)}


def test_all_tables_are_tried():
    assert {type(table) for table in TABLES.values()} == kinds(AbstractTable) - {AbstractTable}


@pytest.mark.parametrize("table", TABLES.values(), ids=TABLES)
def test_tables(table):
    """Every column has its unit, and every row of the frame is one of the dataset."""
    data, frame = table.to_xarray(), table.to_pandas()
    assert data.attrs["result"] == type(table).__name__
    assert all(variable.attrs["units"] for variable in data.variables.values())
    assert len(frame) == max(np.prod([*data.sizes.values()], dtype=int), 1)
    assert set(frame.columns) == set(data.data_vars)
    assert set(frame.attrs["units"]) == set(data.variables)
    assert "status" not in frame or frame["status"].dtype == "category"


def test_the_words_of_a_status():
    data = TABLES["spectrum"].to_xarray()
    assert data["status"].values.tolist() == ["successful", "undecided", "not_finite"]
    assert data["abscissa"].attrs["units"] == "s" and "intensity" not in data
    assert TABLES["estimate"].to_xarray()["status"].item() == "open_interval"
    for kind in (rk.Status, rk.inverse.EstimateStatus, rk.inverse.RecordStatus):
        for name in items_of(kind.successful):
            item = getattr(kind, name)
            assert items_of(item)[int(item._value)] == name


def test_values_are_where_they_belong():
    data = TABLES["self-similar spectrum"].to_xarray()
    assert data["margin"].dims == ("shape", "intensity", "frequency_ratio")
    assert TABLES["estimate"].to_pandas().loc["period", "value"] == 0.8
    assert TABLES["posterior"].to_xarray()["amplitude"].attrs["units"] == "g"
    np.testing.assert_array_equal(TABLES["found record"].to_xarray()["time"], [0.0, 0.5, 1.0])


def test_slopes_are_told_by_parameter():
    data = TABLES["sensitivities"].to_xarray()
    assert data["margin"].dims == ("uplift_strength", "pulse_duration")
    assert data["max_rotation_derivative"].dims == ("uplift_strength", "pulse_duration", "parameter")
    assert TABLES["sensitivity"].to_pandas().loc["p", "at"] == 2.5


def test_many_scenes_have_a_row_each():
    """Check tables of `jax.vmap` results: scenes are numbered; each history has its own time."""
    quick = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # compiles in half the time
    one = jax.jit(jax.vmap(lambda alpha: rk.outcome(rk.Block(alpha, 2.5), rk.SinePulse(0.3, 0.8), **quick)))
    found = one(np.array([0.1, 0.2, 0.3]))
    frame = found.to_pandas()
    np.testing.assert_array_equal(frame["max_rotation"], found.max_rotation)
    assert frame.index.name == "scene" and frame["status"].tolist() == ["successful"] * 3
    assert TABLES["history of a column"].to_xarray()["time"].dims == ("scene", "sample")


def test_a_grid_in_pandas():
    grid = rk.studies.Grid({"x": np.array([1.0, 2.0, 3.0])}, {"status": STATUS, "double": np.array([2.0, 4.0, 6.0])})
    frame = grid.to_pandas()
    assert frame["status"].tolist() == ["successful", "undecided", "not_finite"]
    assert frame.loc[2.0, "double"] == 4.0
