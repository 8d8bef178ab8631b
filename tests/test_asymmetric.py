"""Asymmetric blocks and vertical motion, against references in 25 digits and against symmetric blocks."""

import functools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.engines.scene import Scene, uplift_threshold
from jaxrock.responses.own_block import check_own
from references import hard_cases

FOLDER = Path(__file__).parents[1] / "references" / "asymmetric"
CASES = json.loads((FOLDER / "asymmetric.json").read_text())["cases"] if FOLDER.exists() else []


def motion_of(kind, *n):
    """A motion of the references."""
    if kind == "record":
        return n[2] * rk.Record(n[0], n[1])
    return {"sine": rk.SinePulse, "exponential": rk.ExponentialPulse, "rectangle": rk.RectangularPulse}[kind](*n)


def scene(case):
    """Block, motion, model and initial state of a case."""
    b = case["block"]
    kappa = b["p"][0] ** 2 * b["R"][0] / b["gravity"]
    block = rk.blocks.AsymmetricBlock.from_frequencies(*b["alpha"], *b["p"], kappa, tuple(b["restitution"]))
    motion = motion_of(*case["horizontal"])
    if case["vertical"] is not None:
        motion = motion.with_vertical(case["vertical"]["factor"] * motion_of(*case["vertical"]["motion"]))
    return block, motion, rk.Linear() if case["model"] == "linear" else rk.Housner(), tuple(case["initial"])


def check(case, found):
    """Compare an outcome with the reference, within its conditioning."""
    r, name = case["result"], case["name"]
    assert int(found.status._value) == 0, name
    assert bool(found.overturned) == bool(r["overturned"]), name
    assert (float(found.margin) < 0) == bool(r["overturned"]), name
    if not r["overturned"]:
        within = 2e-14 * max(r["condition"]["max_rotation"], 10)
        assert abs(float(found.max_rotation) - float(r["max_rotation"])) <= within, name
        assert abs(float(found.max_velocity) / float(r["max_velocity"]) - 1) <= 1e-11, name


QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # where neither matters: one program for many tests
SINES = [case for case in CASES if case["horizontal"][0] == "sine" and not case["vertical"]]
SINES = [case for case in SINES if case["model"] == "housner" and case["initial"] == [0, 0]]
OTHERS = [case for case in CASES if case not in SINES]
needs_references = pytest.mark.skipif(not CASES, reason="needs the folder references of the repository")


@jax.jit
def under_sine(block, motion, initial=(0.0, 0.0)):
    """Outcomes of many asymmetric blocks, each under a sine pulse: one program for most of this file."""
    return jax.vmap(lambda block, motion: rk.outcome(block, motion, initial=initial))(block, motion)


def stack(scenes, size=64):
    """Scenes as arrays, the last one repeated."""
    scenes = list(scenes) + [scenes[-1]] * (size - len(scenes))
    return jax.tree.map(lambda *values: np.array(values, float), *scenes)


def stack_columns(numbers, size=64):
    """Scenes from columns of parameters, the last one repeated."""
    x = np.pad(numbers, ((0, 0), (0, size - numbers.shape[1])), mode="edge")
    return rk.blocks.AsymmetricBlock(*x[:4]), rk.SinePulse(*x[4:])


def drawn(size=64):
    """Random blocks and pulses of even difficulty."""
    draw = np.random.default_rng(1).uniform
    alpha1, alpha2 = draw(0.1, 0.5, (2, size))
    block = rk.blocks.AsymmetricBlock(alpha1, alpha2, draw(1.5, 4, size), draw(0.6, 0.9, size))
    return block, rk.SinePulse(draw(0.1, 1.2, size), draw(0.4, 2.0, size))


@needs_references
def test_sine_pulses():
    """Safe and overturned on either side, at once, after impacts, in the free stage; restitutions above 1."""
    found = jax.device_get(under_sine(*stack([scene(case)[:2] for case in SINES])))
    for i, case in enumerate(SINES):
        check(case, jax.tree.map(lambda x, i=i: x[i], found))


@needs_references
@pytest.mark.slow
@pytest.mark.parametrize("case", OTHERS, ids=lambda case: case["name"])
def test_other_motions(case):
    """Exponential and rectangular pulses, records, vertical motion, free rocking, the linear model, near boundaries."""
    block, motion, model, initial = scene(case)
    check(case, rk.outcome(block, motion, model, initial=initial))


@needs_references
@pytest.mark.slow
@pytest.mark.parametrize("case", SINES + OTHERS, ids=lambda case: case["name"])
def test_diffrax_engine(case):
    """The other engine agrees to its tolerance, or says that it cannot tell."""
    block, motion, model, initial = scene(case)
    found = rk.outcome(block, motion, model, initial=initial, engine=rk.Diffrax(rtol=1e-10))
    if int(found.status._value) != 0:
        assert "1e-6" in case["name"]  # the scenes beside a boundary
        return
    assert bool(found.overturned) == bool(case["result"]["overturned"])
    if not found.overturned:
        np.testing.assert_allclose(found.max_rotation, float(case["result"]["max_rotation"]), rtol=1e-6)


def test_equal_sides_are_a_block():
    """With equal sides an asymmetric block is Housner's, also in its restitution; every number to rounding."""
    block, motion = drawn()
    alpha, p = np.asarray(block.alpha1), np.asarray(block.p1)
    equal = rk.blocks.AsymmetricBlock(alpha, alpha, p, np.full(p.shape, 0.75))
    found = jax.device_get(under_sine(equal, motion))
    restitution = np.asarray(rk.Block(alpha, p).restitution)
    blocks, pulses = zip(alpha, p, restitution), zip(*map(np.asarray, (motion.amplitude, motion.period)))
    scenes = [(block, pulse, (0.0, 0.0)) for block, pulse in zip(blocks, pulses)]
    wanted = hard_cases.outcomes("sine", "nonlinear", rk.Series(), scenes)
    assert np.all(found.status._value == 0) and np.all(wanted["successful"])
    for name in ("overturned", "impact_count"):
        np.testing.assert_array_equal(getattr(found, name), wanted[name])
    for name in ("max_rotation", "max_velocity", "time_of_max", "margin"):
        np.testing.assert_allclose(getattr(found, name), wanted[name], rtol=1e-10, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(equal.restitution1, restitution, rtol=1e-14)


def test_mirrored():
    """A block seen from behind does the same under the reversed motion."""
    block, motion = drawn()
    found, behind = jax.device_get(
        (
            under_sine(block, motion),
            under_sine(
                jax.vmap(lambda b: b.mirrored)(block), rk.SinePulse(-np.asarray(motion.amplitude), motion.period)
            ),
        )
    )
    assert 0.2 < np.mean(found.overturned) < 0.8
    np.testing.assert_array_equal(found.overturned, behind.overturned)
    for name in ("max_rotation", "max_velocity", "margin"):
        np.testing.assert_allclose(getattr(found, name), getattr(behind, name), rtol=1e-9, atol=1e-12, err_msg=name)


def test_derivatives():
    """By every parameter of block and pulse, against central differences of the values."""
    block, motion = jax.tree.map(lambda x: np.asarray(x)[:4], drawn())
    numbers = [block.alpha1, block.alpha2, block.p1, block.inertia_ratio, 0.4 * motion.amplitude, motion.period]

    @jax.jit
    @functools.partial(jax.vmap, in_axes=1)
    @jax.jacfwd
    def derivatives(x):
        engine = rk.Series(order=4)  # a shorter program
        return rk.outcome(rk.blocks.AsymmetricBlock(*x[:4]), rk.SinePulse(*x[4:]), engine=engine).margin

    found = np.asarray(derivatives(np.stack(numbers)))
    steps = 1e-5 * np.concatenate([np.eye(6), -np.eye(6)])
    moved = (np.stack(numbers)[:, :, None] + steps.T[:, None, :]).reshape(6, 48)
    values = np.asarray(under_sine(*stack_columns(moved)).margin)[:48].reshape(4, 2, 6)
    np.testing.assert_allclose(found, (values[:, 0] - values[:, 1]) / 2e-5, rtol=2e-6, atol=2e-7)
    assert np.abs(found).max() > 0.1


@jax.jit
def all_of(block, motion, initial, duration, time):
    """Outcome, impact times, states at times, and forces of the ground."""
    engine = rk.Series(order=8)  # a shorter program
    response = rk.simulate(block, motion, initial=initial, duration=duration, engine=engine)
    forces = rk.responses.contact_forces(response, block)
    outcome = rk.outcome(block, motion, initial=initial, engine=engine)
    return outcome, response.impact_times, jnp.stack(response(time)), forces


@needs_references
def test_vertical_motion_and_contact_forces():
    """A sine with a vertical sine: history, forces of the ground, what friction it needs."""
    case = next(case for case in CASES if case["name"] == "sine and vertical sine")
    (block, motion, model, initial), result = scene(case), case["result"]
    assert isinstance(model, rk.Housner)
    time, rotation, velocity = np.array(result["states"], float).T
    outcome, impacts, states, found = all_of(block, motion, initial, float(motion.end), time)
    check(case, outcome)
    assert np.isfinite(np.asarray(impacts)).sum() == result["impacts_in_motion"]
    np.testing.assert_allclose(states, [rotation, velocity], rtol=0, atol=1e-14)
    times, horizontal, normal, friction = np.array(result["forces"], float).T
    for name, values in {"horizontal": horizontal, "normal": normal, "friction": friction}.items():
        np.testing.assert_allclose(np.interp(times, found.time, getattr(found, name)), values, rtol=0, atol=2e-5)
    np.testing.assert_allclose(found.largest_friction, float(result["friction_max"][0]), rtol=1e-6)
    np.testing.assert_allclose(found.least_normal, float(result["normal_min"][0]), rtol=1e-6)
    np.testing.assert_allclose(found.friction_at_impact, [float(x) for x in result["impact_friction"]], rtol=1e-12)
    assert found.keeps_contact and found.sticks(0.3) and not found.sticks(0.2)
    assert found.impacted[1] and not found.impacted[0]


@jax.jit
def with_forces(block):
    """The response, and whether by the forces of the ground the block keeps contact."""
    response = rk.simulate(block, rk.SinePulse(0.4, 0.6), samples=2, **QUICK)
    return response, rk.responses.contact_forces(response, block).keeps_contact


def test_forces_are_those_of_the_response_and_its_block():
    response, kept = with_forces(rk.Block(0.2, 2.0))
    assert kept
    for other in (rk.Block(0.3, 2.0), rk.Block(0.2, 3.0), rk.blocks.AsymmetricBlock(0.2, 0.2, 2.0)):
        with pytest.raises(ValueError, match="Argument `block` must be that of the response, whose"):
            rk.responses.contact_forces(response, other)
    for law in (rk.restitution.PerSide(0.9, 0.8), None):  # one that tells sides apart, and two sides of one slenderness
        own = rk.Block(0.2, 2.0, law) if law else rk.blocks.AsymmetricBlock(0.2, 0.2, 2.0)
        response, kept = with_forces(own)
        assert kept
        with pytest.raises(ValueError, match="Argument `block` must be that of the response, whose"):
            rk.responses.contact_forces(response, rk.Block(0.2, 2.0))
    turned = rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0), rk.blocks.AsymmetricBlock(0.25, 0.2, 2.0)
    response, kept = with_forces(turned[0])  # as above: compiled once
    assert kept
    with pytest.raises(ValueError, match="must be that of the response, whose sides uplift at"):
        rk.responses.contact_forces(response, turned[1])


ASYMMETRIC = rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0)


@pytest.mark.parametrize(
    "own, other, told",
    [
        (rk.Block(0.2, 2.0), rk.Block(0.2, 2.0, rk.restitution.Housner(0.5)), "impacts leave"),
        (rk.Block(0.2, 2.0, 0.9), rk.Block(0.2, 2.0, 0.8), "impacts leave"),
        (
            rk.Block(0.2, 2.0, rk.restitution.SpeedDependent(0.9, 0.7, 1.0)),
            rk.Block(0.2, 2.0, rk.restitution.SpeedDependent(0.9, 0.6, 1.0)),
            "impacts leave",
        ),
        (ASYMMETRIC, rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0, inertia_ratio=0.6), "frequencies of the ratio"),
        (ASYMMETRIC, rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0, radius_ratio=1.2), "frequencies of the ratio"),
    ],
    ids=["inertia ratio", "restitution", "fast impacts", "its inertia ratio", "its radius ratio"],
)
@pytest.mark.parametrize("model", [rk.Housner(), rk.Linear()], ids=["nonlinear", "linear"])
def test_blocks_of_the_same_angles_are_told_apart(own, other, told, model):
    scene = Scene.of(own, rk.SinePulse(0.4, 0.6), model)
    check_own(scene, own)
    with pytest.raises(ValueError, match=f"must be that of the response, whose .*{told}"):
        check_own(scene, other)


@pytest.mark.parametrize("model", [rk.Housner(), rk.Linear()])
def test_forces_are_refused_of_a_block_whose_other_side_is_another(model):
    own = rk.blocks.AsymmetricBlock(0.2, 0.25, 2.0)
    scene = Scene.of(own, rk.SinePulse(0.4, 0.6), model)
    check_own(scene, own)
    turned, wider = rk.blocks.AsymmetricBlock(0.25, 0.2, 2.0), rk.blocks.AsymmetricBlock(0.2, 0.3, 2.0)
    for other in (turned, wider, rk.Block(0.2, 2.0, rk.restitution.PerSide(0.9, 0.8))):
        with pytest.raises(ValueError, match="must be that of the response, whose sides uplift at"):
            check_own(scene, other)
    alike = Scene.of(rk.Block(0.2, 2.0), rk.SinePulse(0.4, 0.6), model)
    with pytest.raises(ValueError, match="tells 0 sides apart, but is a Block whose .* tells 2 sides apart"):
        check_own(alike, rk.Block(0.2, 2.0, rk.restitution.PerSide(0.9, 0.8)))


@needs_references
def test_housner_friction():
    """A rectangle needs 3 tan(alpha)/(4 + tan^2(alpha)) at an impact; one that never moves, the motion's peak."""
    case = next(case for case in CASES if case["name"] == "sine and vertical sine")
    usual = rk.blocks.AsymmetricBlock(0.3, 0.3, 2.0)
    pair = float(usual.restitution1), float(usual.restitution2)
    # As the block above: compiled once.
    block = rk.blocks.AsymmetricBlock.from_frequencies(0.3, 0.3, 2.0, 2.0, 0.75, pair)
    motion = rk.SinePulse(0.2, 1.0).with_vertical(0.0 * rk.SinePulse(1.0, 1.0))
    *_, found = all_of(block, motion, (0.0, 0.0), 1.0, np.zeros(len(case["result"]["states"])))
    tangent = np.tan(0.3)
    np.testing.assert_allclose(found.friction_at_impact, 3 * tangent / (4 + tangent**2), rtol=1e-14)
    np.testing.assert_allclose(found.largest_friction, 0.2, rtol=1e-3)
    assert found.least_normal == 1
    assert found.sticks(0.21) and not found.sticks(0.19) and not any(found.impacted)


@needs_references
@pytest.mark.slow
def test_critical_amplitudes():
    """Boundaries between safe and overturned; those between the sides are none."""
    for entry in json.loads((FOLDER / "asymmetric.json").read_text())["critical_amplitudes"]:
        if not entry["name"].startswith("safe") or entry["model"] != "housner" or entry["motion"][0] != "sine":
            continue
        case = {**entry, "horizontal": ["sine", 1.0, entry["motion"][2]], "vertical": None, "initial": [0, 0]}
        block, motion, model, _ = scene(case)
        sign, ends = np.sign(entry["bracket"][0]), np.sort(np.abs(entry["bracket"]))
        intensity = tuple(ends / float(uplift_threshold(block, model)))
        found = rk.critical_amplitudes(block, sign * motion, model, intensity=intensity)
        assert np.min(np.abs(sign * np.asarray(found.value) - float(entry["amplitude"]))) < 1e-10


OUTLINES = json.loads((FOLDER / "geometry.json").read_text()) if CASES else {}


@needs_references
@pytest.mark.parametrize("name", OUTLINES)
def test_outlines(name):
    """Corners, slenderness, frequency parameters and restitutions of polygons, against exact fractions."""
    wanted = OUTLINES[name]
    vertices = np.array(wanted["vertices"])
    supports = tuple(
        int(np.flatnonzero((vertices == wanted[corner]).all(1))[0]) for corner in ("right_corner", "left_corner")
    )
    rolls = min(contact - float(a) for contact, a in zip(wanted["next_contact"], wanted["alpha"])) < 0
    if rolls:
        with pytest.raises(ValueError, match="rolls onto that face"):
            rk.blocks.AsymmetricBlock.from_outline(vertices, supports=supports)
        return
    for points in (vertices, vertices[::-1]):
        positions = supports if points is vertices else tuple(len(vertices) - 1 - i for i in supports)
        block = rk.blocks.AsymmetricBlock.from_outline(points, supports=positions, gravity=wanted["gravity"])
        # Far from the origin the coordinates themselves hold fewer digits of the shape.
        digits = 3e-15 * max(1, np.abs(vertices).max() / np.ptp(vertices, axis=0).min())
        found = {name: [getattr(block, f"{name}{side}") for side in (1, 2)] for name in ("alpha", "p", "restitution")}
        for key, values in found.items():
            np.testing.assert_allclose(values, np.array(wanted[key], float), rtol=digits, err_msg=key)
    if len({wanted["right_corner"][1], wanted["left_corner"][1], vertices[:, 1].min()}) == 1:
        flat = rk.blocks.AsymmetricBlock.from_outline(vertices, gravity=wanted["gravity"])
        np.testing.assert_allclose(flat.alpha1, block.alpha1, rtol=1e-15)


def test_an_outline_may_be_closed():
    """By its first vertex once more; and vertices may lie on straight edges."""
    points = [(0, 0), (0.2, 0), (0.3, 0), (0.5, 0), (0.6, 2), (0, 2)]
    found = [rk.blocks.AsymmetricBlock.from_outline(p) for p in (points, [*points, points[0]], points[:1] + points[3:])]
    for block in found[1:]:
        np.testing.assert_allclose([block.alpha1, block.p1], [found[0].alpha1, found[0].p1], rtol=1e-14)


def test_constructors_agree():
    """From radii, frequencies and corners; a flat base without its ratio of radii."""
    block = rk.blocks.AsymmetricBlock.from_corners((0.25, 0.0), (-0.15, 0.0), (0.0, 1.0), np.sqrt(0.35))
    flat = rk.blocks.AsymmetricBlock(block.alpha1, block.alpha2, block.p1, block.inertia_ratio)
    other = rk.blocks.AsymmetricBlock.from_frequencies(
        block.alpha1, block.alpha2, block.p1, block.p2, block.inertia_ratio
    )
    for same in (flat, other, block.mirrored.mirrored):
        for name in ("p2", "radius_ratio", "restitution1", "restitution2"):
            np.testing.assert_allclose(getattr(same, name), getattr(block, name), rtol=1e-13)


BAD = {
    "slenderness": (lambda: rk.blocks.AsymmetricBlock(0.2, 1.6, 2.0), "Argument `alpha2` must be in"),
    "inertia": (lambda: rk.blocks.AsymmetricBlock(0.2, 0.2, 2.0, 1.2), "Argument `inertia_ratio` must be in"),
    "energy": (lambda: rk.blocks.AsymmetricBlock(0.2, 0.2, 2.0, restitution=(1.1, 0.95)), "speed kept by two impacts"),
    "frequency": (
        lambda: rk.blocks.AsymmetricBlock.from_frequencies(0.2, 0.2, 2.0, 3.0),
        "the largest about any corner",
    ),
    "falls by itself": (
        lambda: rk.blocks.AsymmetricBlock.from_corners((0.1, 0), (-0.3, 0), (0.2, 1), 0.3),
        "must be positive",
    ),
    "crossing": (
        lambda: rk.blocks.AsymmetricBlock.from_outline([(0, 0), (1, 1), (1, 0), (0, 1.2)]),
        "must not cross or touch itself, but edges 0 and 2 do",
    ),
    "touching": (
        lambda: rk.blocks.AsymmetricBlock.from_outline([(0, 0), (2, 0), (2, 2), (1, 0), (0, 2)]),
        "must not cross or touch itself, but edges 0 and 2 do",
    ),
    "a line": (lambda: rk.blocks.AsymmetricBlock.from_outline([(0, 0), (1, 1), (2, 2)]), "must enclose an area"),
    "a tip": (lambda: rk.blocks.AsymmetricBlock.from_outline([(0, 0), (1, 1), (-1, 1)]), "must have a flat base"),
    "position": (
        lambda: rk.blocks.AsymmetricBlock.from_outline([(0, 0), (1, 0), (1, 2), (0, 2)], supports=(1, 4)),
        "`supports` must be a whole number from -4 to 3, but is",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    make, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        make()


def test_forces_of_a_block_that_knows_its_inertia():
    block = rk.Block.from_radius(0.25, 1.5, inertia_ratio=0.5)
    response = rk.simulate(block, rk.SinePulse(0.5, 0.6), samples=200, **QUICK)
    own, same, rectangle = (
        rk.responses.contact_forces(response, block, *given).largest_friction for given in ((), (0.5,), (0.75,))
    )
    assert own == same != rectangle


@pytest.mark.parametrize("engine", [rk.Series(order=6), rk.Diffrax(rtol=1e-8)])
def test_an_impact_may_hasten_a_block(engine):
    """About the lower corner: the largest velocity is that of the rebound."""
    block = rk.blocks.AsymmetricBlock.from_corners((0.3, -1.0), (-0.15, -1.35), (0.0, 0.0), 0.6)
    motion, start = rk.RectangularPulse(-0.05, 4.0), (-0.02, 0.0)

    @jax.jit
    def followed(block, motion):
        response = rk.simulate(block, motion, rk.Linear(), initial=start, engine=engine, samples=20_001)
        return response.impact_velocities, response.velocity, response.max_velocity

    impacts, velocity, largest = jax.device_get(followed(block, motion))
    rebound = abs(impacts[0]) * float(block.restitution2)
    assert block.restitution2 > 1.1
    for found in (largest, rk.outcome(block, motion, rk.Linear(), initial=start, engine=engine).max_velocity):
        np.testing.assert_allclose(found, rebound, rtol=1e-6)
    assert np.abs(velocity).max() <= largest * (1 + 1e-9)


def test_turning_points_are_there_once():
    """Both motions begin at once, and the piece between has no length."""
    motion = rk.RectangularPulse(-0.05, 1.0) + rk.TriangularPulse(-0.01, 1.5)

    @jax.jit
    def turns(motion):
        return rk.simulate(rk.Block(0.2, 2.0), motion, initial=(-0.02, 0.0), samples=2, **QUICK).peak_times

    peaks = np.asarray(turns(motion))
    peaks = peaks[np.isfinite(peaks)]
    assert len(peaks) > 1 and peaks[0] == 0 and (np.diff(peaks) > 0).all()


@pytest.mark.parametrize("engine", [rk.Series(order=6), rk.Diffrax(rtol=1e-8)])  # as above: compiled once
def test_impacts_after_the_motion_are_counted_up_to_a_fall(engine):
    """Back and forth to the weaker side over a still ground: a fall after two impacts; then one that comes to rest."""
    block = rk.blocks.AsymmetricBlock.from_frequencies(0.25, 0.1, 2.0, 2.0, 0.5)
    still = rk.RectangularPulse(0.0, 0.01)
    for velocity, count in ((0.3, 2), (0.1, 0)):
        found = rk.outcome(block, still, rk.Linear(), initial=(-0.01, velocity), engine=engine)
        assert found.status == rk.Status.successful
        assert bool(found.overturned) == (count > 0) and found.impact_count == count
