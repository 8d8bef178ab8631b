"""The diffrax engine: settings, solvers, models as functions, derivatives, histories."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk

BLOCK, PULSE = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(0.23, 1.4)  # three impacts, then safe
EXACT = rk.Series(order=6)  # a shorter program


def sine(opening, block):
    return jnp.sin(block.alpha - opening)


def cosine(opening, block):
    return jnp.cos(block.alpha - opening)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"rtol": 0.0}, "Argument `rtol` must be in (0, 1), but is 0.0."),
        ({"atol": -1.0}, "Argument `atol` must be in (0, 1), but is -1.0."),
        ({"max_solves": 0}, "Argument `max_solves` must be a whole number from 1 to 1000000000, but is 0."),
        ({"adjoint": diffrax.BacksolveAdjoint()}, "Argument `adjoint` must be one of"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError) as error:
        rk.Diffrax(**settings)
    assert message in str(error.value)


def test_equal_settings_are_one_engine():
    """Two engines with the same settings share a compilation."""
    assert jax.tree.structure(rk.Diffrax()) == jax.tree.structure(rk.Diffrax())


def test_single_budget():
    found = rk.outcome(BLOCK, PULSE, rk.Linear(), engine=rk.Diffrax(max_solves=3))
    assert found.status == rk.Status.step_budget_exhausted
    assert "`max_solves`" in rk.Status[found.status]


def test_a_solver_of_low_order_needs_an_absolute_tolerance():
    """Its status says so; with one a hundredth of the relative it ends, and near the truth."""
    usual, eased = (rk.Diffrax(diffrax.Heun(), rtol=1e-6, atol=atol) for atol in (None, 1e-8))
    assert "raise `atol`" in rk.Status[rk.outcome(BLOCK, PULSE, engine=usual).status]
    found = rk.outcome(BLOCK, PULSE, engine=eased)
    assert found.status == rk.Status.successful
    assert found.max_rotation == pytest.approx(float(rk.outcome(BLOCK, PULSE, engine=EXACT).max_rotation), rel=1e-6)


@pytest.mark.parametrize(
    "engine, tolerance",
    [
        pytest.param(rk.Diffrax(solver=diffrax.Dopri8(), rtol=1e-9), 1e-8, id="Dopri8", marks=pytest.mark.slow),
        pytest.param(
            rk.Diffrax(solver=diffrax.Kvaerno5(), rtol=1e-6), 1e-5, id="Kvaerno5 (implicit)", marks=pytest.mark.slow
        ),
        pytest.param(rk.Diffrax(controller=diffrax.ConstantStepSize()), 1e-6, id="constant steps"),
    ],
)
def test_any_solver(engine, tolerance):
    """Explicit, implicit, adaptive or not: the same response within the tolerance."""
    exact, found = rk.outcome(BLOCK, PULSE), rk.outcome(BLOCK, PULSE, engine=engine)
    assert found.status == rk.Status.successful
    assert found.impact_count == exact.impact_count == 3
    assert abs(float(found.max_rotation - exact.max_rotation)) < tolerance * 0.2
    assert abs(float(found.margin - exact.margin)) < 3 * tolerance


@pytest.mark.slow
def test_the_edge_of_certain_loss():
    """An arc ends where no forcing can bring the block back; what rounding leaves there must not end the next at once,
    and all after it. Of functions nothing is known beyond, so these blocks go on."""

    def found(amplitude, model, engine):
        return rk.outcome(BLOCK, rk.SinePulse(amplitude, 1.4), model, engine=engine)

    amplitudes = np.linspace(0.6, 0.9, 61)
    exact = jax.vmap(lambda a: found(a, rk.Housner(), rk.Series()))(amplitudes)
    lanes = jax.vmap(lambda a: found(a, rk.models.Equation(sine, cosine), rk.Diffrax()))(amplitudes)
    assert (lanes.status == rk.Status.successful).all()
    np.testing.assert_array_equal(lanes.overturned, exact.overturned)


@pytest.mark.slow
def test_history_to_rest():
    """More than a hundred impacts, one by one: times, velocities and the dense history agree with the series engine."""
    exact, found = (rk.simulate(BLOCK, PULSE, engine=e, samples=401) for e in (rk.Series(), rk.Diffrax()))
    assert found.status == rk.Status.successful
    assert len(found.impact_times) == len(exact.impact_times) > 100
    np.testing.assert_allclose(found.impact_times, exact.impact_times, atol=1e-7)
    np.testing.assert_allclose(found.impact_velocities, exact.impact_velocities, rtol=2e-6, atol=1e-12)
    np.testing.assert_allclose(found.peak_rotations, exact.peak_rotations, rtol=2e-6, atol=1e-12)
    np.testing.assert_allclose(found.rotation, exact.rotation, atol=2e-8)
    assert bool(found.overturned) == bool(exact.overturned)
    assert float(found.margin) == pytest.approx(float(exact.margin), abs=1e-7)


def test_series_engine_refuses_functions():
    with pytest.raises(ValueError, match="Argument `engine` must be a Diffrax"):
        rk.outcome(BLOCK, PULSE, rk.models.Equation(sine, cosine), engine=rk.Series())


@pytest.mark.parametrize("parts", [{}, {"restoring": sine, "acceleration": sine}, {"acceleration": sine, "arm": sine}])
def test_equation_needs_one_description(parts):
    with pytest.raises(ValueError, match="Give either `restoring`"):
        rk.models.Equation(**parts)


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(rk.models.Equation(sine, cosine), marks=pytest.mark.slow),  # fast: `test_dissipation`
        rk.models.Equation(acceleration=lambda x, v, push, block: -sine(x, block) - push * cosine(x, block)),
    ],
    ids=["moments", "acceleration"],
)
def test_equation_of_the_built_in_model(model):
    """Housner's equation, written as functions or as a whole right-hand side, is Housner's equation."""
    exact = rk.outcome(BLOCK, PULSE, engine=EXACT)

    @jax.jit
    def limits(block):
        table = model.moments(block)
        return table.saddle, table.threshold

    np.testing.assert_allclose(jax.device_get(limits(BLOCK)), [0.2, np.tan(0.2)], rtol=1e-15)
    found = rk.outcome(BLOCK, PULSE, model)
    assert found.status == rk.Status.successful and found.impact_count == exact.impact_count
    assert abs(float(found.max_rotation - exact.max_rotation)) < 1e-8 * 0.2


def test_dissipation():
    """Viscous dissipation takes 2 c v^2 per time from the energy of a freely rocking block: judged by quadrature."""
    model = rk.models.Equation(sine, cosine, lambda x, v, block: 0.3 * v)
    engine = rk.Diffrax(rtol=1e-10)

    @jax.jit
    def followed(rotation):
        still = rk.Record([0.0], 0.1)
        found = rk.simulate(BLOCK, still, model, initial=(rotation, 0.0), duration=0.5, samples=2001, engine=engine)
        return found.impact_count, found.rotation, found.velocity

    impacts, rotation, velocity = jax.device_get(followed(0.15))
    assert impacts == 0
    speed = velocity / 2.0
    energy = speed**2 / 2 + np.cos(0.2 - rotation)
    lost = np.concatenate([[0.0], np.cumsum((speed[1:] ** 2 + speed[:-1] ** 2) / 2)]) * 0.3 * (2.0 * 0.5 / 2000)
    np.testing.assert_allclose(energy[0] - energy, lost, atol=2e-8)
    assert lost[-1] > 1e-4


def peak(parameters, engine):
    alpha, p, e, amplitude, period = parameters
    return rk.outcome(rk.Block(alpha, p, e), rk.SinePulse(amplitude, period), engine=engine).max_rotation


PARAMETERS = np.array([0.2, 2.0, 0.9, 0.23, 1.4])


@pytest.fixture(scope="module")
def exact_slopes():
    """Central differences of the series engine, an independent computation (1e-9)."""
    values = jax.jit(jax.vmap(lambda q: peak(q, EXACT)))
    steps = 1e-5 * np.diag(PARAMETERS)
    points = np.concatenate([PARAMETERS + k * steps for k in (-2, -1, 1, 2)])
    far, near, plus, further = np.asarray(values(points)).reshape(4, 5)
    return (far - 8 * near + 8 * plus - further) / (12 * 1e-5 * PARAMETERS)


def test_derivatives_do_not_call_back():
    """JAX keeps no program that calls back to Python: one for machines without machine code of our own."""
    slope = jax.grad(lambda a: rk.outcome(BLOCK, rk.SinePulse(a, 1.4), rk.Linear(), engine=rk.Diffrax()).max_rotation)
    program = jax.export.export(jax.jit(slope))(jax.ShapeDtypeStruct((), float)).mlir_module()
    assert "while" in program and "callback" not in program


def test_forward_derivatives(exact_slopes, caplog):
    """Through uplift, three impacts, the end of the pulse and the free peak; in machine code, by five numbers, too."""
    caplog.set_level("DEBUG", "jaxrock")
    engine = rk.Diffrax(rtol=1e-10)
    slopes = jax.jit(jax.jacfwd(lambda q: peak(q, engine)))(PARAMETERS)
    np.testing.assert_allclose(slopes, exact_slopes, rtol=2e-7)
    assert "left to XLA" not in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize(
    "adjoint, tolerance",
    [(diffrax.ForwardMode(), 2e-7), (diffrax.RecursiveCheckpointAdjoint(), 2e-7), (diffrax.DirectAdjoint(), 1e-6)],
    ids=["forward, by its Jacobian", "checkpointed", "direct"],
)
def test_reverse_derivatives(adjoint, tolerance, exact_slopes):
    engine = rk.Diffrax(rtol=1e-10, adjoint=adjoint, max_solves=64)
    slopes = jax.jit(jax.grad(lambda q: peak(q, engine)))(PARAMETERS)
    np.testing.assert_allclose(slopes, exact_slopes, rtol=tolerance)


@pytest.mark.slow
def test_derivative_with_respect_to_a_model_parameter():
    """A function that is a module carries a parameter; its derivative is right."""

    class Damping(eqx.Module):
        size: jax.Array

        def __call__(self, opening, velocity, block):
            return self.size * velocity

    def of(size):
        model = rk.models.Equation(sine, cosine, Damping(size))
        return rk.outcome(BLOCK, PULSE, model, engine=rk.Diffrax(rtol=1e-10)).max_rotation

    value, slope = jax.jit(lambda c: jax.jvp(of, (c,), (1.0,)))(0.1)
    values = jax.jit(jax.vmap(of))(jnp.array([0.1 - 1e-4, 0.1 + 1e-4]))
    assert float(slope) == pytest.approx(float(values[1] - values[0]) / 2e-4, rel=1e-5)
    assert 0 < float(value) < 0.2


@pytest.mark.slow
def test_derivatives_of_a_history():
    """Also just after the starts of arcs, where a solve is a single short step."""
    times = jnp.linspace(0.02, 1.9, 95)

    def rotations(amplitude, engine):
        response = rk.simulate(BLOCK, rk.SinePulse(amplitude, 1.4), engine=engine, samples=2)
        return response(times)[0]

    exact, found = (
        jax.jit(lambda a, e=engine: jax.jvp(lambda a: rotations(a, e), (a,), (1.0,))[1])(0.23)
        for engine in (rk.Series(), rk.Diffrax(rtol=1e-10))
    )
    np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-6)
