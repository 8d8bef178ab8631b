"""A flexible base that begins to turn, and its first return: the restitution acts only there.

SciPy's integration of a chain of elements is the judge. Some cases need none: before the first return nothing depends
on the restitution. Every impact ends a phase in which the base has turned, and mirrored scenes answer mirrored.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.flexible.nonlinear import scene_of
from references.flexible_column import TALL, Chain

STOCKY = dict(width=2.29, height=10.9, youngs_modulus=2.63e10, density=2000.0, masses=4, p_delta=True)
SOFT = dict(
    width=5.012466469371269, height=36.7218921540138, youngs_modulus=1.2112424810312152e9,
    density=2603.4326570314374, masses=5, p_delta=True, rotations="finite",
)  # fmt: skip
SHAKING = [0.148, -0.086, -0.384, -0.31]
SLOW_SHAKING = [0.0005727270410416532, -0.12825032285476717, -0.17520962565501189, 0.044879400798942586,
                0.13682509003769114, 0.09763454229098459, 0.09321346887828287, 0.12433921127611947,
                -0.18810953513163456]  # fmt: skip
CASES = {
    "stiffness": (STOCKY | dict(damping_ratio=0.02), rk.Record(SHAKING, 0.18), 0.3),
    "modal": (STOCKY | dict(damping_ratio=0.15, damping="modal"), rk.Record(SHAKING, 0.18), 0.53),
    # Three rates of the rocking column between 8 and 10 per second: its modes are nearly one.
    "crowded rates": (
        SOFT | dict(damping_ratio=0.13925245186203647), rk.Record(SLOW_SHAKING, 0.21592518324837112), 1.6,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_the_restitution_waits_for_the_first_return(case):
    shape, motion, duration = CASES[case]
    blocks = [rk.blocks.FlexibleBlock(**shape, restitution=restitution) for restitution in (0.6, 1.0)]
    found = [rk.simulate(block, motion, duration=duration, samples=101) for block in blocks]
    chain = Chain(blocks[0], motion)
    paths, impacts = chain.follow(duration)
    np.testing.assert_allclose(found[0].impact_times, impacts, atol=1e-7)
    first = impacts[0] if impacts else duration
    before = found[0].time < first
    for name in ("rotation", "displacement", "bending"):
        # Equal to rounding: steps after the return have another length.
        one, other = (np.asarray(getattr(each, name))[before] for each in found)
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13 * np.abs(one).max())
    assert np.abs(found[0](np.linspace(0, first, 99))[0]).max() > 1e-7
    at = min(first + 0.0067, duration)
    np.testing.assert_allclose([float(x) for x in found[0](at)[:2]], chain.at(paths, at), rtol=1e-5, atol=1e-11)


def test_mirrored_scenes_answer_mirrored():
    shape, motion, duration = CASES["stiffness"]
    block = rk.blocks.FlexibleBlock(**shape, restitution=0.6)
    mirrored = rk.Record(-motion.samples, motion.dt)
    one, other = (rk.simulate(block, each, duration=duration, samples=101) for each in (motion, mirrored))
    np.testing.assert_array_equal(one.impact_times, other.impact_times)
    for name in ("rotation", "displacement", "bending"):
        np.testing.assert_array_equal(getattr(one, name), -getattr(other, name))


@pytest.mark.parametrize("damping", ["stiffness", "modal", "rayleigh"])
def test_a_locked_base_unlocks_by_the_moment_of_its_state(damping):
    """The moment that decides the uplift is that of springs and dampers next to the base."""
    block = rk.blocks.FlexibleBlock(
        **TALL, damping_ratio=0.2, masses=4, damping=damping, base="sine", rotations="finite", p_delta=True
    )
    state = np.array([0.02, -0.003, 0.001, 0.3, -0.2, 0.1, 0.0])

    @jax.jit
    def moments(block, state):
        scene = scene_of(block, rk.SinePulse(0.5, 1.6), jnp.asarray(4.0))
        column, (q, v) = scene.tangents.column, (scene.tangents.turn @ x for x in (state[:3], state[3:6]))
        phase, still = scene.locked, jnp.zeros(())
        watched = (phase.outputs[3] @ (phase.project @ state)).real
        return watched, jnp.sum(column.numbers.rotation * column.elastic(q, v, still, still))

    watched, expected = moments(block, state)
    assert float(watched) == pytest.approx(float(expected), rel=1e-12)


# ------------------------------------------------------------------------ many

LAWS = list(itertools.product(["sine", "linear", "plastic"], ["small", "finite"], [False, True]))
KINDS = ["stiffness", "modal", "rayleigh"]
MOTIONS = ["record", "sine", "cosine", "rectangle"]  # the last two begin with a jump
GROUPS = [(*law, KINDS[(k + other) % 3], MOTIONS[(k + other) % 4], other)
          for other in (0, 1) for k, law in enumerate(LAWS)]  # fmt: skip


def drawn(random, base, rotations, p_delta, damping, kind, other):
    """A random column and motion."""
    every = other == 1 and base == "plastic"
    least = 0.7 if every else 0.3  # a column that loses most at every return soon stops
    height = np.exp(random.uniform(np.log(4), np.log(40)))
    width = height / random.uniform(4, 10)
    size = random.choice([-1, 1]) * random.uniform(1.1, 3.5) * width / height
    lasting = random.uniform(0.3, 1.0)
    motion = {
        "record": lambda: rk.Record(size * random.uniform(-1, 1, 6), lasting / 5),
        "sine": lambda: rk.SinePulse(size, lasting),
        "cosine": lambda: rk.CosinePulse(size, lasting),
        "rectangle": lambda: rk.RectangularPulse(size, lasting / 3),
    }[kind]()
    block = rk.blocks.FlexibleBlock(
        width, height, np.exp(random.uniform(np.log(2e9), np.log(6e10))), random.uniform(1800, 2700),
        np.exp(random.uniform(np.log(1e-3), np.log(0.3))), 3 + other, base=base, rotations=rotations, p_delta=p_delta,
        damping=damping, impacts="every" if every else "alternate", restitution=random.uniform(least, 1),
    )  # fmt: skip
    return block, motion


def beside_the_chain(block, motion):
    """Return the largest differences, over peaks: of impact times [s], peak, rotations and tops; and counts."""
    duration = float(motion.end) + 0.4
    found = rk.simulate(block, motion, duration=duration, samples=101)
    outcome = rk.outcome(block, motion, duration=duration)
    assert outcome.impact_count == found.impact_count and outcome.overturned == found.overturned
    assert float(outcome.max_rotation) == pytest.approx(float(found.max_rotation), rel=1e-12)
    chain = Chain(block, motion)
    paths, impacts = chain.follow(duration, 1e-12)  # its rotation is 1e-4 off with 1e-10, where little damps
    counts = int(found.impact_count), len(impacts)
    times = np.linspace(0.05, duration, 11)
    expected = np.array([chain.at(paths, t) for t in times]).T
    peak, top = chain.peak(paths), np.abs(expected[1]).max()
    rotation, displacement = np.abs(np.stack(found(times)[:2]) - expected).max(1)
    least = min(counts)
    late = np.abs(np.asarray(found.impact_times)[:least] - impacts[:least]).max(initial=0.0)
    off = abs(float(outcome.max_rotation) - peak)
    scale = max(peak, 1e-6)
    if found.overturned:
        later, off = duration + 4 / float(block.p), 0.0
        assert abs(chain.at(chain.follow(later)[0], later)[0]) > block.alpha
    return counts, late, off / scale, rotation / scale, displacement / top


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS, ids=["-".join(map(str, group)) for group in GROUPS])
def test_random_columns_beside_the_chain(group):
    """216 columns in all."""
    random = np.random.default_rng(GROUPS.index(group))
    for _ in range(9):
        (count, expected), late, peak, rotation, top = beside_the_chain(*drawn(random, *group))
        assert count == expected
        assert late < 1e-7 and peak < 1e-5 and rotation < 1e-5 and top < 1e-6


@pytest.mark.slow
def test_slopes_through_an_uplift_beside_differences_of_the_chain():
    """Differences of the chain judge slopes of rotation and top, while the base is up and after its first return."""
    shape, _, duration = CASES["stiffness"]
    times, samples, step = np.array([0.045, 0.058]), np.array(SHAKING), 1e-4

    def scene(factor):
        block = rk.blocks.FlexibleBlock(**shape | dict(damping_ratio=0.02), restitution=0.6)
        return block, rk.Record(factor * samples, 0.18)

    @jax.jit
    def slopes(factor):
        def numbers(factor):
            return jnp.stack(rk.simulate(*scene(factor), duration=duration, samples=11)(times)[:2])

        return jax.jvp(numbers, (factor,), (1.0,))[1]

    def by_scipy(factor):
        chain = Chain(*scene(factor))
        paths, _ = chain.follow(duration, 1e-12)
        return np.array([chain.at(paths, t) for t in times]).T

    expected = (by_scipy(1 + step) - by_scipy(1 - step)) / (2 * step)
    found = slopes(1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max(1).min())
