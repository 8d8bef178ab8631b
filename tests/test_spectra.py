"""Surfaces against single responses, and what they should look like."""

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.closed_form import single_lobe
from jaxrock.studies.any_size import of_any_size

RATIOS, INTENSITIES = np.linspace(0.4, 8.0, 23), np.linspace(1.02, 9.0, 17)
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=8), "progress": False}  # compiles in half the time
LINEAR = {"restitution": 0.9, **QUICK}  # small surfaces under a sine are one program


@pytest.fixture(scope="module")
def surface():
    return rk.overturning_map(RATIOS, INTENSITIES, alpha=0.2, restitution=0.9, engine=QUICK["engine"])


def test_map_is_made_of_outcomes(surface):
    """The map's own compilation (wide vectors, fused multiply-add, padded chunks) against plain calls."""
    block = rk.Block(0.2, 1.0, 0.9)
    assert surface.state.shape == (17, 23)
    assert np.all(surface.status._value == rk.Status.successful._value)
    state, impacts, margin, rotation = map(
        np.asarray, (surface.state, surface.impact_count, surface.margin, surface.rotation_ratio)
    )
    for i in range(0, 17, 3):
        for j in range(0, 23, 4):
            pulse = rk.SinePulse(INTENSITIES[i] * np.tan(0.2), 2 * np.pi / RATIOS[j])
            single = rk.outcome(block, pulse, engine=QUICK["engine"])
            assert state[i, j] == (0 if not single.overturned else 1 if int(single.impact_count) == 0 else 2)
            assert impacts[i, j] == int(single.impact_count)
            np.testing.assert_allclose(margin[i, j], single.margin, rtol=1e-9, atol=1e-13)
            np.testing.assert_allclose(rotation[i, j], float(single.max_rotation) / 0.2, rtol=1e-12)


def test_map_has_the_three_regions(surface):
    """Without impact at low frequency, after impacts beyond, safe at high frequency (Zhang & Makris 2001)."""
    state = np.asarray(surface.state)
    assert state[-1, 0] == 1
    assert state[8, 12] == 2
    assert state[0, -1] == 0
    assert set(np.unique(state)) == {0, 1, 2}


def test_no_impact_limit_of_the_linear_block():
    """Dimitrakopoulos & DeJong (2012), 3.10: from here up the linear block overturns without impact."""
    ratio, limit = 2.0, None
    low, high = 1.2, 6.0

    def edge(a):  # B = 0 with the constants of 3.7, written with the growth coordinate at the end of the pulse
        psi = np.arcsin(1 / a)
        end = (2 * np.pi - psi) / ratio
        taus = np.linspace(0, end, 200001)
        forcing = np.exp(-taus) * a * np.sin(ratio * taus + psi)
        return np.trapezoid(forcing, taus) - 1

    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if edge(middle) < 0 else (low, middle)
    limit = (low + high) / 2
    state = np.asarray(rk.overturning_map([ratio], [limit * (1 - 1e-6), limit * (1 + 1e-6)], **LINEAR).state)
    assert state[1, 0] == 1 and state[0, 0] != 1


def test_self_similar_spectrum():
    """In the linear model rotation/alpha depends on intensity and frequency ratio alone."""
    ratio, intensity = np.array([4.0, 8.0, 16.0]), [1.5, 3.0]
    a, b = (rk.studies.self_similar_spectrum(ratio, intensity, alpha=alpha, **LINEAR) for alpha in (0.05, 0.3))
    assert a.rotation_ratio.shape == (2, 3)
    np.testing.assert_allclose(a.rotation_ratio, b.rotation_ratio, rtol=1e-13)
    np.testing.assert_allclose(a.margin, b.margin, rtol=1e-12)


def test_rocking_spectrum_of_a_record():
    """Point by point the same as single outcomes; bigger blocks of one slenderness are safer here."""
    record = rk.example_record()
    period = np.array([1.0, 2.0, 3.0, 5.0, 8.0])
    alpha = np.arctan(0.2)
    spectrum = rk.rocking_spectrum(alpha, record, period, **QUICK)
    assert np.all(spectrum.status._value == rk.Status.successful._value)
    np.testing.assert_array_equal(spectrum.overturned, [True, True, False, False, False])
    rotation, velocity = np.asarray(spectrum.rotation_ratio), np.asarray(spectrum.velocity_ratio)
    for i in (1, 2, 4):
        p = 2 * np.pi / period[i]
        single = rk.outcome(rk.Block(alpha, p), record, QUICK["model"], engine=QUICK["engine"])
        np.testing.assert_allclose(rotation[i], float(single.max_rotation) / alpha, rtol=1e-9)
        np.testing.assert_allclose(velocity[i], float(single.max_velocity) / (alpha * p), rtol=1e-9)


STRENGTHS, DURATIONS, SHAPES = np.linspace(0.05, 0.98, 12), np.linspace(0.3, 7.0, 14), np.array([-3.0, 0.0, np.pi])


@pytest.fixture(scope="module")
def lobes():
    axes = {"uplift_strength": STRENGTHS, "pulse_duration": DURATIONS, "shape": SHAPES}
    given = {"pulse": rk.ExponentialPulse, "alpha": 0.1, **LINEAR}
    return rk.overturning_map(**axes, **given), rk.studies.self_similar_spectrum(**axes, **given)


def test_single_lobes_over_strength_duration_and_shape(lobes):
    """Voyagaki et al., figures 3.1 to 3.3, 3.5 and 3.6: walls and peaks of the closed form."""
    shape, strength, duration = np.meshgrid(SHAPES, STRENGTHS, DURATIONS, indexing="ij")
    wall = np.asarray(single_lobe.safety_wall(duration, shape))
    peak = np.asarray(single_lobe.peak_rotation(strength, duration, shape))
    assert 0.2 < np.mean(strength < wall) < 0.8
    for found in lobes:
        np.testing.assert_array_equal(np.asarray(found.margin) < 0, strength < wall)
        np.testing.assert_allclose(found.rotation_ratio, peak, rtol=1e-11)
        np.testing.assert_allclose(found.uplift_strength, STRENGTHS, rtol=1e-15)
        np.testing.assert_allclose(found.pulse_duration, DURATIONS, rtol=1e-15)
        np.testing.assert_array_equal(found.parameters["shape"], SHAPES)
    np.testing.assert_array_equal(lobes[0].state, np.where(strength < wall, 1, 0))


def test_a_parameter_that_is_a_number_is_no_axis(lobes):
    given = {"uplift_strength": STRENGTHS[::4], "pulse_duration": DURATIONS[::2], "alpha": 0.1, "shape": 0.0}
    found = rk.overturning_map(pulse=rk.ExponentialPulse, **given, **LINEAR)
    assert found.state.shape == (3, 7) and not found.parameters
    np.testing.assert_allclose(found.margin, np.asarray(lobes[0].margin)[1, ::4, ::2], rtol=1e-12)


def test_figures_of_single_lobes(lobes, tmp_path):
    surface, spectrum = lobes
    for found, draw in ((surface, rk.plot.overturning), (spectrum, rk.plot.spectrum)):
        with pytest.raises(ValueError, match="Argument `result` must have no further axes, but has `shape`"):
            draw(found, by_duration=True)
    given = {"pulse": rk.ExponentialPulse, "shape": 0.0, **LINEAR}
    few = {"uplift_strength": [0.5, 0.8], "pulse_duration": [1.8, 1.9, 2.0]}  # borders in few columns
    axis = rk.plot.overturning(rk.overturning_map(**few, **given), by_duration=True)
    assert "uplift strength" in axis.get_ylabel() and "duration" in axis.get_xlabel()
    assert axis.get_xlim()[1] == pytest.approx(2.0) and axis.get_ylim()[1] < 1
    similar = rk.studies.self_similar_spectrum(**few, **given)
    axes = rk.plot.spectrum(similar, by_duration=True)
    np.testing.assert_allclose(axes[0].lines[0].get_xdata(), few["pulse_duration"])
    assert [text.get_text() for text in axes[0].get_legend().get_texts()][:2] == ["0.5", "0.8"]
    axis.figure.savefig(tmp_path / "map.png")
    with pytest.raises(ValueError, match="Argument `by_duration` must be False"):
        rk.plot.spectrum(dataclasses.replace(similar, intensity=None), by_duration=True)  # as a rocking spectrum's is
    plt.close("all")


def test_parameters_that_a_pulse_does_not_have():
    with pytest.raises(TypeError, match="sharpness"):
        rk.overturning_map([1.0], [2.0], pulse=rk.ExponentialPulse, shape=0.0, sharpness=1.0)


def test_progress_bar(capsys):
    rk.overturning_map([2.0, 3.0], [1.5, 2.0], **LINEAR | {"progress": True})
    assert "4/4" in capsys.readouterr().err
    rk.overturning_map([2.0, 3.0], [1.5, 2.0], **LINEAR)
    assert capsys.readouterr().err == ""


def test_figures(tmp_path):
    """Every function draws into given axes or its own, and returns them."""
    surface = rk.overturning_map(RATIOS[::6], INTENSITIES[::4], **LINEAR)
    response = rk.simulate(rk.Block(0.2, 2.0), rk.SinePulse(0.5, 1.1), QUICK["model"], engine=QUICK["engine"])
    with plt.style.context("dark_background"):
        dark = rk.plot.history(response)[2].lines[0].get_color()
        letters = {text.get_text(): text.get_color() for text in rk.plot.scene(rk.Block(0.2, 2.0)).texts}
    assert dark == "white" and letters["$m$"] == letters["$R$"] == "black" and letters["$O$"] == "white"
    axes = rk.plot.history(response)
    assert len(axes) == 3 and axes[2].get_xlabel() == "time [s]"
    assert "manifold" in rk.plot.phase(response).get_legend().get_texts()[0].get_text()
    spectrum = rk.studies.self_similar_spectrum([2.0, 4.0], [1.5, 3.0], **LINEAR)
    assert len(rk.plot.spectrum(spectrum)) == 2
    _, axis = plt.subplots()
    assert rk.plot.overturning(surface, axis, exact=False) is axis  # with borders: `test_borders`
    axis.figure.savefig(tmp_path / "map.png")
    plt.close("all")


FEW_RATIOS, FEW_INTENSITIES, PERIODS = np.array([2.0, 5.0, 6.0]), np.array([1.5, 2.5]), np.array([2.0, 5.0, 9.0])
TRACED = {
    "map, slenderness": lambda alpha: rk.overturning_map(FEW_RATIOS, FEW_INTENSITIES, alpha=alpha, **QUICK).margin,
    "map, axes": lambda alpha: rk.overturning_map(5 * alpha * FEW_RATIOS, FEW_INTENSITIES, **QUICK).margin,
    "map, shape of a pulse": lambda shape: (
        (
            rk.overturning_map(
                FEW_RATIOS, FEW_INTENSITIES, pulse=lambda a, t: rk.ExponentialPulse(a, t, shape), **LINEAR
            )
        ).margin
    ),
    "map, single lobes": lambda x: (
        rk.overturning_map(
            pulse_duration=[0.5, 2.0],
            uplift_strength=x * np.array([1, 2]),
            pulse=rk.ExponentialPulse,
            shape=x,
            **QUICK,
        ).margin
    ),
    "spectrum": lambda a: rk.rocking_spectrum(0.2, a * rk.SinePulse(1.5, 0.8), PERIODS, **QUICK).rotation_ratio,
    "self-similar spectrum": lambda alpha: (
        rk.studies.self_similar_spectrum(FEW_RATIOS + 5, FEW_INTENSITIES, alpha=alpha, **QUICK).rotation_ratio
    ),
}


# The axes: `test_maps_go_through_forward_mode`.
SLOW = ("map, axes", "map, single lobes")


@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.slow if x in SLOW else ()) for x in TRACED])
def test_surfaces_go_through_transformations(name):
    """jit, vmap and derivatives, all at once; the same as on all devices."""

    def total(x):
        values = TRACED[name](x)
        return jnp.where(jnp.isfinite(values), values, 0.0).sum(), values

    def known(x):
        values = np.asarray(TRACED[name](x))
        return values, values[np.isfinite(values)].sum()

    at, step = np.array([0.2, 0.21]), 1e-7
    (totals, values), slopes = jax.jit(jax.vmap(jax.value_and_grad(total, has_aux=True)))(at)
    for x, *found in zip(at.tolist(), *map(np.asarray, (values, totals))):
        for one, other in zip(found, known(x)):
            np.testing.assert_allclose(one, other, rtol=1e-11)
    difference = (known(0.2 + step)[1] - known(0.2 - step)[1]) / (2 * step)
    assert float(slopes[0]) == pytest.approx(difference, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRACED)
def test_surfaces_go_through_forward_mode(name):
    """The columns of forward mode are the rows of reverse mode."""

    def finite(x):
        values = TRACED[name](x)
        return jnp.where(jnp.isfinite(values), values, 0.0)

    forward, reverse = (jax.jit(derivative(finite))(0.2) for derivative in (jax.jacfwd, jax.jacrev))
    assert np.any(forward != 0)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)


def elasticity(amplitude):
    """Return elasticities of the peak by the amplitude, and by everything."""
    scene = rk.Block(0.2, 2.0, 0.9), rk.SinePulse(amplitude, 0.7)
    found = rk.studies.sensitivity(*scene, QUICK["model"], engine=QUICK["engine"]).max_rotation
    return found.derivative[3] * amplitude / found.value, found.elasticity


def test_sensitivities_go_through_jit_and_vmap():
    rows, every = jax.jit(jax.vmap(elasticity))(np.array([0.3, 0.31]))
    np.testing.assert_allclose(np.asarray(every)[:, 3], rows, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
def test_sensitivities_have_derivatives(derivative):
    step = 1e-5
    difference = (elasticity(0.3 + step)[0] - elasticity(0.3 - step)[0]) / (2 * step)
    assert float(derivative(lambda a: elasticity(a)[0])(0.3)) == pytest.approx(float(difference), rel=1e-6)


def test_maps_go_through_forward_mode():
    """By the axes of single lobes: strength, duration and shape, beside the closed form's wall."""

    def margin(x):
        found = rk.overturning_map(
            pulse_duration=x[1:2], uplift_strength=x[:1], shape=x[2], pulse=rk.ExponentialPulse, **LINEAR
        )
        return found.margin[0, 0]

    duration, shape, step = 1.5, 0.5, 1e-5
    places = np.array([duration, shape]) + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    as_above = np.resize(places, (SHAPES.size, STRENGTHS.size, DURATIONS.size, 2))  # one program
    wall = np.ravel(single_lobe.safety_wall(as_above[..., 0], as_above[..., 1]))[:5]
    slopes = np.asarray(jax.jit(jax.jacfwd(margin))(np.array([wall[0] + 1e-9, duration, shape])))
    np.testing.assert_allclose(-slopes[1:] / slopes[0], (wall[1::2] - wall[2::2]) / (2 * step), rtol=1e-6)


def test_borders_cannot_be_traced():
    def found(alpha):
        surface = rk.overturning_map([1.0, 2.0], [2.0, 3.0], alpha=alpha, model=rk.Linear(), restitution=0.9)
        return rk.studies.overturning_borders(surface).crowded

    with pytest.raises(TypeError, match="Borders are searched .* they cannot be traced"):
        jax.jit(found)(0.2)


def test_a_block_of_plain_numbers_is_made_once_in_each_precision():
    """A small map takes no longer than it has to; and never numbers of another precision, or of another restitution."""
    block = of_any_size(0.2, 0.9)
    assert of_any_size(0.2, 0.9) is block
    assert (float(block.alpha), float(block.p), float(block.restitution)) == (0.2, 1.0, 0.9)
    assert float(of_any_size(0.2, None).restitution) == float(rk.Block(0.2, 1.0).restitution)
    with jax.enable_x64(False):
        assert of_any_size(0.2, 0.9).alpha.dtype == jnp.float32
    for _ in range(2):
        with pytest.raises(ValueError, match=r"Argument `restitution` must be in \[0, 1\], but is 1.5."):
            of_any_size(0.2, 1.5)


def test_slopes_beside_a_point_that_overturns():
    """They are what they are without it; its own are zero."""
    motion, periods = 0.9 * rk.SinePulse(0.5, 0.9), jnp.array([2.0, 4.5])

    def peaks(alpha):
        spectrum = rk.rocking_spectrum(alpha, motion, periods, **QUICK)
        surface = rk.overturning_map([2.0, 4.0], [1.2, 3.0], alpha=alpha, **QUICK)
        return jnp.concatenate([spectrum.rotation_ratio, spectrum.velocity_ratio, surface.rotation_ratio.ravel()])

    at = 0.3
    found, above, below = (np.asarray(peaks(alpha)) for alpha in (at, at + 1e-6, at - 1e-6))
    lost = np.isinf(found)
    assert lost.any() and not lost.all()
    differences = np.subtract(above, below, out=np.zeros(lost.shape), where=~lost) / 2e-6
    for slopes in jax.jit(lambda alpha: (jax.jacfwd(peaks)(alpha), jax.jacrev(peaks)(alpha)))(at):
        np.testing.assert_allclose(slopes, differences, rtol=1e-6, atol=1e-7)


def test_numbers_of_single_precision_are_as_exact_as_they_are():
    """Numbers that single precision holds exactly, among others of double precision: the same results to the bit."""
    ratios, intensities, periods = np.array([2.0, 3.0]), np.array([1.5, 2.5]), np.array([2.0, 4.0])
    exact, single = (
        (
            rk.overturning_map(ratios.astype(kind), intensities.astype(kind), alpha=0.2, **QUICK),
            rk.rocking_spectrum(0.2, rk.SinePulse(0.5, 0.7), periods.astype(kind), **QUICK),
        )
        for kind in (np.float64, np.float32)
    )
    for a, b in zip(exact, single):
        np.testing.assert_array_equal(a.margin, b.margin)
        np.testing.assert_array_equal(a.rotation_ratio, b.rotation_ratio)
