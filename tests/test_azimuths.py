"""Rocks in every vertical plane under two components, and suites of components."""

import numpy as np
import pytest

import jaxrock as rk

QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6), "progress": False}  # compiles in half the time
TIME = 0.01 * np.arange(400)
BELL = np.exp(-((TIME - 2) ** 2))
EAST = rk.Record(0.4 * np.sin(6 * TIME) * BELL, 0.01, "shake")
NORTH = rk.Record(0.25 * np.cos(4 * TIME) * BELL, 0.01, "shake")
UP = rk.Record(0.3 * np.sin(9 * TIME) * BELL, 0.01, "up")
PAIR = rk.motions.Components(EAST, NORTH)
AZIMUTH = np.linspace(0, np.pi, 7, endpoint=False)
SCALE = np.array([0.5, 0.8, 1.2])


def oval(azimuth):
    """Stout along 0.3 rad, slender across; its two sides differ."""
    wide = 0.06 * np.cos(2 * (azimuth - 0.3))
    return rk.blocks.AsymmetricBlock.from_corners((0.2 + wide, -1.0), (-0.24 - wide, -1.0), (0.0, 0.0), 0.6)


@pytest.fixture(scope="module")
def found():
    return rk.studies.azimuth_outcomes(oval, PAIR, AZIMUTH, SCALE, orientation=0.2, **QUICK)


def test_every_plane_is_a_scene_of_its_own(found):
    assert found.verdict.shape == (7, 3) and 0 < np.mean(found.verdict == 1) < 1
    for plane, scale in [(0, 0), (3, 1), (5, 2), (6, 0)]:
        angle = AZIMUTH[plane]
        motion = float(SCALE[scale]) * PAIR.along(angle - 0.2)
        alone = rk.outcome(oval(angle), motion, QUICK["model"], engine=QUICK["engine"])
        assert found.verdict[plane, scale] == int(alone.overturned)
        assert found.margin[plane, scale] == pytest.approx(float(alone.margin), rel=1e-7)


def test_the_weakest_plane_decides(found):
    np.testing.assert_array_equal(found.toppled, (found.verdict == 1).any(axis=0))
    np.testing.assert_array_equal(found.weakest, AZIMUTH[found.margin.argmin(axis=0)])


def test_what_is_undecided_bounds():
    verdict = np.array([[0, 0, 1], [0, -1, -1]], np.int8)
    margin = np.where(verdict == -1, np.nan, np.where(verdict == 1, -0.2, 0.3))
    found = rk.studies.AzimuthOutcomes(AZIMUTH[:2], SCALE, rk.Block(0.2, 3.0), verdict, margin, margin)
    np.testing.assert_array_equal(found.toppled, [0, -1, 1])
    np.testing.assert_array_equal(found.weakest, [AZIMUTH[0]] * 3)


def test_suites_of_components_shake_upward_too():
    three = rk.motions.Components(EAST, NORTH, UP)
    block, angles = rk.blocks.AsymmetricBlock(0.2, 0.24, 3.0), [0.0, 1.0]
    around = rk.studies.azimuth_outcomes(lambda azimuth: block, three, angles, SCALE, **QUICK)
    suites = rk.motions.Suite([three], azimuth=angles), rk.motions.Suite([three], azimuth=angles, vertical=False)
    with_it, without = (rk.hazard.suite_outcomes(block, suite, SCALE, **QUICK) for suite in suites)
    np.testing.assert_array_equal(with_it.margin[:, :, 0, 0], around.margin)
    level = rk.studies.azimuth_outcomes(lambda azimuth: block, three, angles, SCALE, vertical=False, **QUICK)
    np.testing.assert_array_equal(without.margin[:, :, 0, 0], level.margin)
    assert np.abs(with_it.margin - without.margin).max() > 0.01
    assert suites[0].names == suites[1].names
    np.testing.assert_allclose(suites[0].peak_velocity, suites[1].peak_velocity, rtol=1e-14)


def test_half_a_turn_is_a_mirror(found):
    """Planes are followed by themselves; half a turn on, the two sides of a rock change places."""
    turned = rk.studies.azimuth_outcomes(oval, PAIR, AZIMUTH[:3], SCALE, orientation=0.2, **QUICK)
    np.testing.assert_array_equal(turned.margin, found.margin[:3])

    def other(azimuth):
        wide = 0.06 * np.cos(2 * (azimuth - 0.3))
        return rk.blocks.AsymmetricBlock.from_corners((0.24 + wide, -1.0), (-0.2 - wide, -1.0), (0.0, 0.0), 0.6)

    mirrored = rk.studies.azimuth_outcomes(other, PAIR, AZIMUTH[:3] + np.pi, SCALE, orientation=0.2, **QUICK)
    np.testing.assert_allclose(mirrored.margin, found.margin[:3], rtol=1e-6)


@pytest.mark.slow
def test_the_vertical_component_shakes_it_too():
    both = rk.motions.Components(EAST, NORTH, UP)
    with_it, without = (
        rk.studies.azimuth_outcomes(oval, both, [0.5], 0.8, vertical=each, **QUICK).margin[0, 0]
        for each in (True, False)
    )
    motion = (0.8 * both.along(0.5)).with_vertical(0.8 * UP)
    alone = rk.outcome(oval(0.5), motion, QUICK["model"], engine=QUICK["engine"])
    assert with_it == pytest.approx(float(alone.margin), rel=1e-7) and without != pytest.approx(with_it, rel=1e-3)


def test_a_rock_of_a_mesh():
    """A box of 0.6 by 0.4 by 2 m: across its corners the section is that of its projection."""
    corners = np.array([[x, y, z] for x in (-0.3, 0.3) for y in (-0.2, 0.2) for z in (0.0, 2.0)])
    inertia = np.diag([0.16 + 4.0, 0.36 + 4.0, 0.36 + 0.16]) / 12
    rock = rk.blocks.Rock(0.48, np.array([0.0, 0.0, 1.0]), inertia, corners, corners[corners[:, 2] == 0], 0.02)
    found = rk.studies.azimuth_outcomes(rock, PAIR, [0.0, 0.4, np.pi / 2], SCALE, **QUICK)
    reach = [0.3, 0.3 * np.cos(0.4) + 0.2 * np.sin(0.4), 0.2]
    np.testing.assert_allclose(found.blocks.alpha1, np.arctan(reach), rtol=1e-12)
    np.testing.assert_allclose(found.blocks.alpha2, np.arctan(reach), rtol=1e-12)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"rock": lambda azimuth: azimuth}, "`rock` must give a Block or an AsymmetricBlock, but gives"),
        ({"rock": lambda a: oval(a) if a else rk.Block(0.2, 3.0)}, "`rock` must give blocks of one kind"),
        ({"azimuth": [[0.1]]}, "`azimuth` must be a list of angles"),
        ({"scale": [1.0, 0.5]}, "`scale` must be a number, or rise"),
        ({"orientation": np.nan}, "`orientation` must be finite"),
    ],
)
def test_what_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        rk.studies.azimuth_outcomes(**{"rock": oval, "components": PAIR, "azimuth": AZIMUTH} | given)


# ------------------------------------------------------------------------------------ suites of components


def test_a_suite_of_components_has_azimuths():
    suite = rk.motions.Suite([PAIR, rk.motions.Components(NORTH, EAST)], ["one", "two"], azimuth=[0.0, 0.5, 1.0])
    assert len(suite) == 6 and suite.names[1] == "one, 28.65 deg" and suite.sources == ("one",) * 3 + ("two",) * 3
    np.testing.assert_array_equal(suite.azimuth, [0.0, 0.5, 1.0] * 2)
    for motion, (pair, angle) in zip(suite.motions(), [(PAIR, 0.0), (PAIR, 0.5), (PAIR, 1.0)]):
        np.testing.assert_array_equal(motion.samples, pair.along(angle).samples)
    found = rk.hazard.suite_outcomes(oval(0.0), suite, SCALE, **QUICK)
    assert rk.hazard.simulated_fragility(oval(0.0), suite, 0.4 * SCALE, **QUICK).turns == 3
    table = found.table()
    row = np.flatnonzero((table["source"] == "two") & (table["azimuth"] == 0.5) & (table["scale"] == 0.8))
    alone = rk.outcome(oval(0.0), 0.8 * rk.motions.Components(NORTH, EAST).along(0.5), QUICK["model"],
                       engine=QUICK["engine"])  # fmt: skip
    assert table["margin"][row] == pytest.approx(float(alone.margin), rel=1e-7)


def test_a_suite_of_motions_has_none():
    suite = rk.motions.Suite([EAST])
    assert suite.azimuth is None and suite.sources == ("shake",)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: rk.motions.Suite([PAIR]), "`motions` and `azimuth` must be given for components alone"),
        (lambda: rk.motions.Suite([EAST], azimuth=[0.0]), "`motions` and `azimuth` must be given for components alone"),
        (lambda: rk.motions.Suite([PAIR, EAST], azimuth=[0.0]), "must be given for components alone"),
        (
            lambda: rk.motions.Suite([PAIR], azimuth=[0, 45, 90]),
            "`azimuth` must be finite, and in radians, from -2 pi to 2 pi, .* 45",
        ),
        (lambda: PAIR.along(90), "`angle` must be finite, and in radians, from -2 pi to 2 pi, but is 90"),
        (lambda: rk.motions.Suite([PAIR], azimuth=0.3), "`azimuth` must be a list of angles"),
        (lambda: rk.motions.Suite([PAIR], ["a", "b"], azimuth=[0.3]), "`names` must name 1 motions, but has 2"),
    ],
)
def test_suites_that_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
