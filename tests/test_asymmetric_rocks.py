"""Asymmetric rocks agree with symmetric ones; the way a rock stood may be unknown."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.command_line.main import main
from jaxrock.inverse.scatter import rocks_at

# All tests use twelve rocks, so that they share one compiled program; for at least one the way it stood is unknown.
ALPHA = np.array([0.10, 0.12, 0.14, 0.16, 0.18, 0.20, 0.22, 0.24, 0.26, 0.28, 0.31, 0.34])
P = np.array([3.0, 2.2, 3.6, 2.6, 4.2, 3.1, 2.4, 5.0, 3.4, 2.8, 4.5, 3.8])
FACING = np.array([1.0, -1.0, 0.0] * 4)
SCATTER = 0.2
MOTIONS = {"amplitude": np.array([0.15, 0.25, 0.35, 0.5]), "period": np.array([0.4, 0.8, 0.8, 1.6])}
KNOWN = {"alpha_sd": 0.04 * ALPHA, "p_sd": 0.02 * P, "rotation": 0.05, "rotation_sd": 0.01}
WORDS = ["survived", "toppled", "rotation"] * 4


def rocks(ratio=1.35, facing=FACING, words=WORDS, inertia_ratio=0.7, **more):
    blocks = rk.blocks.AsymmetricBlock(ALPHA, ratio * ALPHA, P, inertia_ratio)
    return rk.inverse.Observations.asymmetric(blocks, words, facing=facing, **(KNOWN | more))


@eqx.filter_jit
def _facts(likelihood, values):
    terms, (survival, _, *surprise) = likelihood.terms_and_facts(values)
    return terms, survival, *surprise


def with_vertical(amplitude, period):
    return rk.SinePulse(amplitude, period).with_vertical(rk.SinePulse(0.6 * amplitude, 0.7 * period))


def facts(observations, motion=rk.SinePulse, motions=MOTIONS):
    """Log-likelihoods, survival and surprise, (motions, rocks) each."""
    likelihood = rk.inverse.Likelihood(observations, motion, SCATTER, rk.Linear(), rk.Series(order=6))
    return jax.device_get(_facts(likelihood, motions))


def test_equal_sides_are_symmetric_rocks():
    symmetric = facts(rk.inverse.Observations(ALPHA, P, WORDS, **KNOWN))
    for facing in (FACING, np.zeros(12)):
        for found, expected in zip(facts(rocks(1.0, facing, inertia_ratio=0.75)), symmetric):
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


def test_observations_of_traced_rocks():
    """Check that rocks whose way of standing is unknown count both ways, also when traced."""
    known, ways = rocks(), jax.jit(lambda facing: rocks(facing=facing).ways)
    found = jax.jit(lambda ratio: rocks(ratio).restitution)(1.35)
    np.testing.assert_allclose(found, known.restitution, rtol=1e-14)
    np.testing.assert_array_equal(ways(FACING), known.ways)
    np.testing.assert_array_equal(ways(np.abs(FACING)).mean(0), np.abs(known.ways).mean(0) * (FACING != 0))


@pytest.mark.parametrize("motion", [rk.SinePulse, with_vertical])
def test_ways_are_those_of_the_mirrored_rock_and_their_mean(motion):
    """Check that a rock turned round is its mirror image in the plane: up stays up."""
    known = FACING != 0
    few = MOTIONS if motion is rk.SinePulse else {name: values[1:2] for name, values in MOTIONS.items()}
    one, other, unknown = (facts(rocks(facing=f), motion, few) for f in (FACING, -FACING, np.zeros(12)))
    assert np.max(np.abs(one[1] - other[1])[:, known]) > 0.2  # which way round matters
    for k in (0, 1):  # the rest are no probabilities
        here, there = (np.exp(x[k]) if k == 0 else x[k] for x in (one, other))
        mean = np.exp(unknown[k]) if k == 0 else unknown[k]
        np.testing.assert_allclose(((here + there) / 2)[:, known], mean[:, known], rtol=1e-11)
    # Seen from behind, with sides exchanged, it stands the other way round. (What is uncertain belongs to side 1.)
    blocks = rk.blocks.AsymmetricBlock(ALPHA, 1.35 * ALPHA, P, 0.7).mirrored
    both = {"alpha_sd": 0.04 * 1.35 * ALPHA, "p_sd": 0.02 * blocks.p1}
    mirrored = rk.inverse.Observations.asymmetric(blocks, WORDS, facing=-FACING, **(KNOWN | both))
    behind = facts(mirrored, motion, few)
    for found, expected in zip(behind, one):
        np.testing.assert_allclose(found[:, known], expected[:, known], rtol=1e-9, atol=1e-9)


def test_other_names_compile_nothing():
    facts(rocks())
    before = _facts._cached._cache_size()
    facts(rocks(names=[f"stone {i}" for i in range(12)]))
    assert _facts._cached._cache_size() == before
    assert rocks(names=list("abcdefghijkl")).of(np.array([1, 3])).names == ("b", "d")


def test_restitutions():
    """Two impacts, one on each side, keep the square of it of the speed; their ratio is that of moments of inertia."""
    blocks = rk.blocks.AsymmetricBlock.from_radii(
        *np.array([[0.2, 0.3], [0.35, 0.25], [1.0, 1.2], [1.3, 1.1], [0.6, 0.7]])
    )
    seen = rk.inverse.Observations.asymmetric(blocks, ["survived"] * 2)
    for name in ("alpha1", "alpha2", "p1", "p2", "restitution1", "restitution2"):
        np.testing.assert_allclose(getattr(seen.blocks, name), getattr(blocks, name), rtol=1e-14)
    given = rk.inverse.Observations.asymmetric(blocks, ["survived"] * 2, [0.9, np.nan]).blocks
    assert float((given.restitution1 * given.restitution2)[0]) == pytest.approx(0.81)
    np.testing.assert_allclose(given.restitution1 / given.restitution2, blocks.restitution1 / blocks.restitution2)
    np.testing.assert_allclose(given.restitution1[1], blocks.restitution1[1])
    pair = rk.blocks.AsymmetricBlock(0.2, 0.3, 2.0, restitution=(0.7, 0.9))
    found = rk.inverse.Observations.asymmetric(pair, ["survived"]).of(np.array([0])).blocks
    np.testing.assert_allclose([found.restitution1, found.restitution2], [[0.7], [0.9]])


HEADER = "name,alpha1_deg,alpha2_deg,alpha1_deg_sd,radius1_m,radius2_m,radius1_m_sd,inertia_ratio,facing,observed"


def test_a_file_of_rocks_with_two_sides(tmp_path):
    path = tmp_path / "rocks.csv"
    path.write_text(f"{HEADER}\na,10,15,0.5,1.2,1.25,0.1,,,toppled\nb,20,12,1,0.9,0.8,,0.7,-1,survived\n")
    seen = rk.inverse.read_observations(path)
    blocks = seen.blocks
    np.testing.assert_allclose(blocks.alpha1, np.deg2rad([10, 20]))
    np.testing.assert_allclose(blocks.alpha2, np.deg2rad([15, 12]))
    inertia = np.array([1.2**2 / 0.75, 0.9**2 / 0.7])  # I1/m
    second = inertia + np.array([1.25**2 - 1.2**2, 0.8**2 - 0.9**2])
    np.testing.assert_allclose(blocks.p1, np.sqrt(9.81 * np.array([1.2, 0.9]) / inertia))
    np.testing.assert_allclose(blocks.p2, np.sqrt(9.81 * np.array([1.25, 0.8]) / second))
    np.testing.assert_allclose(seen.p_sd / seen.p, [0.1 / 2.4, 0])
    np.testing.assert_allclose(seen.ways, [[1, -1], [-1, -1]])
    # The same by frequency parameters.
    lines = ["alpha1_rad,alpha2_rad,p1_rad_per_s,p2_rad_per_s,inertia_ratio,facing,observed"]
    for i, word in enumerate(("toppled", "survived")):
        numbers = [blocks.alpha1[i], blocks.alpha2[i], blocks.p1[i], blocks.p2[i], blocks.inertia_ratio[i]]
        lines.append(",".join([*(repr(float(x)) for x in numbers), ("", "-1")[i], word]))
    path.write_text("\n".join(lines))
    again = rk.inverse.read_observations(path)
    for name in ("alpha1", "alpha2", "p1", "p2", "restitution1"):
        np.testing.assert_allclose(getattr(again.blocks, name), getattr(blocks, name), rtol=1e-12)


@pytest.mark.parametrize(
    "header, line, message",
    [
        (HEADER, "a,10,95,0.5,1,1,0,,,toppled", r"line 2: Argument `alpha2` must be in \(0, pi/2\)"),
        (HEADER, "a,10,,0.5,1,1,0,,,toppled", "line 2: `alpha2` is empty"),
        (HEADER, "a,10,12,0.5,1,0,0,,,toppled", "line 2: `radius2_m` must be positive"),
        (HEADER, "a,10,12,0.5,1,1,0,1.2,,toppled", r"line 2: `inertia_ratio` must be in \(0, 1\]"),
        (HEADER, "a,10,12,0.5,1,1,0,,2,toppled", "line 2: Argument `facing` must be 1, -1 or 0"),
        ("alpha1_deg,radius1_m,radius2_m,observed", "10,1,1,toppled", "must have both columns alpha1_deg and alpha2_d"),
        ("alpha1_deg,alpha2_deg,half_diagonal_m,observed", "10,12,1,toppled", "columns of both sides"),
        ("alpha1_deg,alpha2_deg,p1_rad_per_s,p2_rad_per_s,observed", "9,9,2,3,toppled", "line 2: Argument `p2` must"),
    ],
)
def test_impossible_rocks_are_named_by_their_line(tmp_path, header, line, message):
    path = tmp_path / "rocks.csv"
    path.write_text(f"{header}\n{line}\n")
    with pytest.raises(ValueError, match=message):
        rk.inverse.read_observations(path)


# --------------------------------------------------------------------------------------- slow


def fallen(sign, amplitude, period, alpha1, alpha2, p1, inertia_ratio):
    block = rk.blocks.AsymmetricBlock(alpha1, alpha2, p1, inertia_ratio)
    return {"fallen": rk.outcome(block, rk.SinePulse(sign * amplitude, period)).overturned}


def overturned(**scenes):
    """Return the verdicts of scenes given by parallel lists, without likelihood or margin."""
    shape = np.broadcast_shapes(*(np.shape(x) for x in scenes.values()))
    lists = {name: np.broadcast_to(x, shape).ravel() for name, x in scenes.items()}
    return rk.sweep(fallen, outer=False, progress=False, **lists).values["fallen"].reshape(shape)


@pytest.mark.slow
def test_probabilities_are_shares_of_verdicts():
    """Compare probabilities with shares of 1,000 drawn scenes; a coin decides each way of standing that is unknown."""
    words, rng = ["survived"] * 12, np.random.default_rng(0)
    seen = rocks(words=words)
    e, coin = rng.normal(size=(4, 1000, 1, 12)), rng.choice([-1.0, 1.0], size=(1000, 1, 12))
    sd = np.stack([seen.alpha_sd / seen.alpha, seen.p_sd / seen.p, np.zeros(12)])[:, None, None]
    alpha, p, _ = rocks_at(seen, jnp.asarray(e[1:] * sd))
    lost = overturned(
        sign=np.where(FACING == 0, coin, FACING), amplitude=MOTIONS["amplitude"][:, None] * np.exp(SCATTER * e[0]),
        period=MOTIONS["period"][:, None], alpha1=np.asarray(alpha), alpha2=1.35 * np.asarray(alpha), p1=np.asarray(p),
        inertia_ratio=0.7,
    )  # fmt: skip
    shares, found = 1 - lost.mean(axis=0), facts(seen)[1]
    unsure = (shares > 0.02) & (shares < 0.98)
    assert unsure.sum() > 12
    assert np.max(np.abs(found - shares)) < 0.12
    assert np.sqrt(np.mean((found - shares)[unsure] ** 2)) < 0.05


def test_up_stays_up_in_the_unexceeded_motion():
    """Check that up stays up for rocks that stand the other way round, as for their mirror images."""

    def motion(amplitude, duration):
        return rk.SinePulse(amplitude, duration).with_vertical(rk.SinePulse(0.6 * amplitude, 0.7 * duration))

    blocks = rk.blocks.AsymmetricBlock(ALPHA, 1.35 * ALPHA, P, 0.7)
    both = jax.tree.map(lambda *x: np.concatenate([np.resize(one, 12) for one in x]), blocks, blocks.mirrored)
    known = {name: np.resize(value, 24) for name, value in KNOWN.items()}
    seen = rk.inverse.Observations.asymmetric(both, ["survived"] * 24, facing=np.repeat([-1, 1], 12), **known)
    engine = rk.Series(order=8, tolerance=1e-10)
    found = rk.inverse.unexceeded_motion(seen, motion, [0.6], model=rk.Linear(), engine=engine, progress=False)
    assert np.isfinite(found.by_rock).all()
    np.testing.assert_allclose(*np.split(found.by_rock, 2), rtol=1e-9)


@pytest.mark.slow
def test_unexceeded_motions_of_two_sides():
    """Check that the unexceeded motion of a rock of unknown way is the larger one, up to which it stands that way."""
    durations = np.array([0.5, 1.2])
    one, other, unknown = (
        rk.inverse.unexceeded_motion(rocks(facing=f, words=["survived"] * 12), rk.SinePulse, durations, progress=False)
        for f in (np.ones(12), -np.ones(12), np.zeros(12))
    )
    np.testing.assert_allclose(unknown.by_rock, np.maximum(one.by_rock, other.by_rock), rtol=1e-12)
    known = {"alpha1": ALPHA[:, None], "alpha2": 1.35 * ALPHA[:, None], "p1": P[:, None], "inertia_ratio": 0.7}
    for sign, wall in ((1.0, one), (-1.0, other)):
        wall = np.asarray(wall.by_rock)
        finite = np.isfinite(wall)
        amplitude = np.where(finite, wall, 0.01)
        assert not overturned(sign=sign, amplitude=amplitude * (1 - 1e-9), period=durations, **known).any()
        assert overturned(sign=sign, amplitude=amplitude * (1 + 1e-9), period=durations, **known)[finite].all()
    symmetric = rk.inverse.unexceeded_motion(
        rk.inverse.Observations(ALPHA, P, ["survived"] * 12), rk.SinePulse, durations
    )
    equal = rk.inverse.unexceeded_motion(
        rocks(1.0, words=["survived"] * 12, inertia_ratio=0.75), rk.SinePulse, durations, progress=False
    )
    np.testing.assert_allclose(equal.by_rock, symmetric.by_rock, rtol=1e-10)


@pytest.mark.slow
def test_the_command_for_rocks_with_two_sides(tmp_path, capsys):
    header = "name,alpha1_rad,alpha1_rad_sd,alpha2_rad,p1_rad_per_s,p2_rad_per_s,facing,observed"
    p2 = np.asarray(rk.blocks.AsymmetricBlock(ALPHA, 1.35 * ALPHA, P).p2)
    words = ["toppled"] * 6 + ["survived"] * 6
    rows = [
        f"r{i},{ALPHA[i]},{0.04 * ALPHA[i]},{1.35 * ALPHA[i]},{P[i]},{p2[i]},{('', '1', '-1')[i % 3]},{words[i]}"
        for i in range(12)
    ]
    (tmp_path / "rocks.csv").write_text("\n".join([header, *rows]) + "\n")
    ranges = ("--amplitude", "0.05", "2", "--duration", "0.2", "3", "--scatter", "0.2", "--starts", "8")
    status = main(["invert", str(tmp_path / "rocks.csv"), *ranges, "--points", "6", "--out", str(tmp_path)])
    printed, errors = capsys.readouterr()
    assert status == 0 and errors == ""
    assert "4 of them may stand either way round" in printed
    lines = (tmp_path / "probabilities.csv").read_text().splitlines()
    assert lines[0] == "name,alpha1_rad,alpha2_rad,p1_rad_per_s,p2_rad_per_s,observed,probability"
    np.testing.assert_allclose(float(lines[1].split(",")[4]), p2[0], rtol=1e-5)
    assert len((tmp_path / "unexceeded.csv").read_text().splitlines()) == 7


def test_a_given_restitution_is_that_of_both_sides():
    one, pair = (rk.blocks.AsymmetricBlock(ALPHA, 1.2 * ALPHA, P, 0.7, None, law) for law in (
        rk.restitution.Constant(0.4), (np.full(12, 0.4), np.full(12, 0.4))))  # fmt: skip
    found, same = (rk.inverse.Observations.asymmetric(each, WORDS, facing=FACING, **KNOWN) for each in (one, pair))
    np.testing.assert_allclose(found.restitution, 0.4, rtol=1e-12)
    np.testing.assert_allclose(found.other.restitution_ratio, same.other.restitution_ratio)
    by_speed = rk.blocks.AsymmetricBlock(ALPHA, 1.2 * ALPHA, P, 0.7, None, rk.restitution.SpeedDependent(0.9, 0.5, 1.0))
    with pytest.raises(ValueError, match="`blocks` must have a restitution that does not depend on the speed"):
        rk.inverse.Observations.asymmetric(by_speed, WORDS, facing=FACING, **KNOWN)
