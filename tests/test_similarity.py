"""Scale laws: blocks and motions with equal groups respond alike."""

import functools

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.studies import similarity
from jaxrock.studies.similarity import orientations
from references import hard_cases
from references.smooth_differences import gradient

TAU = np.linspace(0, 12, 400)


@jax.jit
def history(block, motion, model, scales):
    """Rotation and velocity at dimensionless times, in units and in scales."""
    engine = rk.Series(order=6)  # a shorter program
    response = rk.simulate(block, motion, model, duration=12.01 / block.p, engine=engine, samples=2)
    return jnp.stack(response(TAU / block.p)), jnp.stack(similarity.master_curve(response, scales, TAU))


@pytest.mark.parametrize("form", [rk.SinePulse, rk.CosinePulse, lambda a, t: rk.RickerPulse(a, t)])
@pytest.mark.parametrize("amplitude, frequency", [(0.5, 16.0), (0.02, 0.7)])
def test_slender_blocks_collapse(form, amplitude, frequency):
    first = rk.Block(0.1, 2.0, 0.85)
    groups = similarity.groups(first, 0.25, 10.0, kind="slender")
    curves = []
    for block, peak in ((first, 0.25), (similarity.block(groups, amplitude, frequency), amplitude)):
        motion, scales = similarity.motion(groups, block, form), similarity.scales(block, peak, "slender")
        curves.append(history(block, motion, rk.Linear(), scales)[1])
    np.testing.assert_allclose(curves[0], curves[1], atol=1e-13)


def test_rigid_blocks_of_one_slenderness_collapse():
    # Housner's restitution, of which the groups know the number.
    first, second = (rk.Block(0.35, p, float(rk.Block(0.35, p).restitution)) for p in (2.0, 5.0))
    groups = similarity.groups(rk.Block(0.35, 2.0), 0.7, 9.0)
    assert float(groups.restitution) == float(first.restitution)
    curves = []
    for block in (first, second):
        pulse = similarity.motion(groups, block, rk.SinePulse)
        again = similarity.groups(block, pulse.amplitude, 2 * np.pi / float(pulse.period))
        assert float(again.strength) == pytest.approx(float(groups.strength), rel=1e-15)
        scales = similarity.scales(block, pulse.amplitude)
        curves.append(history(block, pulse, rk.Housner(), scales)[1])
    np.testing.assert_allclose(curves[0], curves[1], atol=1e-13)


def peaks_of_sines(model, alpha, amplitude, ratio):
    """Return peaks and impact counts of blocks with p = 1 and restitution 0.85."""
    scenes = [((a, 1.0, 0.85), (b, 2 * np.pi / ratio), (0.0, 0.0)) for a, b in zip(alpha, amplitude)]
    found = hard_cases.outcomes("sine", model, rk.Series(), scenes)
    return found["max_rotation"], found["impact_count"]


@pytest.mark.parametrize("ratio, most", [(8.0, 0.004), (5.0, 0.009), (3.0, 0.019)])
@pytest.mark.parametrize("strength", [0.75, 0.9])
def test_small_rotations_nearly_collapse(ratio, strength, most):
    """D&D equation 6.1: the spread of peaks over slenderness angles of 0.02 to 0.35, restitution 0.85."""
    alpha = np.linspace(0.02, 0.35, 8)
    amplitude = np.tan(alpha) / strength
    peaks, _ = peaks_of_sines("nonlinear", alpha, amplitude, ratio)
    units = [similarity.scales(rk.Block(alpha, np.ones(8)), amplitude, kind).rotation for kind in ("rigid", "slender")]
    rigid, slender = (np.ptp(found) / np.mean(found) for found in (peaks / np.asarray(unit) for unit in units))
    assert rigid < most < 0.04 < slender


PULSES = {
    "sine": rk.SinePulse(0.3, 0.9),
    "exponential": rk.ExponentialPulse(0.3, 0.9, -1.7),
    "Ricker, with a time of its own": rk.RickerPulse(0.3, 0.9, center=1.4),
    "near fault": rk.MavroeidisPapageorgiouPulse(0.3, 0.9, 2.5, 0.4),
}


def there_and_back(block, other, pulse, kind):
    """Groups of a block under a pulse, the pulse from these, that for another block, its groups, and how both go."""
    groups = similarity.groups_of(block, pulse, kind)
    again, alike = (similarity.motion(groups, each, type(pulse)) for each in (block, other))
    tau = np.linspace(0, 3.0, 20)
    accelerations = pulse.acceleration(tau / block.p), alike.acceleration(tau / other.p)
    return groups, again, similarity.groups_of(other, alike, kind), accelerations


@jax.jit
def in_every_kind(block, other, pulse):
    return {kind: there_and_back(block, other, pulse, kind) for kind in similarity._KINDS}


@pytest.mark.parametrize("kind", similarity._KINDS)
@pytest.mark.parametrize("pulse", PULSES.values(), ids=PULSES)
def test_groups_of_pulses(pulse, kind):
    """To groups and back to the pulse; another block's pulse with these groups has them, and goes the same way."""
    block, other = rk.Block(0.12, 3.0, 0.9), rk.Block(0.12, 5.0, 0.9)
    groups, again, its_groups, accelerations = in_every_kind(block, other, pulse)[kind]
    for one, two in zip(jax.tree.leaves(pulse), jax.tree.leaves(again), strict=True):
        assert float(one) == pytest.approx(float(two), rel=1e-14)
    for one, two in zip(jax.tree.leaves(groups), jax.tree.leaves(its_groups), strict=True):
        assert float(one) == pytest.approx(float(two), rel=1e-14)
    np.testing.assert_allclose(*accelerations, atol=1e-14)


def test_groups_of_a_single_lobe():
    """Uplift strength, p t_d and shape of Voyagaki et al., both ways."""
    groups = similarity.Groups.of_duration(0.4, 1.5, 0.9, shape=0.5)
    pulse = similarity.motion(groups, rk.Block(0.1, 2.0, 0.9), rk.ExponentialPulse)
    np.testing.assert_allclose([pulse.amplitude, pulse.duration, pulse.shape], [0.25, 0.75, 0.5], rtol=1e-15)
    back = similarity.groups_of(rk.Block(0.1, 2.0, 0.9), pulse, "slender")
    np.testing.assert_allclose([back.strength, back.pulse_duration, back.others["shape"]], [0.4, 1.5, 0.5], rtol=1e-15)
    block = similarity.block(back, 0.5, 2 * np.pi / 0.3)
    np.testing.assert_allclose([block.alpha, block.p, block.restitution], [0.2, 5.0, 0.9], rtol=1e-15)
    down = similarity.groups_of(rk.Block(0.1, 2.0, 0.9), rk.ExponentialPulse(-0.25, 0.75, 0.5), "slender")
    assert down.strength == back.strength
    with pytest.raises(ValueError, match="Argument `pulse_duration` must be positive"):
        similarity.Groups.of_duration(0.4, 0.0, 0.9)


LOBES = np.array([  # uplift strength, pulse duration, shape: peak after the pulse, and before its end
    (0.5, 2.0, 3.0), (0.8, 1.0, -2.0), (0.7, 0.5, 0.0), (0.6, 3.0, 1.0), (0.97, 3.0, -0.3), (0.95, 2.0, 4.0),
])  # fmt: skip


def lobe_peak(engine):
    """Peak over alpha by uplift strength, duration and shape."""

    def peak(x):
        block, groups = rk.Block(0.1, 1.0, 0.9), similarity.Groups.of_duration(x[0], x[1], 0.9, shape=x[2])
        pulse = similarity.motion(groups, block, rk.ExponentialPulse)
        return rk.outcome(block, pulse, rk.Linear(), engine=engine).max_rotation / 0.1

    return peak


@functools.cache
def with_slopes(name):
    """Peaks of the lobes, and their derivatives."""
    if name == "closed form":
        function = lambda x: rk.closed_form.single_lobe.peak_rotation(*x.T)
        return function(LOBES), gradient(function, LOBES)
    function = {"series": lobe_peak(rk.Series(order=6)), "diffrax": lobe_peak(rk.Diffrax(rtol=1e-10))}[name]
    return jax.jit(jax.vmap(jax.value_and_grad(function)))(LOBES)


@pytest.mark.parametrize("name, value_within, slope_within", [
    ("series", 1e-13, 1e-10), pytest.param("diffrax", 1e-7, 1e-5, marks=pytest.mark.slow)
])  # fmt: skip
def test_peaks_and_their_derivatives_side_by_side(name, value_within, slope_within):
    """By uplift strength, duration and shape of a lobe: the engines beside the closed form of Voyagaki et al."""
    value, slope = with_slopes("closed form")
    found, found_slope = with_slopes(name)
    np.testing.assert_allclose(found, value, rtol=value_within)
    np.testing.assert_allclose(found_slope, slope, rtol=slope_within, atol=slope_within)
    # Strength helps, duration hurts, and the slimmer pulse does less.
    assert np.all(np.sign(slope) == [-1, 1, -1])


def test_conversions_invert():
    block = rk.Block(0.12, 3.0, 0.9)
    groups = similarity.groups(block, 0.3, 7.0, kind="slender")
    back = similarity.block(groups, 0.3, 7.0)
    for name in ("alpha", "p", "restitution"):
        assert float(getattr(back, name)) == pytest.approx(float(getattr(block, name)), rel=1e-15)
    with pytest.raises(ValueError, match="must be of slender blocks"):
        similarity.block(similarity.groups(block, 0.3, 7.0), 0.3, 7.0)
    with pytest.raises(ValueError, match="must be one of 'slender', 'rigid'"):
        similarity.scales(block, kind="stocky")


# ---- Orientations ----

TABLE_1 = {"0": "0xyz", "x": "x0zy", "y": "yz0x", "z": "zyx0"}  # D&D, columns in the order 0, x, y, z


def test_the_table_of_orientations():
    for first, row in TABLE_1.items():
        for second, both in zip("0xyz", row):
            assert orientations.combined(first, second) == both
        assert [orientations.power(first, n) for n in (-3, -1, 0, 1, 2, 7)] == [first, first, "0", first, "0", first]


@pytest.mark.parametrize("function, orientation", [(mp.cos, "0"), (mp.sin, "z"), (mp.tan, "z"), (mp.exp, None)])
def test_orientations_of_functions(function, orientation):
    """D&D 4.6: by the terms of their series. An exponential of an angle has none."""
    exponents = [k for k, term in enumerate(mp.taylor(function, 0, 7)) if abs(term) > 1e-12]
    if orientation is None:
        with pytest.raises(ValueError, match="Argument `exponents` must be all even or all odd"):
            orientations.of_series("z", exponents)
    else:
        assert orientations.of_series("z", exponents) == orientation
        assert orientations.of_series("0", exponents) == "0"


@pytest.mark.parametrize("exponents, dimension", [
    ({"acceleration": 1, "gravity": -1}, (0, 0, "z")), ({"frequency": 1, "p": -1}, (0, 0, "0")),
    ({"velocity": 1, "p": -1, "alpha": -1}, (0, 0, "0")), ({"gravity": 1, "radius": -1, "p": -2}, (0, 0, "y")),
    ({"rotation": 1, "gravity": 1, "acceleration": -1}, (0, 0, "0")), ({"gravity": 1, "time": 2}, (1, 0, "y")),
], ids=lambda x: str(x) if isinstance(x, dict) else "")  # fmt: skip
def test_products(exponents, dimension):
    """D&D 4.7. That 3 g/(4 R) has an orientation says that R stands for R times a unit vector in it."""
    assert tuple(orientations.product(**exponents)) == dimension
    assert orientations.product(**exponents).is_pure == (dimension == (0, 0, "0"))


@functools.cache
def similar_scenes():
    """Slenderness, amplitude, and peak rotation of slender blocks with equal groups, safe and with impacts."""
    alpha = np.array([0.02, 0.05, 0.1, 0.2])
    amplitude = alpha / 0.45

    rotation, impacts = peaks_of_sines("linear", alpha, amplitude, 5.0)
    assert np.all(impacts >= 1) and np.all(np.isfinite(rotation))
    return alpha, amplitude, rotation


@pytest.mark.parametrize("of_motion", range(-3, 4))
def test_exponents_that_orientations_allow_and_that_scale(of_motion):
    """D&D 4.8, 4.9: odd sums are allowed. Of these the engine's peaks are a number times (a_g/g)^m alpha^n where
    m + n = 1 alone, the degree of the linear equation; 4.10 is m, n = 0, 1 and 4.11 is 1, 0."""
    alpha, amplitude, rotation = similar_scenes()
    for of_alpha in range(-3, 4):
        group = orientations.product(rotation=1, acceleration=-of_motion, gravity=of_motion, alpha=-of_alpha)
        number = rotation / (amplitude**of_motion * alpha**of_alpha)
        is_one = np.ptp(number) < 1e-12 * np.max(number)
        assert group.is_pure == ((of_motion + of_alpha) % 2 == 1)
        assert is_one == (of_motion + of_alpha == 1) and (group.is_pure or not is_one)


@pytest.mark.parametrize("model", [rk.Linear(), rk.Housner()], ids=["slender", "rigid"])
def test_what_orientations_say_is_a_mirror(model):
    """Check that orientations express a mirror: quantities along z change sign with the accelerations along x.

    This holds in every model; not every model scales.
    """
    block = rk.Block(0.3, 2.0, 0.85)
    one_side, other_side = (
        np.asarray(history(block, rk.SinePulse(a, 0.8), model, similarity.scales(block, 0.6))[0]) for a in (0.6, -0.6)
    )
    for one, other in zip(one_side, other_side):
        np.testing.assert_array_equal(one, -other)
        assert np.max(np.abs(one)) > 0.05


def test_names_of_orientations():
    with pytest.raises(ValueError, match="Argument `orientation` must be one of '0', 'x', 'y', 'z', but is 'w'"):
        orientations.combined("x", "w")
    with pytest.raises(ValueError, match="Argument `name` must be one of 'rotation', 'alpha'"):
        orientations.product(mass=1)


def test_a_block_that_cannot_have_the_groups_is_refused():
    groups = similarity.groups_of(rk.Block(0.3, 2.0, 0.85), rk.SinePulse(0.5, 0.8))
    with pytest.raises(ValueError, match="`block` must have the restitution of the groups, 0.85, but has 0.5"):
        similarity.motion(groups, rk.Block(0.3, 3.0, 0.5), rk.SinePulse)
    with pytest.raises(ValueError, match="`block` must have the cosine of alpha of the groups"):
        similarity.motion(groups, rk.Block(0.2, 3.0, 0.85), rk.SinePulse)
    others = similarity.groups_of(rk.Block(0.3, 2.0, 0.85), rk.ExponentialPulse(0.5, 0.8, shape=1.0))
    with pytest.raises(ValueError, match=r"`form` must have the parameters \['shape'\] of the groups"):
        similarity.motion(others, rk.Block(0.3, 2.0, 0.85), rk.SinePulse)


@pytest.mark.parametrize(
    "wrong, said",
    [
        (lambda: orientations.product(radius=0.5, gravity=-0.5, frequency=1), "`radius` must be a whole number"),
        (lambda: orientations.product(rotation="1"), "`rotation` must be a whole number, but is '1'"),
        (lambda: orientations.power("x", 0.5), "`exponent` must be a whole number, but is 0.5"),
        (lambda: orientations.power("w", 2), "`orientation` must be"),
        (lambda: orientations.of_series("z", [0.5]), "`exponent` must be a whole number"),
    ],
)
def test_orientations_have_whole_powers(wrong, said):
    """The root of g R has no orientation that anyone could tell."""
    with pytest.raises(ValueError, match=said):
        wrong()
