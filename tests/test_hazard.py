"""Hazard curves and standing rocks: against closed forms, simulated centuries, and each other."""

import csv
import io

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from scipy.special import ndtr, ndtri

import jaxrock as rk

# A site in a seismic region: exceedances a year of peak accelerations [g], bending down in log-log.
LEVELS = np.geomspace(0.005, 2.0, 18)


def site_rate(level):
    return 0.3 * (1 + level / 0.03) ** -2.2 * np.exp(-1.5 * level)


CURVE = rk.hazard.HazardCurve(LEVELS, site_rate(LEVELS), "PGA")
ROCK, TOUGH = rk.hazard.LogNormalFragility(0.35, 0.4), rk.hazard.LogNormalFragility(0.6, 0.25)


class Own(rk.hazard.AbstractFragility):
    """A user's fragility: the lognormal one, written anew."""

    median: float = 0.35
    dispersion: float = 0.4

    def __call__(self, level):
        return jax.scipy.stats.norm.cdf(jnp.log(level), jnp.log(self.median), self.dispersion)


class Step(rk.hazard.AbstractFragility):
    """Topples with the probability `share` from `edge` on, and never below."""

    edge: float
    share: float = 1.0

    def __call__(self, level):
        return jnp.where(jnp.asarray(level) < self.edge, 0.0, self.share)

    @property
    def knots(self):
        return jnp.array([self.edge])


def integral(probability, curve, breaks=()):
    """Probability over the rates of a curve, in 30 digits, by its definition."""
    mp.mp.dps = 30
    levels, rates = ([mp.mpf(float(x)) for x in values] for values in (curve.levels, curve.rates))
    total = mp.mpf(0)
    for i in range(len(levels) - 1):
        if mp.isinf(rates[i]):
            continue
        if rates[i + 1] == 0:
            return total + rates[i] * probability(levels[i])
        k = mp.log(rates[i] / rates[i + 1]) / mp.log(levels[i + 1] / levels[i])
        ends = [levels[i], *(mp.mpf(x) for x in breaks if levels[i] < x < levels[i + 1]), levels[i + 1]]
        density = lambda x, i=i, k=k: probability(x) * k * rates[i] * (x / levels[i]) ** -k / x
        total += mp.quad(density, [mp.mpf(x) for x in ends], method="gauss-legendre")
    return total + rates[-1] * probability(levels[-1])


def lognormal(median, dispersion):
    return lambda x: mp.ncdf(mp.log(x / mp.mpf(median)) / mp.mpf(dispersion))


def pushed(function):
    """Values and changes of a function for rows of numbers and of directions, as one program."""
    return jax.jit(jax.vmap(lambda numbers, direction: jax.jvp(function, (numbers,), (direction,))))


STEPS = np.arange(-3, 4)


def assert_slopes(function, numbers):
    """Derivatives of all results in three directions against central differences of sixth order."""
    for seed in range(3):
        direction = numbers * np.random.default_rng(seed).normal(size=numbers.size)
        rows = numbers + 1e-3 * STEPS[:, None] * direction
        values, changes = (np.asarray(x) for x in function(rows, np.tile(direction, (STEPS.size, 1))))
        differences = np.array([-1, 9, -45, 0, 45, -9, 1]) @ values / 0.06
        np.testing.assert_allclose(changes[3], differences, rtol=1e-8)


# --------------------------------------------------------------------------------------- hazard curves


def test_rates_between_levels_follow_power_laws():
    rates, middle = np.asarray(CURVE.rates), np.sqrt(LEVELS[1:] * LEVELS[:-1])
    at_levels, between = np.split(np.asarray(CURVE.rate(np.append(LEVELS, middle))), [LEVELS.size])
    np.testing.assert_allclose(at_levels, rates, rtol=1e-14)
    np.testing.assert_allclose(between, np.sqrt(rates[1:] * rates[:-1]), rtol=1e-13)
    power = rk.hazard.HazardCurve([0.1, 0.3, 2.0], 1e-3 * np.array([0.1, 0.3, 2.0]) ** -1.7)
    x = np.geomspace(0.1, 2.0, 37)[1:-1]
    np.testing.assert_allclose(power.rate(x), 1e-3 * x**-1.7, rtol=1e-13)


@pytest.mark.parametrize(
    "rates, level, expected",
    [
        pytest.param([3e-2, 1e-2, 1e-3], 0.05, 3e-2, id="weaker than the first level: not counted"),
        pytest.param([3e-2, 1e-2, 1e-3], 0.4, 1e-3, id="the last level"),
        pytest.param([3e-2, 1e-2, 1e-3], 0.41, 0.0, id="stronger than the last level: counted there"),
        pytest.param([np.inf, 1e-2, 1e-3], 0.15, 1e-2, id="unknown, because too frequent"),
        pytest.param([np.inf, 1e-2, 1e-3], 0.2, 1e-2, id="the first known"),
        pytest.param([np.inf, 1e-2, 1e-3], 0.2 * 2**0.5, 1e-2 * 0.1**0.5, id="within the known"),
        pytest.param([3e-2, 1e-2, 0.0], 0.2, 1e-2, id="the last known"),
        pytest.param([3e-2, 1e-2, 0.0], 0.21, 0.0, id="unknown, because too rare"),
        pytest.param([3e-2, 0.0, 0.0], 0.1, 3e-2, id="known at one level only"),
        pytest.param([0.0, 0.0, 0.0], 0.1, 0.0, id="no hazard"),
    ],
)
def test_ends_of_a_curve(rates, level, expected):
    np.testing.assert_allclose(rk.hazard.HazardCurve([0.1, 0.2, 0.4], rates).rate(level), expected, rtol=1e-13)


def test_probabilities_of_exceedance_are_those_of_a_poisson_process():
    probabilities = 1 - np.exp(-50 * site_rate(LEVELS))
    curve = rk.hazard.HazardCurve.from_probabilities(LEVELS, probabilities, 50.0, "PGA")
    np.testing.assert_allclose(curve.rates, site_rate(LEVELS), rtol=1e-9)
    assert curve.measure == "PGA"
    known = rk.hazard.HazardCurve.from_probabilities([0.1, 0.2, 0.4], [1.0, 0.1, 0.0], 50.0)
    np.testing.assert_allclose(known.rates, [np.inf, -np.log(0.9) / 50, 0.0], rtol=1e-14)


def test_extended_curve_continues_the_power_laws():
    x = np.array([0.05, 0.1, 0.2, 0.4, 0.8, 1.6])
    rates = 1e-3 * x**-1.7
    curve = rk.hazard.HazardCurve(x, np.where(x < 0.2, np.inf, np.where(x > 0.4, 0.0, rates)))
    extended = curve.extended(0.01, 5.0)
    np.testing.assert_allclose(extended.levels, [0.01, *x, 5.0])
    np.testing.assert_allclose(extended.rates, 1e-3 * np.array([0.01, *x, 5.0]) ** -1.7, rtol=1e-13)


def test_a_curve_that_falls_off_is_extended():
    """The power law of its last interval is beyond all numbers at the lowest level, where it is not asked for."""
    levels, rates = [0.01, 0.1, 1.0, 1.1], [1e-1, 1e-2, 1e-4, 1e-11]
    found = rk.hazard.HazardCurve(levels, rates).extended(0.001, 2.0)
    last = 1e-11 * (2.0 / 1.1) ** (-np.log(1e7) / np.log(1.1))
    np.testing.assert_allclose(found.rates, [1.0, *rates, last], rtol=1e-12)
    first = lambda lowest: rk.hazard.HazardCurve(levels, rates).extended(lowest, 2.0).rates[0]
    np.testing.assert_allclose(jax.jit(jax.grad(first))(0.001), -1000.0, rtol=1e-12)


@pytest.mark.parametrize("median", [0.02, 0.1, 0.5, 1.5])
def test_what_a_curve_leaves_open_is_bounded(median):
    """The rate under the full hazard lies between those under the curve that was cut, and under its power laws."""
    fragility = rk.hazard.LogNormalFragility(median, 0.4)
    place, levels = np.arange(80), np.geomspace(1e-4, 1e2, 80)

    def curve(first, end):
        """Its rates are known of the levels from the first on, before the end."""
        known = np.where(place < first, np.inf, np.where(place < end, site_rate(levels), 0.0))
        return rk.hazard.HazardCurve(levels, known)

    full = float(rk.hazard.toppling_rate(fragility, curve(0, 80)))
    cut = curve(36, 52)  # 0.05 g to 0.8 g
    inner = rk.hazard.HazardCurve(levels[1:-1], cut.rates[1:-1])
    below, above = (float(rk.hazard.toppling_rate(fragility, c)) for c in (cut, inner.extended(1e-4, 1e2)))
    assert below < full < above
    # Above the last level, what is left open is at most its rate times the probability to withstand it.
    beyond = curve(0, 52)
    most = site_rate(levels[51]) * (1 - ndtr(np.log(levels[51] / median) / 0.4))
    assert -1e-15 <= full - float(rk.hazard.toppling_rate(fragility, beyond)) <= most + 1e-15


# --------------------------------------------------------------------------------------- toppling rates


@pytest.mark.parametrize("k", [0.8, 2.3, 4.0])
@pytest.mark.parametrize("median, dispersion", [(0.2, 0.6), (0.4, 0.3), (0.7, 0.05)])
def test_power_law_hazard_with_lognormal_fragility(k, median, dispersion):
    """Cornell et al. (2002): k0 m^-k exp(k^2 b^2/2), in closed form, by quadrature, and as a fragility of a user."""
    levels = np.geomspace(1e-7, 1e3, 80)
    curve = rk.hazard.HazardCurve(levels, 1e-4 * levels**-k)
    exact = 1e-4 * median**-k * np.exp((k * dispersion) ** 2 / 2)
    rock, own = rk.hazard.LogNormalFragility(median, dispersion), Own(jnp.asarray(median), jnp.asarray(dispersion))
    np.testing.assert_allclose(rk.hazard.toppling_rate(rock, curve), exact, rtol=1e-12)
    np.testing.assert_allclose(rk.hazard.toppling_rate(own, curve), exact, rtol=1e-10)
    np.testing.assert_allclose(-np.log(rk.hazard.survival_probability(rock, 1.0, curve)), exact, rtol=1e-10)
    # Of one power law, two levels say all.
    two = rk.hazard.HazardCurve(levels[[0, -1]], 1e-4 * levels[[0, -1]] ** -k)
    np.testing.assert_allclose(rk.hazard.toppling_rate(rock, two), exact, rtol=1e-11)


@pytest.mark.parametrize("double, rtol", [(True, 1e-13), (False, 3e-6)])
def test_small_dispersions_keep_the_digits_of_the_rate(double, rtol):
    """Far within one power law the rate is that of the median times exp(k^2 b^2/2), down to a step."""
    with jax.enable_x64(double):
        curve = rk.hazard.HazardCurve([0.1, 0.2, 0.4, 0.8], [1e-2, 3e-3, 5e-4, 5e-5])
        k = np.log(3e-3 / 5e-4) / np.log(2)
        at_median = 3e-3 * (0.3 / 0.2) ** -k
        for dispersion in (1e-3, 1e-4, 1e-6, 1e-9, 1e-12):
            found = rk.hazard.toppling_rate(rk.hazard.LogNormalFragility(0.3, dispersion), curve)
            np.testing.assert_allclose(found, at_median * np.exp((k * dispersion) ** 2 / 2), rtol=rtol)


CURVES = {
    "site": CURVE,
    "few levels": rk.hazard.HazardCurve([0.1, 0.4, 0.5, 0.6], [2e-2, 1e-3, 5e-4, 2e-4]),
    "flat at first": rk.hazard.HazardCurve([0.1, 0.2, 0.3, 0.4], [1e-3, 1e-3, 1e-4, 1e-5]),
    "steep": rk.hazard.HazardCurve([0.1, 0.3, 0.35, 0.4], [1e-2, 1e-3, 1e-9, 1e-12]),
    "first unknown": rk.hazard.HazardCurve([0.05, 0.1, 0.3, 0.8], [np.inf, 1e-2, 1e-3, 1e-5]),
    "last unknown": rk.hazard.HazardCurve([0.1, 0.3, 0.5, 0.8], [1e-2, 1e-3, 0.0, 0.0]),
    "one known": rk.hazard.HazardCurve([0.1, 0.2, 0.3, 0.8], [np.inf, np.inf, 1e-3, 0.0]),
}


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("median, dispersion", [(0.35, 0.4), (0.25, 0.02), (1.5, 0.2), (0.02, 0.5)])
def test_toppling_rate_is_the_integral_over_the_curve(name, median, dispersion):
    """Both ways of integration against 30 digits, also where the fragility lies beyond the curve."""
    rock, breaks = rk.hazard.LogNormalFragility(median, dispersion), median * np.exp(dispersion * np.arange(-8, 9, 2))
    exact = float(integral(lognormal(median, dispersion), CURVES[name], breaks))
    np.testing.assert_allclose(rk.hazard.toppling_rate(rock, CURVES[name]), exact, rtol=1e-11)
    np.testing.assert_allclose(
        -np.log(rk.hazard.survival_probability(rock, 1.0, CURVES[name])), exact, rtol=1e-9, atol=1e-16
    )


def test_tabulated_fragility():
    """Straight lines over ln(level) between the table's levels, wherever these lie between those of the curve."""
    levels, values = np.array([0.12, 0.25, 0.33, 0.5]), np.array([0.1, 0.7, 0.3, 0.9])
    table = rk.hazard.TabulatedFragility(levels, values)
    inside = np.geomspace(0.12, 0.5, 50)
    found = np.asarray(table(np.append(inside, [0.119, 0.6])))
    np.testing.assert_allclose(found[:-2], np.interp(np.log(inside), np.log(levels), values), rtol=1e-13)
    np.testing.assert_allclose(found[-2:], [0.0, 0.9])

    def line(x):
        if x < levels[0]:
            return mp.mpf(0)
        i = min(np.searchsorted(levels, float(x), side="right") - 1, 2)
        share = mp.log(x / mp.mpf(levels[i])) / mp.log(mp.mpf(levels[i + 1]) / mp.mpf(levels[i]))
        return values[i] + (values[i + 1] - values[i]) * min(share, mp.mpf(1))

    for curve in CURVES.values():
        exact = float(integral(line, curve, levels))
        np.testing.assert_allclose(rk.hazard.toppling_rate(table, curve), exact, rtol=1e-12)


# --------------------------------------------------------------------------------------- survival


def shakings(rng, curve, years):
    """Times [years before present] and intensities of the shakings of some centuries."""
    levels, rates = np.asarray(curve.levels), np.asarray(curve.rates)
    count = rng.poisson(rates[0] * years)
    rate = rates[0] * rng.uniform(size=count)
    intensity = np.exp(np.interp(np.log(rate), np.log(rates[::-1]), np.log(levels[::-1])))
    return rng.uniform(0, years, count), intensity


# Kinds in turn: rocks of one kind are computed together, and must get their own ages.
ROCKS = [
    ROCK,
    rk.hazard.TabulatedFragility([0.1, 0.3, 0.5], [0.0, 0.6, 0.3]),
    TOUGH,
    rk.hazard.LogNormalFragility(0.3, 0.5),
]
AGES = [300.0, 200.0, 900.0, 100.0]


def topples(rock, level):
    """The probability by SciPy and NumPy, of these kinds."""
    if isinstance(rock, rk.hazard.LogNormalFragility):
        return ndtr(np.log(level / float(rock.median)) / float(rock.dispersion))
    levels, values = np.asarray(rock.levels), np.asarray(rock.probabilities)
    return np.interp(np.log(level), np.log(levels), values, left=0.0)


def test_survival_of_rocks_that_share_their_shakings():
    """Poisson shakings, each drawn once for all rocks, each rock drawn by its fragility while it is fragile."""
    rng, histories = np.random.default_rng(7), 8000
    # All histories in one go: they are told apart by where in a long time they lie.
    time, intensity = shakings(rng, CURVE, max(AGES) * histories)
    history, ago = np.divmod(time, max(AGES))
    toppled = np.zeros(time.shape, bool)
    for rock, age in zip(ROCKS, AGES):
        toppled |= (rng.uniform(size=time.size) < topples(rock, intensity)) & (ago < age)
    survived = 1 - np.unique(history[toppled]).size / histories
    probability = float(rk.hazard.survival_probability(ROCKS, AGES, CURVE))
    error = np.sqrt(probability * (1 - probability) / histories)
    assert abs(survived - probability) < 3 * error
    product = np.prod([rk.hazard.survival_probability(*pair, CURVE) for pair in zip(ROCKS, AGES)])
    assert 0.2 < product < probability - 10 * error < 0.8, "shared shakings are not independent ones"


def test_survival_against_direct_quadrature():
    """The definition: over time before present, over the curve, 1 - product of (1 - F) of the rocks already fragile."""
    logarithm = np.linspace(np.log(LEVELS[0]), np.log(LEVELS[-1]), 400_001)
    x, rate = np.exp(logarithm), np.exp(np.interp(logarithm, np.log(LEVELS), np.log(site_rate(LEVELS))))
    middle, falls = np.sqrt(x[1:] * x[:-1]), rate[:-1] - rate[1:]
    exponent = 0.0
    for start, end in ((0.0, 100.0), (100.0, 200.0), (200.0, 300.0), (300.0, 900.0)):
        there = [rock for rock, age in zip(ROCKS, AGES) if age >= end]
        joint = lambda level, there=there: 1 - np.prod([1 - topples(rock, level) for rock in there], axis=0)
        exponent += (end - start) * (np.sum(joint(middle) * falls) + rate[-1] * joint(x[-1:])[0])
    np.testing.assert_allclose(rk.hazard.survival_probability(ROCKS, AGES, CURVE), np.exp(-exponent), rtol=1e-7)


class Edge(rk.hazard.AbstractFragility):
    """A user's fragility without numbers of its own."""

    def __call__(self, level):
        return jnp.where(level < 0.4, 0.0, 1.0)

    @property
    def knots(self):
        return jnp.array([0.4])


class Halved(rk.hazard.LogNormalFragility):
    """A user's variant of the package's own: every second rock is gone."""

    def __call__(self, level):
        return super().__call__(level) / 2


def test_fragilities_without_numbers():
    """They topple together, so that the oldest counts."""
    found = rk.hazard.survival_probability([Edge(), Edge()], [200.0, 300.0], CURVE)
    np.testing.assert_allclose(found, np.exp(-300 * CURVE.rate(0.4)), rtol=1e-13)
    jax.eval_shape(lambda age: rk.hazard.allowed_scale(Edge(), age, CURVE), 300.0)


def test_a_variant_of_the_lognormal_fragility_has_its_own_rate():
    rock = Halved(0.35, 0.4)
    np.testing.assert_allclose(
        rk.hazard.toppling_rate(rock, CURVE), rk.hazard.toppling_rate(ROCK, CURVE) / 2, rtol=1e-9
    )


def test_limits_of_survival():
    rate = float(CURVE.rate(0.4))
    step = Step(0.4)
    # Rocks without scatter of their own topple together: any number of them is one, the weakest counts.
    one = rk.hazard.survival_probability(step, 500.0, CURVE)
    np.testing.assert_allclose(one, np.exp(-500 * rate), rtol=1e-13)
    np.testing.assert_allclose(rk.hazard.survival_probability([step] * 3, 500.0, CURVE), one, rtol=1e-13)
    np.testing.assert_allclose(
        rk.hazard.survival_probability([step, Step(0.9), Step(0.5)], 500.0, CURVE), one, rtol=1e-13
    )
    # Certain to topple in the weakest shaking that the curve knows; certain not to.
    np.testing.assert_allclose(rk.hazard.survival_probability(Step(1e-3), 30.0, CURVE), np.exp(-30 * CURVE.rates[0]))
    assert rk.hazard.survival_probability(Step(0.1, 0.0), 1e6, CURVE) == 1
    assert rk.hazard.survival_probability(ROCK, 0.0, CURVE) == 1
    np.testing.assert_allclose(
        rk.hazard.survival_probability([ROCK, Step(0.1, 0.0)], 500.0, CURVE),
        rk.hazard.survival_probability(ROCK, 500.0, CURVE),
    )
    # Two rocks that withstand half of all shakings each, all by luck: half of a half remains.
    halves = rk.hazard.survival_probability([Step(0.4, 0.5)] * 2, 500.0, CURVE)
    np.testing.assert_allclose(halves, np.exp(-500 * rate * 0.75), rtol=1e-13)


def test_a_rock_counts_since_it_became_fragile():
    weak, strong = Step(0.2), Step(0.5)
    low, high = float(CURVE.rate(0.2)), float(CURVE.rate(0.5))
    for rocks, ages in (([weak, strong], [300.0, 900.0]), ([strong, weak], [900.0, 300.0])):
        expected = np.exp(-300 * low - 600 * high)  # the weak one masks the strong one for as long as it is there
        np.testing.assert_allclose(rk.hazard.survival_probability(rocks, ages, CURVE), expected, rtol=1e-13)
    np.testing.assert_allclose(
        rk.hazard.survival_probability([weak, strong], [900.0, 300.0], CURVE), np.exp(-900 * low), rtol=1e-13
    )
    # Of rocks of one age, order does not matter.
    forth, back = (rk.hazard.survival_probability(rocks, 400.0, CURVE) for rocks in (ROCKS, ROCKS[::-1]))
    np.testing.assert_allclose(forth, back, rtol=1e-13)


def test_uncertain_ages_are_a_mean_over_samples():
    samples = np.random.default_rng(1).uniform(100.0, 3000.0, (50, 4))
    each = np.asarray(jax.jit(jax.vmap(lambda ages: rk.hazard.survival_probability(ROCKS, ages, CURVE)))(samples))
    for i in (0, 17, 49):
        np.testing.assert_allclose(each[i], rk.hazard.survival_probability(ROCKS, samples[i], CURVE), rtol=1e-13)


# --------------------------------------------------------------------------------------- branches and scales


def test_weights_of_branches():
    """Bayes by hand; and a branch under which the rock can hardly stand is left with nothing."""
    np.testing.assert_allclose(
        rk.hazard.branch_weights([0.5, 0.3, 0.2], [0.1, 0.5, 0.0]), [0.25, 0.75, 0.0], rtol=1e-14
    )
    np.testing.assert_allclose(
        rk.hazard.branch_weights([2.0, 1.0, 1.0], [0.3, 0.3, 0.3]), [0.5, 0.25, 0.25], rtol=1e-14
    )
    branches = rk.hazard.HazardCurve(np.tile(LEVELS, (3, 1)), site_rate(LEVELS) * np.array([[0.3], [1.0], [10.0]]))
    survival = jax.jit(jax.vmap(lambda curve: rk.hazard.survival_probability(ROCK, 2000.0, curve)))(branches)
    rate = rk.hazard.toppling_rate(ROCK, CURVE)
    np.testing.assert_allclose(survival, np.exp(-2000 * rate * np.array([0.3, 1.0, 10.0])), rtol=1e-9)
    weights = np.asarray(rk.hazard.branch_weights(np.full(3, 1 / 3), survival))
    np.testing.assert_allclose(weights.sum(), 1, rtol=1e-14)
    assert weights[0] > 0.8 and weights[2] < 1e-6


def allowed(numbers, curve):
    """The factor that an age [years] and a probability allow."""
    return rk.hazard.allowed_scale(ROCK, numbers[0], curve, numbers[1])


def with_derivatives(age, curve, probability=0.05):
    """The allowed factor, its slopes by age and probability, and how these change with the probability."""
    return _with_derivatives(age, curve, probability)


@jax.jit
def _with_derivatives(age, curve, probability):

    def slopes(probability):
        return jax.value_and_grad(allowed)(jnp.stack([age, probability]), curve)

    (value, first), (_, second) = jax.jvp(slopes, (probability,), (jnp.ones_like(probability),))
    return value, first, second


def test_allowed_scale_under_a_power_law():
    """Intensities times s raise the toppling rate of a power law by s^k: the factor in closed form."""
    k, age = 2.3, 2e4
    levels = np.geomspace(1e-5, 1e3, LEVELS.size)
    curve = rk.hazard.HazardCurve(levels, 1e-5 * levels**-k, "PGA")
    once = age * 1e-5 * 0.35**-k * np.exp((k * 0.4) ** 2 / 2)
    exact = lambda probability: (-np.log(probability) / once) ** (1 / k)
    np.testing.assert_allclose(with_derivatives(age, curve)[0], exact(0.05), rtol=1e-12)
    # d s/d p = s/(k p ln p), and its derivative.
    p, slope = 0.2, exact(0.2) / (k * 0.2 * np.log(0.2))
    curvature = slope * (1 / (k * p * np.log(p)) - 1 / p - 1 / (p * np.log(p)))
    _, first, second = with_derivatives(age, curve, p)
    np.testing.assert_allclose(np.array([first, second])[:, 1], [slope, curvature], rtol=1e-9)


def test_no_factor_is_large_or_small_enough():
    """The curve knows 0.21 shakings a year: in 14 years the weakest rock stands with more than 5 %."""
    assert 14 * float(CURVE.rates[0]) < -np.log(0.05) < 15 * float(CURVE.rates[0])
    certain = rk.hazard.TabulatedFragility([1e-9, 2e-9, 3e-9, 4e-9], [1.0, 1.0, 1.0, 1.0])
    assert rk.hazard.allowed_scale(certain, 2000.0, CURVE) == 0
    values, slopes, _ = zip(
        *(jax.device_get(with_derivatives(age, CURVE)) for age in (14.0, 15.0, 99.99, 100.0, 100.01))
    )
    assert values[0] == np.inf and 1 < values[1] < np.inf
    assert slopes[0][0] == 0
    np.testing.assert_allclose(slopes[3][0], (values[4] - values[2]) / 0.02, rtol=1e-6)


def test_allowed_scale_is_the_first_of_several():
    """A rock that only middling shakings topple stands under weak and under strong hazard."""
    rock = rk.hazard.TabulatedFragility([0.2, 0.3, 0.5, 0.6], [0.0, 1.0, 1.0, 0.0])
    levels = np.geomspace(0.1, 0.11, LEVELS.size)
    curve = rk.hazard.HazardCurve(levels, 1e-3 * (1 - 1e-9 * np.linspace(0.0, 1.0, LEVELS.size)), "PGA")
    scale = float(rk.hazard.allowed_scale(rock, 6000.0, curve))
    assert 2.0 < scale / (0.1 / 0.11) and scale < 3.0
    for factor, probability in ((1.5, 1.0), (0.999 * scale, 0.0515), (1.001 * scale, 0.0485), (7.0, 1.0)):
        np.testing.assert_allclose(
            rk.hazard.survival_probability(rock, 6000.0, curve.scaled(factor)), probability, rtol=0.03
        )


def rebuilt(numbers):
    """Rocks, ages and a curve from 9 numbers."""
    medians, dispersions, ages, rest = numbers[:2], numbers[2:4], numbers[4:6], numbers[6:9]
    rocks = [rk.hazard.LogNormalFragility(m, b) for m, b in zip(medians, dispersions)]
    rocks += [rk.hazard.TabulatedFragility(jnp.append(rest[0], 0.5), jnp.append(0.2, rest[1]))]
    curve = rk.hazard.HazardCurve(LEVELS, CURVE.rates * jnp.asarray(LEVELS) ** (rest[2] - 1))
    return rocks, jnp.append(ages, 80.0), curve


def results(numbers):
    """Rates of two of the rocks, survival of all where shakings are times the tenth number, and the factor that the
    last one allows."""
    rocks, ages, curve = rebuilt(numbers)
    rates = [rk.hazard.toppling_rate(rock, curve) for rock in (rocks[0], rocks[2])]
    survival = rk.hazard.survival_probability(rocks, ages, curve.scaled(numbers[9]))
    return jnp.stack([*rates, survival, rk.hazard.allowed_scale(rocks, ages, curve, numbers[10])])


NUMBERS = np.array([0.35, 0.6, 0.4, 0.25, 150.0, 40.0, 0.21, 0.7, 1.05, 1.1, 0.05])
RESULTS = pushed(results)


def test_derivatives():
    """By medians, dispersions, ages, an edge and a value of a table, the slope of the curve, what multiplies its
    levels, and the probability that is asked for."""
    assert_slopes(RESULTS, NUMBERS)


def test_allowed_scale_brings_survival_to_the_probability():
    rows = np.tile(NUMBERS, (STEPS.size, 1))  # as many as above
    probabilities = np.array([0.01, 0.05, 0.5])
    rows[:3, 10] = probabilities
    scales = np.asarray(RESULTS(rows, rows)[0])[:3, 3]
    rows[:4, 9] = *scales, 1.001 * scales[1]
    *survival, beyond = np.asarray(RESULTS(rows, rows)[0])[:4, 2]
    np.testing.assert_allclose(survival, probabilities, rtol=1e-12)
    assert beyond < 0.05
    np.testing.assert_allclose(CURVE.scaled(3.0).levels, 3 * LEVELS, rtol=1e-15)
    np.testing.assert_array_equal(CURVE.scaled(3.0).rates, CURVE.rates)


SLOPES = [
    jax.jit(jax.value_and_grad(lambda curve: rk.hazard.toppling_rate(ROCK, curve))),
    jax.jit(jax.value_and_grad(lambda curve: jnp.log(rk.hazard.survival_probability(ROCK, 50.0, curve)))),
]


@pytest.mark.parametrize("name", ["first unknown", "last unknown", "one known"])
def test_derivatives_where_rates_are_unknown(name):
    """In reverse mode. Nothing hangs on a rate that is not known, and results are proportional to all those known."""
    rates = np.asarray(CURVES[name].rates)
    known = np.isfinite(rates) & (rates > 0)
    for function in SLOPES:
        value, slopes = jax.device_get(function(CURVES[name]))
        assert np.all(slopes.rates[~known] == 0)
        np.testing.assert_allclose(slopes.rates[known] @ rates[known], value, rtol=1e-12)


@pytest.mark.parametrize(
    "call, error",
    [
        (
            lambda: rk.hazard.HazardCurve([0.1, 0.1], [1e-2, 1e-3]),
            "`levels` must be positive and finite, and rise .* is 0.1",
        ),
        (lambda: rk.hazard.HazardCurve([0.0, 0.1], [1e-2, 1e-3]), "`levels` must be positive"),
        (lambda: rk.hazard.HazardCurve([0.1], [1e-2]), r"`levels` must hold at least two levels, but has shape \(1,\)"),
        (
            lambda: rk.hazard.HazardCurve([0.1, 0.2], [1e-3, 1e-2]),
            "`rates` must be 0 or more, never rise, .* but is 0.01",
        ),
        (lambda: rk.hazard.HazardCurve([0.1, 0.2], [1e-3, -1e-3]), "`rates` must be 0 or more"),
        (lambda: rk.hazard.HazardCurve([0.1, 0.2], [1e-3, np.nan]), "`rates` must be 0 or more"),
        (
            lambda: rk.hazard.HazardCurve([0.1, 0.2], [np.inf, 0.0]),
            "`rates` .* infinite only before a positive finite one",
        ),
        (
            lambda: rk.hazard.HazardCurve([0.1, 0.2], [1e-3, 1e-4, 1e-5]),
            r"`rates` must have the shape \(2,\) of `levels`",
        ),
        (
            lambda: rk.hazard.HazardCurve.from_probabilities([0.1, 0.2], [1.1, 0.1], 50.0),
            r"`probabilities` must be in \[0, 1\], but is 1.1",
        ),
        (
            lambda: rk.hazard.HazardCurve.from_probabilities([0.1, 0.2], [0.2, 0.1], 0.0),
            "`investigation_time` must be pos",
        ),
        (lambda: CURVE.extended(0.01, 5.0), "`lowest` must be positive and below the first level, but is 0.01"),
        (lambda: CURVE.extended(0.001, 1.0), "`highest` must be finite and above the last level, but is 1.0"),
        (lambda: CURVES["one known"].extended(0.01, 5.0), "`rates` must be known at two levels or more"),
        (lambda: CURVE.scaled(-1.0), "`factor` must be positive"),
        (lambda: rk.hazard.LogNormalFragility(0.3, 0.0), "`dispersion` must be positive and finite, but is 0.0"),
        (lambda: rk.hazard.LogNormalFragility(-0.3, 0.1), "`median` must be positive"),
        (
            lambda: rk.hazard.TabulatedFragility([0.1, 0.2], [0.5, 1.2]),
            r"`probabilities` must be in \[0, 1\], but is 1.2",
        ),
        (
            lambda: rk.hazard.TabulatedFragility([0.2, 0.1], [0.5, 0.7]),
            "`levels` must be positive and finite, and rise",
        ),
        (lambda: rk.hazard.TabulatedFragility([0.1, 0.2], [0.5]), "`probabilities` must have the shape"),
        (
            lambda: rk.hazard.survival_probability([ROCK], [1.0, 2.0], CURVE),
            r"`ages` must be one for each of 1 rocks, .*\(2,\)",
        ),
        (lambda: rk.hazard.survival_probability([], 1.0, CURVE), "`ages` must be one for each of 0 rocks"),
        (lambda: rk.hazard.survival_probability(ROCK, -1.0, CURVE), "`ages` must be 0 or more and finite, but is -1.0"),
        (
            lambda: rk.hazard.toppling_rate(rk.hazard.LogNormalFragility(np.array([0.3, 0.4]), 0.1), CURVE),
            r"`fragilities` must each be of one rock, but one has shape \(2,\)",
        ),
        (
            lambda: rk.hazard.toppling_rate(
                ROCK, rk.hazard.HazardCurve(np.array([[0.1, 0.2]]), np.array([[1e-2, 1e-3]]))
            ),
            r"`curve` must be one, but has levels of shape \(1, 2\). Use jax.vmap",
        ),
        (lambda: rk.hazard.allowed_scale(ROCK, 1.0, CURVE, 1.0), r"`probability` must be in \(0, 1\), but is 1.0"),
        (lambda: rk.hazard.branch_weights([1.0, 1.0], [0.5]), "`prior` and `survival` must be lists of one length"),
        (lambda: rk.hazard.branch_weights([], []), "`prior` and `survival` must hold at least one branch"),
        (
            lambda: rk.hazard.branch_weights([-1.0, 1.0], [0.5, 0.5]),
            "`prior` must be 0 or more and finite, but is -1.0",
        ),
        (
            lambda: rk.hazard.branch_weights([0.0, 1.0], [0.5, 0.0]),
            "`survival` must be above 0 for a branch that has weight",
        ),
        (lambda: rk.hazard.fit_fragility([0.1, 0.2], [0.0, 2.0]), "`toppled` must be from 0 to `trials`, but is 2.0"),
        (lambda: rk.hazard.fit_fragility([0.1, 0.2], [0.0]), r"`toppled` must have the shape \(2,\) of `levels`"),
        (lambda: rk.hazard.fit_fragility([0.1, 0.2], [0.0, 1.0], [1.0, 1.0, 1.0]), "`trials` must have shape"),
        (lambda: rk.hazard.fit_fragility([0.1, -0.2], [0.0, 1.0]), "`levels` must be positive"),
        (lambda: rk.hazard.fit_fragility([], []), "`levels` must be a list of at least one value"),
    ],
)
def test_wrong_arguments(call, error):
    with pytest.raises(ValueError, match=error):
        call()


# --------------------------------------------------------------------------------------- fits


MOST = 27  # levels of a fit


def fitted(levels, toppled, trials):
    """A fit to `MOST` levels, so that all are compiled as one: those without a trial say nothing."""
    unused = MOST - len(levels)
    return jax.device_get(
        rk.hazard.fit_fragility(
            np.array([*levels, *np.linspace(0.1, 2.0, unused)]), np.append(toppled, [0] * unused),
            np.append(trials, [0] * unused),
        )
    )  # fmt: skip


def test_fit_to_counts_at_two_levels():
    """Two counts fix the line: z = Phi^-1(share) at each level, with the variance p (1 - p)/(n phi^2)."""
    levels, toppled, trials = np.array([0.2, 0.5]), np.array([3, 17]), np.array([20, 25])
    fit = fitted(levels, toppled, trials)
    assert fit.status == rk.hazard.FitStatus.successful
    p, x = toppled / trials, np.log(levels)
    z = ndtri(p)
    line = lambda z: np.array([x[0] - z[0] * (x[1] - x[0]) / (z[1] - z[0]), np.log((x[1] - x[0]) / (z[1] - z[0]))])
    parameters = np.log([fit.fragility.median, fit.fragility.dispersion])
    np.testing.assert_allclose(parameters, line(z), rtol=1e-12)
    variance = p * (1 - p) / trials / (np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)) ** 2
    jacobian = np.stack([(line(z + 1e-6 * e) - line(z - 1e-6 * e)) / 2e-6 for e in np.eye(2)], axis=1)
    np.testing.assert_allclose(fit.covariance, jacobian @ np.diag(variance) @ jacobian.T, rtol=1e-7)
    likelihood = np.sum(toppled * np.log(p) + (trials - toppled) * np.log(1 - p))
    np.testing.assert_allclose(fit.log_likelihood, likelihood, rtol=1e-13)


def test_fit_recovers_a_fragility():
    """Over many data sets of 200 shakings the truth lies in the ellipse of 95 % in 95 % of them."""
    rng = np.random.default_rng(3)
    levels = np.exp(rng.uniform(np.log(0.1), np.log(1.0), (300, 25)))
    toppled = rng.binomial(8, ndtr(np.log(levels / 0.35) / 0.4))
    many = jax.jit(jax.vmap(lambda *data: rk.hazard.fit_fragility(*data, 8)))
    fits = jax.device_get(many(levels, toppled))
    assert np.all(fits.status == rk.hazard.FitStatus.successful)
    off = np.log(np.stack([fits.fragility.median / 0.35, fits.fragility.dispersion / 0.4], -1))
    assert np.abs(off.mean(0)).max() < 0.03
    distance = np.einsum("ni,nij,nj->n", off, np.linalg.inv(fits.covariance), off)
    assert 0.92 < np.mean(distance < -2 * np.log(0.05)) < 0.98


def test_fit_to_single_outcomes_is_the_fit_to_their_counts():
    levels = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    toppled, trials = np.array([1, 2, 4, 3, 5]), np.array([6, 6, 6, 4, 5])
    single = np.concatenate([np.arange(n) < k for k, n in zip(toppled, trials)])
    assert single.size == MOST
    a, b = fitted(levels, toppled, trials), rk.hazard.fit_fragility(np.repeat(levels, trials), single)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)):
        np.testing.assert_allclose(x, y, rtol=1e-10)
    assert a.highest_survived == 0.4 and a.lowest_toppled == 0.1


@pytest.mark.parametrize(
    "levels, toppled, status, between",
    [
        pytest.param([1, 2, 3, 4], [0, 0, 1, 1], "separable", (2, 3), id="a gap between survived and toppled"),
        pytest.param([1, 2, 2, 3], [0, 0, 1, 1], "separable", (2, 2), id="they meet at one level"),
        pytest.param([1, 2, 3], [1, 1, 1], "separable", (0, 1), id="all toppled"),
        pytest.param([1, 2, 3], [0, 0, 0], "separable", (3, np.inf), id="all survived"),
        pytest.param([2, 2, 2], [0, 1, 1], "separable", (2, 2), id="one level only"),
        pytest.param([1, 2, 3, 4], [1, 1, 0, 0], "separable", (4, 1), id="upside down"),
        pytest.param([5], [1], "separable", (0, 5), id="one shaking"),
        pytest.param([], [], "separable", (0, np.inf), id="none"),
        pytest.param([1, 2, 3, 4], [1, 1, 0, 1], "not_growing", (3, 1), id="weaker ones topple more"),
        pytest.param([1, 1.5, 2, 3, 4], [1, 0, 0, 0, 1], "not_growing", (3, 1), id="weakest and strongest"),
        pytest.param([1, 2, 2, 4], [0, 1, 0, 0], "not_growing", (4, 2), id="hardly any"),
        pytest.param([1, 2, 3, 4], [0, 1, 0, 1], "successful", (3, 2), id="just overlapping"),
    ],
)
def test_fit_says_what_the_data_do_not(levels, toppled, status, between):
    fit = fitted(levels, toppled, [1] * len(levels))
    assert fit.status == getattr(rk.hazard.FitStatus, status)
    assert (fit.highest_survived, fit.lowest_toppled) == between
    numbers = [fit.fragility.median, fit.fragility.dispersion, fit.log_likelihood, *fit.covariance.ravel()]
    assert np.all(np.isfinite(numbers)) if status == "successful" else np.all(np.isnan(numbers))


def test_fit_has_derivatives():
    """How median and dispersion follow levels and counts."""

    def line(numbers):
        fit = rk.hazard.fit_fragility(numbers[:4], numbers[4:], 8)
        return jnp.stack([fit.fragility.median, fit.fragility.dispersion])

    assert_slopes(pushed(line), np.array([0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 4.0, 5.0]))


# --------------------------------------------------------------------------------------- files

IMLS = [0.005, 0.0192, 0.145, 0.5, 1.0]
SITES = {(-122.5, 38.1): [0.87, 0.65, 0.06, 4e-4, 0.0], (-121.93, 38.1): [1.0, 0.9, 0.3, 2e-3, 1e-5]}


def engine_file(kind="mean", time=50.0, imt="PGA", sites=SITES, form="poe-%.7f", names=None):
    """A hazard-curve file as `openquake.baselib.writers.write_csv` writes it: lines end in CR LF."""
    out = io.StringIO()
    writer = csv.writer(out)
    header = ["lon", "lat", "depth", *(form % level for level in IMLS)]
    header = ["custom_site_id", *header] if names else header
    comment = dict(generated_by="OpenQuake engine 3.20.0", start_date="2024-06-03T09:36:04", checksum=2107362341)
    comment |= dict(kind=kind, investigation_time=time, imt=imt)
    text = ", ".join(f"{key}={value!r}" for key, value in comment.items())
    writer.writerow(["#", *[""] * (len(header) - 2), text])
    writer.writerow(header)
    for i, ((lon, lat), poes) in enumerate(sites.items()):
        row = [f"{x:.5f}" for x in (lon, lat, -0.1 * i)] + [f"{p:.6E}" for p in poes]
        writer.writerow([names[i], *row] if names else row)
    return out.getvalue()


@pytest.fixture
def file(tmp_path):
    """Write a file and return its path."""

    def write(content, name="hazard_curve-mean-PGA_12.csv"):
        path = tmp_path / name
        path.write_bytes(content.encode())
        return path

    return write


def test_file_of_the_engine(file):
    found = rk.hazard.read_hazard_curves(file(engine_file()))
    np.testing.assert_allclose(found.longitude, [-122.5, -121.93])
    np.testing.assert_allclose(found.latitude, [38.1, 38.1])
    np.testing.assert_allclose(found.depth, [0.0, -0.1])
    assert (found.kinds, found.names, found.curves.measure) == (("mean",), ("", ""), "PGA")
    assert found.curves.rates.shape == (1, 2, 5)
    curve = found.at(0, 0)
    np.testing.assert_allclose(curve.levels, IMLS)
    np.testing.assert_allclose(curve.rates, -np.log1p(-np.array([0.87, 0.65, 0.06, 4e-4, 0.0])) / 50, rtol=1e-12)
    assert np.isinf(found.at(1, 0).rates[0]), "a probability printed as 1 tells no rate"
    assert 0 < float(rk.hazard.survival_probability(ROCK, 1000.0, curve)) < 1
    assert found.at(1).rates.shape == (1, 5)


def test_files_of_several_branches(file):
    kinds = ["rlz-000", "rlz-001", "quantile-0.15"]
    more = lambda factor: {site: [min(p * factor, 1.0) for p in poes] for site, poes in SITES.items()}
    paths = [
        file(engine_file(kind, sites=more(1 - 0.1 * i)), f"hazard_curve-{kind}.csv") for i, kind in enumerate(kinds)
    ]
    found = rk.hazard.read_hazard_curves(paths)
    assert found.kinds == tuple(kinds)
    assert found.curves.levels.shape == found.curves.rates.shape == (3, 2, 5)
    np.testing.assert_allclose(np.asarray(found.at(0, 2).rates)[1], -np.log1p(-0.8 * 0.65) / 50, rtol=1e-12)
    both = lambda curve: (
        rk.hazard.survival_probability(ROCK, 1000.0, curve),
        rk.hazard.toppling_rate(ROCK, curve),
    )
    survival, rate = jax.device_get(jax.jit(jax.vmap(jax.vmap(both)))(found.curves))
    single = [rk.hazard.survival_probability(ROCK, 1000.0, found.at(1, branch)) for branch in range(3)]
    np.testing.assert_allclose(survival[:, 1], single, rtol=1e-13)
    np.testing.assert_array_equal(found.at(1).rates, np.asarray(found.curves.rates)[:, 1])
    np.testing.assert_allclose(rate[2, 1], rk.hazard.toppling_rate(ROCK, found.at(1, 2)), rtol=1e-13)


OLD = "lon,lat,depth,poe-0.1,poe-0.4,poe-1.0\n0.00000,0.00000,-0.10000,4.528811E-01,5.589804E-02,5.585141E-03\n"


@pytest.mark.parametrize(
    "content, kind, measure, names",
    [
        pytest.param(engine_file("max", imt="SA(0.1)"), "max", "SA(0.1)", ("", ""), id="spectral acceleration"),
        pytest.param(engine_file(imt="CAV"), "mean", "CAV", ("", ""), id="cumulative absolute velocity"),
        pytest.param(engine_file(imt="PGD"), "mean", "PGD", ("", ""), id="displacement"),
        pytest.param(engine_file(imt="SDi(0.3,2.0)"), "mean", "SDi(0.3,2.0)", ("", ""), id="comma in the measure"),
        pytest.param(engine_file(form="poe-%.5e"), "mean", "PGA", ("", ""), id="levels since 3.25"),
        pytest.param(engine_file(names=["0:CD", "1001"]), "mean", "PGA", ("0:CD", "1001"), id="custom site ids"),
        pytest.param(
            engine_file().replace("\r\n", "\n") + "\n\n", "mean", "PGA", ("", ""), id="line feeds, blank lines"
        ),
        pytest.param(
            '# quantile-0.1, investigation_time=50.0,imt="PGA"\n' + OLD, "quantile-0.1", "PGA", ("",), id="old quantile"
        ),
        pytest.param(
            "# source_model_tree_path=('b1',), gsim_tree_path=('b1',), investigation_time=50.0,imt=PGV\n" + OLD,
            "source_model_tree_path=('b1',), gsim_tree_path=('b1',)",
            "PGV",
            ("",),
            id="old branch",
        ),
        pytest.param(
            "# mean, investigation_time=50.0, imt=PGA\n" + OLD.replace("depth,", "").replace("-0.10000,", ""),
            "mean",
            "PGA",
            ("",),
            id="no depth",
        ),
    ],
)
def test_variants_of_files(file, content, kind, measure, names):
    found = rk.hazard.read_hazard_curves(str(file(content)))
    assert (found.kinds, found.curves.measure, found.names) == ((kind,), measure, names)
    first = [0.005, 0.0192] if "0.0192" in content or "1.92" in content else [0.1, 0.4]
    per_unit = {"PGV": 100, "PGD": 100, "CAV": 1 / 9.81}.get(measure, 1)  # cm/s, cm, g s in files; m/s, m, m/s here
    np.testing.assert_allclose(found.at(0, 0).levels[:2], np.array(first) / per_unit)
    probability = 0.65 if first[0] == 0.005 else 5.589804e-2
    np.testing.assert_allclose(found.at(0, 0).rates[1], -np.log1p(-probability) / 50, rtol=1e-12)


def test_noise_of_single_precision_is_levelled(file):
    content = engine_file().replace("6.500000E-01", "8.700001E-01").replace("0.000000E+00", "4.000001E-04")
    rates = rk.hazard.read_hazard_curves(file(content)).at(0, 0).rates
    assert rates[1] == rates[0] and rates[4] == rates[3]


@pytest.mark.parametrize(
    "content, error",
    [
        ("", r"File `broken.csv`: is empty\."),
        (engine_file().split("\r\n", 1)[1], "line 1 should be a comment that states investigation_time and imt"),
        (engine_file().replace("investigation_time=50.0, ", ""), "line 1 should be a comment"),
        (engine_file().replace("imt='PGA'", "x=1"), "line 1 should be a comment"),
        (engine_file().replace("=50.0", "=0.0"), "line 1 states an investigation time of '0.0'"),
        (engine_file().replace("=50.0", "=None"), "line 1 states an investigation time of 'None'"),
        (engine_file().split("\r\n")[0], "line 2 should name the columns of hazard curves"),
        (engine_file(form="PGA-%s"), "line 2 should name the columns of hazard curves.*is 'lon,lat,depth,PGA-0.005"),
        (engine_file().replace("lon,", "x,"), "line 2 should name the columns"),
        (engine_file().replace(",poe-0.1450000", ",vs30"), "line 2 should name the columns"),
        (engine_file().replace("poe-0.1450000", "poe-x"), "line 2 holds 'x', which is not a finite number"),
        (engine_file().replace("poe-0.1450000", "poe-0.0000000"), "line 2 should hold at least two levels"),
        ("\r\n".join(engine_file().split("\r\n")[:2]), "holds no sites"),
        (engine_file().replace(",0.000000E+00", ""), "line 3 has 7 columns, but the header has 8"),
        (engine_file().replace("8.700000E-01", "nan"), "line 3 holds 'nan', which is not a finite number"),
        (engine_file().replace("6.500000E-01", "6.5x"), "line 3 holds '6.5x'"),
        (engine_file().replace("-121.93000", ""), "line 4 holds '', which is not a finite number"),
        (engine_file().replace("6.500000E-01", "1.650000E+00"), r"line 3 holds a probability that is not in \[0, 1\]"),
        (engine_file().replace("6.500000E-01", "8.710000E-01"), "line 3 holds probabilities that rise with the level"),
        (engine_file(sites={(0.0, 0.0): [1, 1, 1, 0, 0]}), "line 3 holds no probability between 0 and 1"),
        ("PK\x03\x04\x00\x00", "is not plain text"),
    ],
)
def test_damaged_files(file, content, error):
    with pytest.raises(ValueError, match="File `broken.csv`: " + error.removeprefix("File `broken.csv`: ")):
        rk.hazard.read_hazard_curves(file(content, "broken.csv"))


@pytest.mark.parametrize(
    "content, error",
    [
        (engine_file(imt="PGV"), "File `other.csv`: differs in its measure from file `first.csv`"),
        (engine_file().replace("poe-0.145", "poe-0.146"), "differs in its levels"),
        (engine_file().replace("-121.93", "-121.94"), "differs in its sites"),
        (engine_file(names=["a", "b"]), "differs in its sites"),
        (engine_file().split("-121.93")[0], "differs in its sites"),
    ],
)
def test_files_that_do_not_belong_together(file, content, error):
    with pytest.raises(ValueError, match=error):
        rk.hazard.read_hazard_curves([file(engine_file(), "first.csv"), file(content, "other.csv")])


def test_what_is_not_there(file):
    found = rk.hazard.read_hazard_curves(file(engine_file()))
    with pytest.raises(ValueError, match="`site` must be a whole number from 0 to 1, but is 2"):
        found.at(2)
    with pytest.raises(ValueError, match="`branch` must be a whole number from 0 to 0, but is -1"):
        found.at(0, -1)
    with pytest.raises(ValueError, match="`paths` must be a file or a list of files, but is empty"):
        rk.hazard.read_hazard_curves([])
    with pytest.raises(FileNotFoundError):
        rk.hazard.read_hazard_curves("nowhere.csv")


def probabilities(size, levels):
    """By a fragility of each kind."""
    lognormal = rk.hazard.LogNormalFragility(0.5 * size, 0.4)
    table = rk.hazard.TabulatedFragility(jnp.array([0.1, 0.3]) * size, [0.0, 1.0])
    surface = rk.hazard.SurfaceFragility(0.5 * jnp.asarray(size), jnp.asarray(0.0), jnp.asarray(0.4))
    return jnp.stack([lognormal(levels), table(levels), surface(levels, 1.0)])


WITH_SLOPES = jax.jit(lambda *x: (probabilities(*x), jax.jacfwd(probabilities)(*x), jax.jacrev(probabilities)(*x)))


@pytest.mark.parametrize("level, probability", [(0.0, 0.0), (np.inf, 1.0)])
def test_slopes_at_the_ends_of_all_levels(level, probability):
    """None, and no NaN, which would spoil the slopes of all other levels."""
    levels = np.array([level, 0.2])
    values, forward, reverse = map(np.asarray, WITH_SLOPES(1.0, levels))
    np.testing.assert_allclose(values[:, 0], probability, atol=0)
    np.testing.assert_allclose(forward[:, 0], 0, atol=0)
    above, below = (np.asarray(WITH_SLOPES(1.0 + step, levels)[0]) for step in (1e-6, -1e-6))
    np.testing.assert_allclose(forward[:, 1], (above - below)[:, 1] / 2e-6, rtol=1e-6)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)


def test_slopes_where_a_knot_is_a_level_of_the_curve():
    """Beside the closed form of a lognormal fragility, and beside differences."""
    levels = np.array([0.1, 0.2, 0.4, 0.8])
    curve = rk.hazard.HazardCurve(levels, [1e-2, 3e-3, 5e-4, 5e-5])

    def survival(median):
        return rk.hazard.survival_probability(rk.hazard.LogNormalFragility(median, 0.35), 1000.0, curve)

    def closed(median):
        return jnp.exp(-1000 * rk.hazard.toppling_rate(rk.hazard.LogNormalFragility(median, 0.35), curve))

    slopes = jax.jit(lambda x: [jax.jvp(jax.grad(f), (x,), (1.0,)) for f in (survival, closed)])
    first, second = np.transpose(slopes(0.4))
    np.testing.assert_allclose(*first, rtol=1e-9)
    np.testing.assert_allclose(*second, rtol=1e-8)

    def rate(levels):
        return rk.hazard.toppling_rate(rk.hazard.TabulatedFragility(levels, [0.0, 0.2, 0.6, 1.0]), curve)

    with_slopes = jax.jit(jax.value_and_grad(rate))
    for i in (1, 2):
        step = 1e-6 * np.eye(4)[i]
        above, below = (float(with_slopes(levels + side)[0]) for side in (step, -step))
        np.testing.assert_allclose(np.asarray(with_slopes(levels)[1])[i], (above - below) / 2e-6, rtol=1e-5)
