"""Drawings are to scale, at any rotation; films show the response and its verdict."""

import base64
import errno
import importlib.util
import io
import re
from pathlib import Path

import jax
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.patches import Polygon
from PIL import Image
from scipy.integrate import quad

import jaxrock as rk
from jaxrock.plot.bodies import Body
from jaxrock.plot.style import RED

BLOCK = rk.Block.from_dimensions(0.6, 1.8)
ROCK = rk.blocks.AsymmetricBlock.from_corners([0.3, 0.0], [-0.2, 0.0], [0.0, 0.9], 0.5)
COLUMN = rk.blocks.FlexibleBlock(5.0, 25.0, 30e9, 2500.0, 0.01, masses=4)
# Pictures need no digits: all responses are of this kind. The budget is more than any needs but one that is to fail.
QUICK = {"model": rk.Linear(), "engine": rk.Series(order=6, max_steps=2000)}


@pytest.fixture(autouse=True)
def closed_afterwards():
    yield
    plt.close("all")


def drawn(axis):
    """Vertices of the block, which is drawn after the ground; and its column and masses."""
    outline = [patch for patch in axis.patches if isinstance(patch, Polygon)][1].get_xy()[:-1]
    column, masses = (line.get_xydata() for line in axis.lines[1:3])
    return outline, column, masses


def words(axis):
    return {text.get_text() for text in axis.texts}


@pytest.mark.parametrize("rotation", [0.0, 0.2, -0.2, np.pi / 2])
def test_a_block_turns_about_its_corner(rotation):
    outline, _, _ = drawn(rk.plot.scene(BLOCK, rotation=rotation))
    corner = np.array([0.3 if rotation >= 0 else -0.3, 0.0])
    assert np.min(np.hypot(*(outline - corner).T)) < 1e-12
    assert outline[:, 1].min() > -1e-9  # on the ground
    centre = (outline.max(0) + outline.min(0)) / 2
    np.testing.assert_allclose(np.hypot(*(centre - corner)), BLOCK.half_diagonal)
    lean = np.arctan2(*(centre - corner)) + np.sign(corner[0]) * float(BLOCK.alpha)
    np.testing.assert_allclose(lean, rotation, atol=1e-12)  # to the right, if positive


SPRINGS = {
    "SM1": (rk.Spring("SM1"), [1.0]),
    "SM2": (rk.Spring("SM2"), [0.0]),
    "SM3": (rk.Spring("SM3"), [np.cos(np.arctan(1 / 3))]),
    "mmSM": (rk.Spring("mmSM", masses=3), [0.0, 1.0, 2.0]),
}


@pytest.mark.parametrize("name", SPRINGS)
def test_masses_of_springs(name):
    """In units of R, along the column."""
    model, heights = SPRINGS[name]
    _, column, masses = drawn(rk.plot.scene(BLOCK, model=model, rotation=0.3))
    np.testing.assert_allclose(np.hypot(*masses.T) / BLOCK.half_diagonal, heights, atol=1e-12)
    np.testing.assert_allclose(np.arctan2(*column[-1]), 0.3)


@pytest.mark.parametrize("rotation", [0.0, 0.1, -0.1])
def test_a_frame_has_two_columns_under_its_beam(rotation):
    """The beam lies on the corners of both columns, level, and moves twice as far as their centres."""
    axis = rk.plot.scene(rk.Block.from_frame(0.6, 3.0, beam=4.0), rotation=rotation)
    one, other, beam = (patch.get_xy()[:-1] for patch in axis.patches[-3:])
    assert np.ptp(one[:, 1]) >= 3.0 - 1e-9
    np.testing.assert_allclose(other - one, np.broadcast_to([4.2, 0.0], one.shape), atol=1e-12)
    assert beam[:, 1].min() == pytest.approx(one[:, 1].max(), abs=1e-12)
    alpha, size = np.arctan2(0.6, 3.0), np.hypot(0.6, 3.0) / 2
    moved = size * (np.sin(alpha) - np.sin(alpha - abs(rotation)))  # of the centre
    still = rk.plot.scene(rk.Block.from_frame(0.6, 3.0, beam=4.0)).patches[-1].get_xy()[0]
    assert abs(beam[0, 0] - still[0]) == pytest.approx(2 * moved, abs=1e-9)


def test_restraints_are_drawn():
    """A tie is as much longer as the model says; a tendon is drawn through the base."""
    block, rotation = rk.Block.from_dimensions(0.6, 3.0), 0.15
    size = np.hypot(0.6, 3.0) / 2
    model = rk.Housner() + rk.models.Tie(1.2, 1.0) + rk.models.Tendon(1.0) + rk.models.Damper(0.1)
    drawn_lines = [
        [
            line.get_xydata()
            for line in rk.plot.scene(block, model=model, rotation=turn).lines
            if line.get_color() == RED
        ]
        for turn in (0.0, rotation)
    ]
    (still, *_), (open_, *_) = drawn_lines
    longer = np.hypot(*np.ptp(open_, axis=0)) - np.hypot(*np.ptp(still, axis=0))
    assert longer == pytest.approx(1.2 * size * np.sin(rotation), rel=0.05)  # the tie turns a little


def test_a_column_bends():
    _, column, masses = drawn(rk.plot.scene(COLUMN, bending=1.0))
    np.testing.assert_array_equal(column, masses)
    np.testing.assert_allclose(column[-1], [1.0, COLUMN.length])
    assert (np.diff(column[:, 0], n=2) > 0).all() and column[0, 0] == 0  # clamped below, the more bent above


def test_an_asymmetric_block_keeps_its_corners_and_its_centre():
    outline, _, _ = drawn(rk.plot.scene(ROCK))
    np.testing.assert_allclose(outline[1] - outline[0], [0.5, 0.0], atol=1e-12)  # right corner, left corner
    np.testing.assert_allclose(outline.mean(0) - outline[1], [-0.3, 0.9], atol=1e-9)


@pytest.mark.parametrize(
    ("block", "model", "symbols"),
    [
        (BLOCK, rk.Housner(), {"$R$", "$2b$", "$2h$", r"$\alpha$", r"$\theta$", "$O$", "$O'$", "$m$", r"$\ddot u_g$"}),
        (ROCK, rk.Housner(), {"$R_1$", "$R_2$", r"$\alpha_1$", r"$\alpha_2$", "$O$", "$O'$"}),
        (BLOCK, rk.Spring("SM3"), {r"$R\cos\alpha$", "$2b$"}),
        (COLUMN, rk.Housner(), {"$2R$", "$2h$"}),
    ],
)
def test_symbols(block, model, symbols):
    assert symbols <= words(rk.plot.scene(block, model=model, rotation=0.1))


@pytest.mark.parametrize(
    ("motion", "symbol"), [(rk.SinePulse(0.5, 1.0), "$T_p$"), (rk.ExponentialPulse(0.5, 1.0, 0.5), "$t_d$")]
)
def test_the_motion_is_drawn_below(motion, symbol):
    axis = rk.plot.scene(BLOCK, motion)
    (below,) = axis.child_axes
    time, values = below.lines[0].get_xydata().T
    during = (time > 0) & (time < 1)
    np.testing.assert_allclose(values[during], np.asarray(motion.acceleration(time))[during])
    assert {" $a_g$", symbol} <= words(below)


@pytest.mark.parametrize(
    "motion",
    [0.7 * rk.SinePulse(0.5, 1.0), rk.MavroeidisPapageorgiouPulse(0.5, 1.0, 1.5, 1.0), rk.Record([0.1, 0], 0.1)],
)
def test_a_peak_that_is_no_amplitude_is_not_called_so(motion):
    (below,) = rk.plot.scene(BLOCK, motion).child_axes
    assert " $a_g$" not in words(below) and " peak" in words(below)


def test_corners_and_jumps_are_drawn_where_they_are():
    """However long the motion is: the peak, too, and both sides of a jump; not half a sample beside them."""
    samples = np.zeros(6000)
    samples[3001] = 1.0
    (below,) = rk.plot.scene(BLOCK, rk.Record(samples, 0.01)).child_axes
    time, values = below.lines[0].get_xydata().T
    np.testing.assert_allclose((time[values.argmax()], values.max(), below.lines[2].get_ydata()[0]), (30.01, 1, 1))
    (below,) = rk.plot.scene(BLOCK, rk.RectangularPulse(0.5, 1.0)).child_axes
    time, values = below.lines[0].get_xydata().T
    steps = np.abs(np.diff(values)) > 0
    np.testing.assert_allclose(time[:-1][steps], [0, 1], atol=1e-12)
    assert np.diff(time)[steps].max() < 1e-12
    assert {" $a_g$"} <= words(below)


@pytest.mark.parametrize("block", [rk.Block(0.05, 2.0), rk.Block(0.2, 2.0), rk.Block(0.9, 2.0), ROCK])
def test_a_scene_is_in_its_figure(block):
    """With all its words, from the first picture on."""
    axis = rk.plot.scene(block, PULSE)
    figure = axis.figure
    figure.canvas.draw()
    (below,) = axis.child_axes
    for box in (axis.get_tightbbox(), below.get_tightbbox(), below.xaxis.label.get_window_extent()):
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rk.plot.scene(BLOCK, rotation=2.0), r"Argument `rotation` must be in \[-pi/2, pi/2\]"),
        (lambda: rk.plot.scene(BLOCK, bending=1.0), "Argument `bending` must be zero for a Block"),
        (lambda: rk.plot.scene(rk.Block(np.array([0.1, 0.2]), 2.0)), "Argument `block` must hold one scene"),
    ],
)
def test_what_cannot_be_drawn(call, message):
    with pytest.raises(ValueError, match=message):
        call()


PULSE = rk.SinePulse(0.5, 1.0)


def started(film):
    """A film that has drawn: matplotlib warns of others."""
    film._init_draw()
    return film


def scene_alone(film):
    """Leave out the histories, and the ticks that nobody sees: they take most of the time to draw."""
    scene, *histories = film._fig.axes
    scene.set(xticks=[], yticks=[])
    for axis in histories:
        axis.remove()


@pytest.fixture(scope="module")
def response():
    return rk.simulate(BLOCK, PULSE, **QUICK, duration=3.0)


def test_a_film_follows_the_response(response):
    film = started(rk.plot.animate(response, fps=10, speed=1.0))
    axis = film._fig.axes[0]
    for number in (4, 12, 30):
        film._func(number)
        outline, _, _ = drawn(axis)
        rotation = float(response(number / 10)[0])
        edge = outline[24] - outline[0]  # the right side
        np.testing.assert_allclose(np.arctan2(*edge), rotation, atol=1e-9)
    assert axis.get_title().endswith("overturns" if response.overturned else "stands")
    assert f"{int(response.impact_count)} impact" in axis.get_title()
    assert knots_drawn(film._fig.axes[2])


def knots_drawn(axis):
    """Return whether the times of a curve include the end of `PULSE` and the moment before it, which its steps miss."""
    time = axis.lines[0].get_xdata()
    return np.isin([np.nextafter(1.0, 0.0), 1.0], time).all() and np.all(np.diff(time) >= 0)


def test_a_history_has_the_knots_of_its_motion(response):
    assert knots_drawn(rk.plot.history(response)[2])


@pytest.mark.slow
def test_a_film_of_a_column():
    response = rk.simulate(COLUMN, rk.SinePulse(0.4, 1.6), duration=4.0)
    np.testing.assert_allclose(response.column(1.3)[-1], response(1.3)[1])
    film = started(rk.plot.animate(response, fps=10))
    film._func(13)
    axes = rk.plot.history(response)
    for axis, k, factor in ((axes[0], 0, 1 / COLUMN.alpha), (axes[1], 1, 1.0)):
        time, values = axis.lines[0].get_xydata()[::4000].T
        np.testing.assert_allclose(values, response(time)[k] * factor, rtol=1e-12)
    assert axes[1].get_legend_handles_labels()[1] == ["top", "of it bending"]
    _, column, _ = drawn(film._fig.axes[0])
    rotation, top, bending = (float(x) for x in response(1.3))
    across = column[-1, 0] * np.cos(rotation) - column[-1, 1] * np.sin(rotation)
    np.testing.assert_allclose(across, bending, atol=1e-9)


def test_the_shape_of_an_asymmetric_block_must_be_given():
    response = rk.simulate(ROCK, PULSE, **QUICK, duration=1.0)
    with pytest.raises(ValueError, match="Argument `block` must be given for the response of an asymmetric block"):
        rk.plot.animate(response)
    started(rk.plot.animate(response, ROCK))


LOPSIDED = rk.blocks.AsymmetricBlock.from_corners([np.tan(0.15), 0.0], [-np.tan(0.3), 0.0], [0.0, 1.0], 0.6)


def test_each_side_has_its_own_threshold_and_saddle():
    response = rk.simulate(LOPSIDED, PULSE, **QUICK, duration=1.0)
    lines = rk.plot.history(response)[2].lines
    assert {round(line.get_ydata()[0], 9) for line in lines if len(line.get_ydata()) == 2} == {0, -0.15, 0.3}
    points = [line.get_xdata()[0] for line in rk.plot.phase(response).lines if line.get_marker() == "o"]
    np.testing.assert_allclose(points, [1.0, -2.0])


def test_both_saddles_of_an_asymmetric_block_are_seen():
    """And the manifolds that begin upright."""
    response = rk.simulate(LOPSIDED, rk.SinePulse(0.2, 0.1), **QUICK, duration=0.5)
    axis = rk.plot.phase(response)
    (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
    assert left < -2 and 1 < right < 2.1
    ends = [
        abs(line.get_ydata()[0]) for line in axis.lines if line.get_color() == "#b3352c" and line.get_marker() != "o"
    ]
    assert len(ends) == 4 and -low == high > max(ends) > 1


def test_a_vertical_acceleration_moves_the_threshold():
    """Check a vertical acceleration: a block pressed down lifts later, where the acceleration passes the line."""
    motion = rk.SinePulse(0.4, 1.0).with_vertical(rk.SinePulse(0.5, 0.5))
    response = rk.simulate(BLOCK, motion, **QUICK, duration=1.5)
    above, _, axis = rk.plot.history(response)
    lines = {line.get_label(): line for line in axis.lines}
    time, vertical = lines["vertical"].get_xydata().T
    shaken = time < 0.5
    np.testing.assert_allclose(vertical, np.where(shaken, 0.5 * np.sin(4 * np.pi * time), 0.0), atol=1e-12)
    level = lines["uplift threshold"].get_ydata()
    np.testing.assert_allclose(level, -float(BLOCK.alpha) * (1 + vertical))
    moments, rotation = above.lines[0].get_xydata().T
    begun = moments[np.flatnonzero(rotation)[0]]
    passed = time[np.flatnonzero(0.4 * np.sin(2 * np.pi * time) > -level)[0]]
    np.testing.assert_allclose(begun, passed, atol=2e-3)


def test_a_response_without_a_result_is_called_so(response):
    failed = rk.simulate(BLOCK, PULSE, **QUICK, duration=6.0, initial=(0.31, 0.0))
    said = "no result: the step budget was used up before the motion ended"
    assert rk.plot.history(failed)[0].get_title() == rk.plot.phase(failed).get_title() == said
    assert rk.plot.history(response)[0].get_title() == rk.plot.phase(response).get_title() == ""
    film = started(rk.plot.animate(failed, fps=10, speed=120.0))
    film._func(100)
    axis = film._fig.axes[0]
    assert " ".join(axis.get_title().split()).endswith(said)
    box, whole = axis.title.get_window_extent(), film._fig.bbox
    assert box.x0 > 0 and box.y1 < whole.y1 and box.x1 < film._fig.axes[1].get_window_extent().x0


@pytest.mark.parametrize("draw", [rk.plot.history, rk.plot.phase, rk.plot.animate])
def test_many_responses_are_in_no_figure(draw, response):
    many = jax.tree.map(lambda x: np.stack([x, x]), response)  # as `jax.vmap` leaves them
    with pytest.raises(ValueError, match="holds many scenes"):
        draw(many)


def test_another_block_is_not_drawn(response):
    with pytest.raises(ValueError, match="Argument `block` must be that of the response, whose alpha and p are"):
        rk.plot.animate(response, rk.Block(0.3, 2.0))
    with pytest.raises(ValueError, match="which is rigid, but is a FlexibleBlock"):
        rk.plot.animate(response, COLUMN)


@pytest.mark.parametrize("kind", ["gif", "html"])
def test_films_are_written(kind, response, tmp_path):
    film = rk.plot.animate(response, fps=2, speed=30.0)
    path = tmp_path / f"film.{kind}"
    rk.plot.save_animation(film, path, dpi=30)
    start = path.read_bytes()[:15]
    assert start.startswith(b"GIF89a") if kind == "gif" else start == b"<!DOCTYPE html>"


@pytest.mark.parametrize("kind", ["gif", "html", "mp4"])
def test_a_film_that_fails_leaves_the_one_before(kind, response, tmp_path, monkeypatch):
    def full(self, path, **_):
        Path(path).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / f"film.{kind}"
    path.write_text("years of work")
    film = rk.plot.animate(response, fps=2, speed=30.0)
    scene_alone(film)
    if kind == "html":
        monkeypatch.setattr(Path, "write_text", lambda self, *_, **__: full(None, self))
    else:
        monkeypatch.setattr(type(film), "save", full)
    monkeypatch.setattr("matplotlib.animation.FFMpegWriter.isAvailable", lambda: True)
    with pytest.raises(OSError, match="No space left"):
        rk.plot.save_animation(started(film), path, dpi=10)
    assert path.read_text() == "years of work" and [each.name for each in tmp_path.iterdir()] == [path.name]


def test_films_as_html_are_whole_and_of_their_dpi(response, tmp_path):
    """Check that HTML films are complete: another dpi draws anew, and beyond matplotlib's limit the end is kept."""
    film, sizes = rk.plot.animate(response, fps=2, speed=30.0), []
    scene_alone(film)
    for dpi in (20, 40):
        with matplotlib.rc_context({"animation.embed_limit": 0.001}):
            rk.plot.save_animation(film, tmp_path / "film.html", dpi=dpi)
        frames = re.findall(r'frames\[\d+\] = "data:image/png;base64,([^"]+)"', (tmp_path / "film.html").read_text())
        assert len(frames) == len(list(film.new_frame_seq()))
        with Image.open(io.BytesIO(base64.b64decode(frames[0].replace("\\\n", "")))) as picture:
            sizes.append(picture.size)
    assert sizes[1] == tuple(2 * x for x in sizes[0])


@pytest.mark.parametrize("fps", [7, 60])
def test_a_film_lasts_as_long_as_it_should(fps, response, tmp_path):
    """Pictures of a GIF last whole hundredths of a second, and two at least, which all viewers keep."""
    film = rk.plot.animate(response, fps=fps, speed=30.0)
    scene_alone(film)
    rk.plot.save_animation(film, tmp_path / "film.gif", dpi=10)
    with Image.open(tmp_path / "film.gif") as picture:
        lasts = []
        for number in range(picture.n_frames):
            picture.seek(number)
            lasts.append(picture.info["duration"])
    assert abs(sum(lasts) / 1000 - (np.ceil(0.1 * fps) + 1 + fps) / fps) < 0.021
    assert min(lasts) >= 20
    if fps == 60:
        return
    rk.plot.save_animation(film, tmp_path / "film.html", dpi=10)
    (step,) = re.findall(r"new Animation\(frames, img_id, slider_id, ([\d.]+)", (tmp_path / "film.html").read_text())
    assert abs(float(step) - 1000 / fps) <= 0.5


@pytest.mark.parametrize("block", [rk.Block(0.6, 2.0), rk.blocks.AsymmetricBlock.from_corners(
    [0.3, 0.1], [-0.2, 0.0], [0.0, 0.6], 0.5), rk.blocks.AsymmetricBlock.from_corners(
    [0.3, 0.0], [-0.2, 0.15], [0.0, 0.6], 0.5)])  # fmt: skip
@pytest.mark.parametrize("way", [1, -1])
def test_a_fallen_block_lies_on_the_ground_in_the_picture(block, way):
    response = rk.simulate(block, rk.SinePulse(2.5 * way, 1.5), **QUICK, duration=6.0)
    assert response.overturned
    film = started(rk.plot.animate(response, block, fps=10, speed=1.0))
    axis = film._fig.axes[0]
    for number in range(62):
        film._func(number)
        outline, _, _ = drawn(axis)
        (left, right), (_, high) = axis.get_xlim(), axis.get_ylim()
        assert left < outline[:, 0].min() and outline[:, 0].max() < right and outline[:, 1].max() < high
    body = Body.of(block, rk.Housner())
    level = np.interp(outline[:, 0], [body.left[0], body.right[0]], [body.left[1], body.right[1]])
    over = outline[:, 1] - level
    assert abs(over.min()) < 1e-9 and (over < 1e-9).sum() >= 2  # on one of its sides


@pytest.mark.filterwarnings("ignore:os.fork")
def test_films_as_mp4(response, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    rk.plot.save_animation(rk.plot.animate(response, fps=2, speed=30.0), tmp_path / "film.mp4", dpi=50)
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"


def test_mp4_without_ffmpeg_says_what_to_do(response, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(plt.rcParams, "animation.ffmpeg_path", "no such program")
    with pytest.raises(ValueError, match="which is not there: install it, or `pip install"):
        rk.plot.save_animation(started(rk.plot.animate(response, fps=2, speed=30.0)), tmp_path / "film.mp4")


def test_other_endings_are_refused(response, tmp_path):
    film = started(rk.plot.animate(response, fps=2, speed=30.0))
    with pytest.raises(ValueError, match="Argument `path` must end with .gif, .html or .mp4"):
        rk.plot.save_animation(film, tmp_path / "film.avi")


# ------------------------------------------------------------------------------------------------- rounded edges

PROFILE = rk.blocks.Edge([0.6, 0.2, 0.0], [0.0, 0.15, 0.3])
EDGES = {
    "circle": (BLOCK, rk.models.Rolling(0.3)),
    "profile": (BLOCK, rk.models.Rolling(PROFILE)),
    "two sides": (ROCK, rk.models.Rolling(0.4, 0.1)),
}


@pytest.mark.parametrize("rotation", [0.2, -0.2, 0.6])
@pytest.mark.parametrize("name", EDGES)
def test_a_rounded_edge_rolls_on_the_ground(name, rotation):
    """Check a rounded edge on the ground: it touches without going below, with the centre of the equation of motion."""
    block, model = EDGES[name]
    body = Body.of(block, model)
    shapes = body.pose(rotation)
    outline = rk.plot.scene(block, model=model, rotation=rotation).patches[1].get_xy()[:-1]
    np.testing.assert_array_equal(outline, shapes.outline)
    assert abs(outline[:, 1].min()) < 2e-4  # drawn by straight lines
    edge = body.edges[0 if rotation > 0 else 1]
    corner = body.right if rotation > 0 else body.left
    radius, alpha = np.hypot(*(body.centre - corner)), np.arctan2(abs(corner[0] - body.centre[0]), body.centre[1])
    x, reach = abs(rotation), quad(edge.at, 0, abs(rotation), points=(0.15, 0.3))[0]
    np.testing.assert_allclose(shapes.pivot, corner + [np.sign(rotation) * radius * reach, 0.0], atol=1e-8)
    away = np.array([np.sign(rotation), 1.0]) * (body.placed(body.centre, rotation) - shapes.pivot) / radius
    expected = -np.sin(alpha - x) - float(edge.run(x)), np.cos(alpha - x) + float(edge.rise(x))
    np.testing.assert_allclose(away, expected, atol=1e-8)


@pytest.mark.slow
def test_a_film_of_a_block_that_rolls():
    """It knows the edges of the response."""
    model, initial = EDGES["circle"][1], (0.1, 0.0)
    response = rk.simulate(BLOCK, rk.SinePulse(0.5, 0.6), model, initial=initial, duration=0.4)
    film = started(rk.plot.animate(response, BLOCK, fps=5))
    for number, time in enumerate((0.0, 0.2, 0.4)):
        outline = film._func(number)[0].get_xy()[:-1]
        rotation = float(response(np.array([time]))[0][0])
        np.testing.assert_allclose(outline, Body.of(BLOCK, model).pose(rotation).outline, atol=1e-9)
    assert abs(rotation) > 0.01
