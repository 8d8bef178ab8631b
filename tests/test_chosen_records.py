"""One record of a suite by its number: under `jax.vmap`, as an axis of a sweep, in place and without copies."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxrock as rk
from jaxrock._core.arrays import is_traced
from jaxrock.engines import remaining_forcing
from jaxrock.engines.scene import Scene
from jaxrock.motions.joined_records import Chosen, JoinedRecords

SAMPLES = 1.5 * np.asarray(rk.example_record().samples)
LENGTHS, STEPS = (300, 2, 310, 265), (0.01, 0.02, 0.005, 0.013)
RECORDS = [rk.Record(SAMPLES[380 : 380 + n] + 0.02, dt, f"of {n}") for n, dt in zip(LENGTHS, STEPS)]
BLOCK = rk.Block(0.15, 3.0)
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6)}  # compiles in half the time
SCALES = np.geomspace(0.3, 6.0, 20)


@functools.cache
def joined():
    return rk.motions.Suite(RECORDS)


@functools.cache
def mixed():
    return rk.motions.Suite([RECORDS[0], rk.SinePulse(0.4, 0.5)])


def outcome(motion, scale=1.0):
    return rk.outcome(BLOCK, scale * motion, **QUICK)


def at_scales(motion, scales):
    """Outcomes at several scales, of one motion with samples of its own."""
    return jax.vmap(lambda scale: outcome(motion, scale))(scales)


@pytest.fixture(scope="module")
def grid():
    """Eighty scenes: the quick pass, too."""
    return rk.sweep(outcome, motion=joined(), scale=SCALES, progress=False)


@pytest.fixture(scope="module")
def by_hand():
    """Outcomes of the records one after the other, each with samples of its own."""
    return jax.tree.map(lambda *rows: np.stack(rows), *(at_scales(motion, SCALES) for motion in RECORDS))


@pytest.mark.parametrize("name", ["overturned", "impact_count", "max_rotation", "margin", "time_of_max", "clearance"])
def test_an_axis_of_records_beside_one_after_the_other(grid, by_hand, name):
    """Also in the record of one piece, and where the next one is stronger than what is left of one's own."""
    assert 0.2 < by_hand.overturned.mean() < 0.8
    np.testing.assert_allclose(getattr(grid.values, name), getattr(by_hand, name), rtol=1e-8)


@functools.partial(jax.jit, static_argnums=1)
def told(motion, in_place):
    """Return facts of the scene under twice a motion, by which records in place and alone are compared.

    These are its first piece, the piece after its last, bounds of later forcing, lengths of pieces, the strongest
    drive, and bounds of the pieces.
    """
    scene = Scene.of(BLOCK, 2.0 * motion, rk.Linear(), in_place=in_place)
    ahead, count = scene.outlook.horizontal, sum(LENGTHS) if in_place else motion.samples.size
    lengths = jax.vmap(scene.length)(jnp.arange(count))
    return scene.first, scene.pieces, ahead.to_end, lengths, scene.outlook.strongest_drive, ahead.bounds.values


@pytest.mark.parametrize("number", range(4))
def test_bounds_of_what_is_to_come_end_with_a_record(number):
    """They are those of the record alone: what follows in the array is another motion."""
    chosen = Chosen(JoinedRecords.of(RECORDS), jnp.int32(number), jnp.ones(()))
    first, pieces, to_end, lengths, strongest, _ = map(np.asarray, told(chosen, True))
    _, count, own_to_end, own_lengths, own_strongest, own_bounds = map(np.asarray, told(RECORDS[number], False))
    np.testing.assert_array_equal(to_end[first : pieces + 1], own_to_end)
    lengths = lengths[first : first + count + 1]
    np.testing.assert_array_equal(lengths, own_lengths)
    assert np.isinf(lengths[-1])
    assert strongest == own_strongest == 2 * own_bounds.max()


def test_labels_are_the_names_of_records(grid, tmp_path):
    pytest.importorskip("h5netcdf")
    pytest.importorskip("zarr")
    names = [f"of {n}" for n in LENGTHS]
    assert list(grid.axes["motion"]) == names
    assert grid.to_xarray().margin.sel(motion="of 310", scale=SCALES[3]) == grid.values.margin[2, 3]
    for kind in ("nc", "zarr"):
        grid.save(tmp_path / f"found.{kind}")
        again = rk.studies.Grid.load(tmp_path / f"found.{kind}")
        assert list(again.axes["motion"]) == names
        np.testing.assert_array_equal(again.values.margin, grid.values.margin)


def test_a_store_knows_the_names_of_records(grid, tmp_path):
    pytest.importorskip("zarr")

    def run(names):
        axes = {"motion": rk.motions.Suite(RECORDS, names), "scale": SCALES}
        return rk.sweep(outcome, **axes, store=tmp_path / "s.zarr", progress=False)

    run(list("abcd"))
    again = run(list("abcd"))
    assert again.resumed == 4 * SCALES.size and list(again.axes["motion"]) == list("abcd")
    with pytest.raises(ValueError, match="other words of axis `motion`"):
        run(list("abce"))


def test_lanes_share_the_samples_of_all_records():
    """No lane has arrays of its own."""

    def margin(number):
        return outcome(joined()[number]).margin

    numbers = np.arange(60) % len(joined())  # without a quick pass, which takes longer to compile
    memory = jax.jit(jax.vmap(margin)).lower(numbers).compile().memory_analysis()
    lanes = numbers.size * max(LENGTHS) * SAMPLES.itemsize  # one copy for each
    assert memory.temp_size_in_bytes < lanes / 2


def test_what_is_known_stays_so():
    """Check that known records stay concrete: else every call would join them again, and every suite compile anew."""
    found = []
    jax.jit(lambda number: found.append(joined()[number].joined) or number)(1)
    assert not is_traced(found)


def peak(number):
    return rk.intensity.peak_acceleration(joined()[number])


def test_numbers_without_a_record_are_no_other_record():
    """They raise also where XLA deals lanes to devices; an exported program finds nothing there."""
    numbers, compiled = np.array([-1, 0, 3, 4]), jax.jit(jax.vmap(peak))
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:2]), ("devices",))
    dealt = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("devices"))
    with pytest.raises(Exception, match=r"must be in \[0, 3\]"):
        jax.block_until_ready(compiled(jax.device_put(numbers, dealt)))
    exported = jax.export.export(compiled)(jax.ShapeDtypeStruct(numbers.shape, numbers.dtype))
    expected = [np.nan, *np.asarray(joined().peak_acceleration)[[0, 3]], np.nan]
    np.testing.assert_allclose(exported.call(numbers), expected, rtol=1e-12)
    nothing = Chosen(JoinedRecords.of(RECORDS), jnp.int32(0), jnp.asarray(jnp.nan))

    @jax.jit
    def shaken(motion):
        scene = Scene.of(BLOCK, 2.0 * motion, rk.Linear(), in_place=True)
        shaking, _ = scene.shaking(jnp.int32(0), jnp.zeros(()), 8)
        return [scene.outlook.strongest_drive, *shaking.horizontal[:2]]

    assert np.isnan(shaken(nothing)).all()


@pytest.mark.slow
def test_an_exported_outcome_without_a_record():
    compiled = jax.jit(jax.vmap(lambda number: outcome(joined()[number])))
    found = jax.export.export(compiled)(jax.ShapeDtypeStruct((2,), int)).call(np.array([0, 9]))
    assert np.isnan(found.margin).tolist() == [False, True]
    assert (found.status == rk.Status.not_finite).tolist() == [False, True]


def test_measures_of_a_chosen_record():
    peaks = jax.jit(jax.vmap(peak))(np.arange(4))
    np.testing.assert_allclose(peaks, joined().peak_acceleration, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_and_other_ways_go_through():
    """A chosen record within other motions has samples of its own."""

    def margin(number, scale, delay):
        return rk.outcome(BLOCK, (scale * joined()[number]).shifted(delay), **QUICK).margin

    def in_place(number, scale):
        return outcome(joined()[number], scale).margin

    numbers = jnp.arange(4)
    assert_close = np.testing.assert_allclose
    apart = [rk.outcome(BLOCK, (1.2 * motion).shifted(0.3), **QUICK).margin for motion in RECORDS]
    assert_close(jax.vmap(margin, (0, None, None))(numbers, 1.2, 0.3), apart, rtol=1e-8)
    slopes = [jax.grad(lambda s, m=motion: outcome(m, s).margin)(1.2) for motion in RECORDS]
    assert_close(jax.vmap(jax.grad(in_place, 1), (0, None))(numbers, 1.2), slopes, rtol=1e-7)
    one, other = (rk.simulate(BLOCK, motion, samples=51, **QUICK) for motion in (RECORDS[2], joined()[2]))
    assert_close(one.rotation, other.rotation, rtol=0, atol=1e-12)


def test_pulses_of_one_kind_are_chosen_by_number():
    suite = rk.motions.Suite([rk.SinePulse(0.4, 0.5), rk.SinePulse(0.3, 0.8)])
    found = jax.vmap(lambda number: rk.intensity.peak_acceleration(suite[number]))(jnp.arange(2))
    np.testing.assert_allclose(found, [0.4, 0.3], rtol=1e-9)


def test_records_times_factors_are_chosen_by_number():
    """Alone or as many factors of one record, beside records as they are."""
    suite = rk.motions.Suite([RECORDS[0], 0.5 * RECORDS[2], np.array([0.4, 0.6]) * RECORDS[3]])
    found = jax.vmap(lambda number: outcome(suite[number]).margin)(jnp.arange(4))
    each = (RECORDS[0], 1.0), (RECORDS[2], 0.5), (RECORDS[3], 0.4), (RECORDS[3], 0.6)
    expected = [at_scales(record, np.full(SCALES.size, factor)).margin[0] for record, factor in each]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize(
    "choose, error, message",
    [
        (lambda: joined()[4], IndexError, "out of range"),
        (lambda: float(jax.jit(lambda k: outcome(joined()[k]).margin)(4)), Exception, r"must be in \[0, 3\]"),
        (lambda: jax.jit(lambda k: outcome(joined()[k]).margin)(1.5), ValueError, "has a whole number"),
        (
            lambda: jax.jit(lambda k: outcome(mixed()[k]).margin)(1),
            ValueError,
            "must be records, also times factors, or",
        ),
    ],
)
def test_what_is_refused(choose, error, message):
    with pytest.raises(error, match=message):
        choose()


def test_a_suite_is_a_sequence():
    assert [motion.samples.size for motion in joined()] == list(LENGTHS)
    assert joined()[-1].samples.size == LENGTHS[-1] and mixed()[1].acceleration(0.125) == pytest.approx(0.4)


def test_compiled_functions_do_not_see_names():
    """One program serves records of all names: what reads the name finds none, where it would find the first one's."""
    seen, records = [], [rk.Record([0.1, 0.2], 0.1, name) for name in ("first", "second")]

    @jax.jit
    def twice(record):
        seen.append((record.name, record.origin.event))
        return 2 * record.samples

    for record in records:
        twice(record)
    assert seen == [("", "")] and [record.name for record in records] == ["first", "second"]


@pytest.mark.parametrize("count", [17, 255, 256, 257, 513, 3000])
def test_largest_values_from_each_piece_on(count):
    """Check the largest values of the next 16, the next 256, and all later pieces."""
    values = np.abs(np.random.default_rng(count).normal(size=count)) * np.exp(-np.arange(count) / count)
    wanted = [[values[i : i + most].max() for i in range(count)] for most in (count, 16, 256)]
    np.testing.assert_array_equal(jax.jit(remaining_forcing._maxima)(values), wanted)
