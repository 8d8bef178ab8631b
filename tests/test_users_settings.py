"""Settings of JAX that users have: calls find the same numbers, in processes without anything that tests set.

The calls, and the settings, stand in `references.users_settings`. NaN and infinity that results hold by contract pass
`jax.debug_nans` and `jax.debug_infs`; a NaN of the user's own is still found.
"""

import functools
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock._core.settings import in_precision_of_session, kept_by_precision, under_usual_settings, usual_settings
from references.users_settings import CALLS, SETTINGS

ROOT = Path(__file__).parents[1]
OF_TESTS = ("JAXROCK_CACHE", "JAXROCK_TESTS_COMPILED", "XLA_FLAGS")  # set by the tests themselves
OF_USERS = {
    "NaN of the user": "FloatingPointError",
    "NaN by contract, in a program of the user": "FloatingPointError",
    "infinity by contract, in a program of the user": "FloatingPointError",
}
# JAX itself places numbers for these implicitly: ones and unit vectors for derivatives, constants of users.
PLACED_BY_JAX = {"grad", "vmap(grad)", "hessian", "jacrev of a history", "grad by samples", "scan", "suite"}
FEW = [
    "outcome", "overturned", "outcome of no numbers", "FlexibleBlock", "pushover", "toppling_rate", "similarity",
    "fit_fragility, separable", *OF_USERS,
]  # fmt: skip
LATE = ["FlexibleBlock", "toppling_rate, tabulated", "fit_pulse"]
# Settings that change what a program is; of the others, under which every call takes as long, few calls are tried.
THOROUGHLY = [
    "debug_nans", "debug_infs", "disable_jit", "strict promotion of types", "no promotion of ranks", "transfer_guard",
]  # fmt: skip
STRICT = ["strict promotion of types", "transfer_guard", "debug_nans", "global debug_infs", "no promotion of ranks"]


def told(*words):
    """Return the output of `references.users_settings`."""
    surroundings = {name: value for name, value in os.environ.items() if name not in OF_TESTS}
    with tempfile.TemporaryDirectory() as place:
        surroundings["JAXROCK_CACHE"] = place
        program = [sys.executable, "-m", "references.users_settings", *words]
        run = subprocess.run(program, cwd=ROOT, env=surroundings, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])  # JAX first prints the NaN that it finds


def differ(found, usual, rel=1e-11):
    """Return calls whose numbers differ, and their errors."""
    wrong = {}
    for name, one in found.items():
        if isinstance(one, str) or isinstance(usual[name], str):
            wrong |= {name: one} if one != usual[name] else {}
        elif [len(x) for x in one] != [len(x) for x in usual[name]] or not all(
            np.allclose(x, y, rtol=rel, atol=rel, equal_nan=True) for x, y in zip(one, usual[name])
        ):
            wrong[name] = one, usual[name]
    return wrong


def is_of_users(setting, name, raised):
    """Return whether JAX rightly raises for the user's own code: for a result that leaves a program of the user."""
    if setting == "transfer_guard":
        return name in PLACED_BY_JAX and "Disallowed host-to-device transfer" in str(raised)
    kind = {"debug_nans": "NaN", "debug_infs": "infinity"}.get(setting.removeprefix("global "), "nothing")
    return name.startswith(kind) and name in OF_USERS and str(raised).startswith(OF_USERS[name])


def check(setting, found, usual):
    wrong = differ(found, usual)
    expected = {name for name in found if is_of_users(setting, name, found[name])}
    assert set(wrong) == expected, {name: wrong[name] for name in set(wrong) - expected}
    if setting.endswith(("debug_nans", "debug_infs")):
        assert len(expected) == (2 if "nans" in setting else 1)


def test_every_call_finds_numbers_as_it_is():
    assert set(FEW) | set(LATE) <= set(CALLS) and set(STRICT) <= set(SETTINGS)


def test_settings_change_no_number():
    found = told(",".join([*STRICT, "usual"]), ";".join(FEW))
    usual = found.pop("usual")
    assert not [name for name, one in usual.items() if isinstance(one, str)]
    for setting, one in found.items():
        check(setting, one, usual)


@functools.cache
def all_usual():
    usual = told("usual")["usual"]
    assert not {name: one for name, one in usual.items() if isinstance(one, str)}
    return usual


@pytest.mark.slow
@pytest.mark.parametrize("setting", [name for name in SETTINGS if name != "usual"])
def test_no_setting_changes_a_number(setting):
    names = [] if setting in THOROUGHLY else [";".join(FEW)]
    check(setting, told(setting, *names)[setting], all_usual())


def check_late(found, rel_of_single, usual):
    """Double precision switched on late finds the numbers of double precision; single precision agrees to its
    digits."""
    for when in ("double", "cleared", "double again"):
        assert not differ(found[when], usual), when
    for when in ("single", "single within"):
        refused = {name for name, one in found[when].items() if str(one).startswith("ValueError: Argument")}
        assert refused <= {"flexible with P-Delta"}  # that call asks for double precision
        numbers = {name: one for name, one in found[when].items() if name not in refused}
        assert not differ(numbers, usual, rel_of_single), when


def test_precision_that_is_switched_on_late():
    found = told("late", ";".join(LATE))
    check_late(found, 1e-3, found["cleared"])


@pytest.mark.slow
def test_precision_that_is_switched_on_late_for_every_call():
    usual = all_usual()
    check_late(told("late"), 5e-3, usual)


# ------------------------------------------------------------------------------------------------- one by one

BLOCK, PULSE = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.3, 0.8)
PEAK = 0.08831429053870708  # by `rk.Diffrax(rtol=1e-12)`


def record():
    return rk.Record(0.4 * np.sin(5 * np.arange(0.0, 2.0, 0.05)), 0.05)


MADE_IN_DOUBLE = {
    "outcome": lambda block, motion: rk.outcome(block, motion).max_rotation,
    "simulate": lambda block, motion: rk.simulate(block, motion, duration=2.0, samples=9).rotation,
    "jit": lambda block, motion: jax.jit(lambda b, m: rk.outcome(b, m).max_rotation)(block, motion),
    "grad": lambda block, motion: jax.grad(lambda b: rk.outcome(b, motion).margin)(block).alpha,
    "intensity": lambda block, motion: rk.intensity.uplift_ratio(motion, block),
}


@pytest.mark.filterwarnings("ignore:jaxrock runs in single precision")
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in ("simulate", "grad") else []) for n in MADE_IN_DOUBLE]
)
def test_double_precision_arrays_become_single_under_enable_x64_false(name):
    double = np.asarray(MADE_IN_DOUBLE[name](BLOCK, PULSE))
    with jax.enable_x64(False):
        single = MADE_IN_DOUBLE[name](BLOCK, PULSE)
        made_there = MADE_IN_DOUBLE[name](rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.3, 0.8))
    np.testing.assert_allclose(single, double, rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(single, made_there, rtol=2e-5, atol=2e-6)


def test_a_history_made_in_double_precision_is_read_in_single():
    history = rk.simulate(BLOCK, PULSE, duration=2.0, samples=9)
    column = rk.blocks.FlexibleBlock(0.6, 3.0, 30e9, 2500.0, 0.02, 2)
    expected, period = np.asarray(history(0.7)), float(column.first_period)
    with jax.enable_x64(False):
        np.testing.assert_allclose(history(0.7), expected, rtol=1e-4, atol=1e-6)
        assert float(column.first_period) == pytest.approx(period, rel=1e-6)


def test_arrays_of_types_that_are_switched_off():
    wide = {"a": jnp.ones(2), "b": [jnp.arange(3), "word"], 1.0: None}
    assert in_precision_of_session(wide) is wide
    with jax.enable_x64(False):
        assert in_precision_of_session(wide) is wide  # keys that JAX cannot sort
        narrow = in_precision_of_session(wide["b"])
        assert narrow[0].dtype == np.int32 and narrow[1] == "word"
        assert jax.jit(in_precision_of_session)(jnp.asarray(wide["a"])).dtype == np.float32


def test_settings_are_those_of_the_caller_again():
    @under_usual_settings
    def inner():
        config = jax.config
        return config.jax_debug_nans, config.jax_numpy_dtype_promotion, config.jax_disable_jit

    with jax.debug_nans(True), jax.numpy_dtype_promotion("strict"), jax.disable_jit():
        assert inner() == (False, "standard", False)
        with usual_settings():
            assert not jax.config.jax_debug_nans
        assert jax.config.jax_debug_nans and jax.config.jax_numpy_dtype_promotion == "strict"
        with pytest.raises(ValueError, match="`alpha` must be in"):
            rk.Block(-1.0, 2.0)
        assert jax.config.jax_disable_jit


def test_the_error_of_a_likelihood_is_estimated_where_every_transfer_is_forbidden():
    rocks = rk.inverse.Observations([0.12], [2.0], ["toppled"], alpha_sd=[0.01])
    likelihood = rk.inverse.Likelihood(rocks, rk.SinePulse)
    values = {"amplitude": 0.3, "period": 0.8}
    expected = np.asarray(likelihood.survival_error(values))
    with jax.transfer_guard("disallow_explicit"):
        found = likelihood.survival_error(values)
    np.testing.assert_array_equal(found, expected)


def test_debug_nans_finds_the_users_own_and_passes_those_by_contract():
    with jax.debug_nans(True), jax.debug_infs(True):
        gone = rk.outcome(rk.Block(-1.0, 2.0, throw=False), PULSE, throw=False)
        assert np.isnan(gone.margin) and gone.status == rk.Status.not_finite
        assert np.isinf(rk.outcome(BLOCK, 5 * PULSE).max_rotation)
        assert float(rk.outcome(BLOCK, PULSE).max_rotation) == pytest.approx(PEAK, rel=1e-12)
        with pytest.raises(FloatingPointError, match="nan"):
            jnp.log(-1.0) * rk.outcome(BLOCK, PULSE).margin


def test_arrays_of_programs_are_kept_for_each_precision():
    @kept_by_precision
    def table(count):
        return np.arange(float(count))

    program = jax.jit(lambda x: x * table(3))
    one = table(3)
    for double in (True, False, True):
        with jax.enable_x64(double):
            assert (table(3) is one) == double
            assert program(jnp.asarray(np.float64(1.5))).dtype == (np.float64 if double else np.float32)


SYMBOLIC = {
    "outcome": lambda amplitude: rk.outcome(BLOCK, rk.SinePulse(amplitude, 0.8)).margin,
    "slope": jax.grad(lambda amplitude: rk.outcome(BLOCK, rk.SinePulse(amplitude, 0.8)).margin),
    "record": lambda amplitude: rk.outcome(BLOCK, amplitude * record()).margin,
    "closed form": lambda amplitude: rk.closed_form.pushover.force(amplitude, 0.5),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "closed form" else pytest.mark.slow) for name in SYMBOLIC]
)
def test_a_batch_of_symbolic_size_is_exported(name):
    function = jax.jit(jax.vmap(SYMBOLIC[name]))
    (size,) = jax.export.symbolic_shape("n")
    exported = jax.export.export(function)(jax.ShapeDtypeStruct((size,), float))
    program = jax.export.deserialize(exported.serialize())
    for count in (1, 3, 64, 70):  # of 64 lanes
        amplitude = np.linspace(0.3, 0.4, count)
        one_by_one = [float(SYMBOLIC[name](x)) for x in amplitude[:3]]
        found = program.call(amplitude)
        assert found.shape == (count,)
        np.testing.assert_allclose(found[:3], one_by_one, rtol=1e-12)
        np.testing.assert_allclose(found, function(amplitude), rtol=1e-11)


DOUBTFUL = """import jax; jax.config.update("jax_enable_x64", True); import jaxrock as rk
steady = rk.Record([0.1] * 200, 0.01)
rk.Record([0.0, 5.0, 0.0], 0.01)
rk.intensity.peak_velocity(steady)
rk.intensity.peak_displacement(steady)
rk.hazard.suite_outcomes(rk.Block(0.2, 2.0), [steady, steady], 1.0, progress=False)
"""


def test_a_warning_names_the_line_of_the_user(tmp_path):
    """Not one of the package, nor of the libraries by which it is called."""
    file = tmp_path / "script.py"
    file.write_text(DOUBTFUL)
    done = subprocess.run(
        [sys.executable, str(file)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    told = [line.split(":")[:2] for line in done.stderr.splitlines() if "UserWarning" in line]
    assert done.returncode == 0 and told == [[str(file), str(line)] for line in (3, 4, 5, 6)]
