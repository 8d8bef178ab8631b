"""Rocks from meshes: boxes, prisms and rounded bases whose numbers are known."""

import warnings

import matplotlib.pyplot as plt
import numpy as np
import pytest

import jaxrock as rk
from jaxrock.blocks.slab import Slab
from references.meshes import of_cells

trimesh = pytest.importorskip("trimesh")

WIDTH, DEPTH, HEIGHT = 0.6, 0.4, 2.0


def box():
    """On the ground, its middle at the origin."""
    mesh = trimesh.creation.box((WIDTH, DEPTH, HEIGHT))
    mesh.apply_translation([0, 0, HEIGHT / 2])
    return mesh


def rounded(radius=3.0, half=0.5, height=1.0, sides=400):
    """A prism on a base of large radius: its section rolls from the middle to the edge."""
    across = np.linspace(-half, half, sides)
    outline = np.stack([across, radius - np.sqrt(radius**2 - across**2)], 1)
    outline = np.concatenate([outline, [[half, height], [-half, height]]])
    count = len(outline)
    ends = [np.column_stack([outline[:, 0], np.full(count, y), outline[:, 1]]) for y in (-0.5, 0.5)]
    middle = [[0, y, height / 2] for y in (-0.5, 0.5)]
    faces = []
    for k in range(count):
        a, b = k, (k + 1) % count
        faces += [
            [a, b, count + b],
            [a, count + b, count + a],
            [2 * count, b, a],
            [2 * count + 1, count + a, count + b],
        ]
    mesh = trimesh.Trimesh(np.concatenate([*ends, middle]), faces)
    mesh.fix_normals()
    return mesh


@pytest.mark.parametrize("azimuth, width", [(0.0, WIDTH), (np.pi / 2, DEPTH), (np.pi, WIDTH)])
def test_a_box_is_a_rectangle(azimuth, width):
    found = rk.blocks.AsymmetricBlock.from_mesh(box(), azimuth)
    plane = rk.Block.from_dimensions(width, HEIGHT)
    for name in ("alpha1", "alpha2"):
        assert float(getattr(found, name)) == pytest.approx(float(plane.alpha), rel=1e-12)
    assert float(found.p1) == pytest.approx(float(plane.p), rel=1e-12)
    assert float(found.restitution1) == pytest.approx(float(plane.restitution), rel=1e-12)


@pytest.mark.parametrize(
    "call",
    [
        lambda: rk.blocks.AsymmetricBlock.from_mesh(box(), 90),
        lambda: rk.blocks.Rock.from_mesh(box()).section(90),
        lambda: rk.blocks.Rock.from_mesh(box()).edges(90),
        lambda: rk.blocks.Rock.from_mesh(box()).slenderness([0, 90]),
        lambda: rk.blocks.Rock.from_mesh(box()).widths(90),
        lambda: rk.blocks.draw_rocks(rk.blocks.Rock.from_mesh(box()), 90, 3, tolerance=(0.001, 0.01)),
        lambda: rk.plot.righting(rk.blocks.Rock.from_mesh(box()), 90),
    ],
)
def test_degrees_are_refused(call):
    with pytest.raises(ValueError, match="Argument `azimuth` must be finite, and in radians, from -2 pi to 2 pi, but"):
        call()


def test_a_box_askew():
    """Towards its corner it stands on that; the inertia is that about the axis across."""
    azimuth = np.arctan2(DEPTH, WIDTH)
    section = rk.blocks.Rock.from_mesh(box()).section(azimuth)
    assert section.right[0] == pytest.approx(np.hypot(WIDTH, DEPTH) / 2, rel=1e-12)
    about = np.array([DEPTH**2 + HEIGHT**2, WIDTH**2 + HEIGHT**2]) / 12  # about the first, the second axis
    expected = about @ [np.sin(azimuth) ** 2, np.cos(azimuth) ** 2]
    assert section.gyration_radius**2 == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("suffix, unit, factor", [("stl", "mm", 1000), ("ply", "cm", 100), ("obj", "m", 1)])
def test_files_and_units(tmp_path, suffix, unit, factor):
    mesh, path = box(), tmp_path / f"rock.{suffix}"
    mesh.apply_scale(factor)
    mesh.export(path)
    rock = rk.blocks.Rock.from_mesh(path, unit=unit)
    assert rock.volume == pytest.approx(WIDTH * DEPTH * HEIGHT, rel=1e-6)
    np.testing.assert_allclose(rock.slenderness([0.0]), np.arctan2(WIDTH, HEIGHT), rtol=1e-6)


def test_a_lopsided_prism_is_its_outline():
    outline = np.array([[-0.3, 0.0], [0.2, 0.0], [0.5, 1.5], [-0.2, 1.2]])
    ends = [np.column_stack([outline[:, 0], np.full(4, y), outline[:, 1]]) for y in (0.0, 0.7)]
    mesh = trimesh.convex.convex_hull(np.concatenate(ends))
    found, plane = rk.blocks.AsymmetricBlock.from_mesh(mesh, 0.0), rk.blocks.AsymmetricBlock.from_outline(outline)
    for name in ("alpha1", "alpha2", "p1", "p2", "restitution1", "restitution2"):
        assert float(getattr(found, name)) == pytest.approx(float(getattr(plane, name)), rel=1e-9)
    turned = rk.blocks.AsymmetricBlock.from_mesh(mesh, np.pi)
    assert float(turned.alpha1) == pytest.approx(float(plane.alpha2), rel=1e-9)


def test_a_rounded_base_is_bounded_and_said():
    """It rolls on to its edge: the ground within the tolerance is narrower, and known in closed form."""
    rock = rk.blocks.Rock.from_mesh(rounded(), tolerance=0.005)
    with pytest.warns(UserWarning, match="The base is rounded: the rock rolls on"):
        narrow = rk.blocks.AsymmetricBlock.from_mesh(rock, 0.0)
    with pytest.warns(UserWarning, match="The base is rounded"):
        wide = rk.blocks.AsymmetricBlock.from_mesh(rock, 0.0, base="wide")
    assert rock.section(0.0).right[0] == pytest.approx(np.sqrt(3**2 - 2.995**2), rel=0.02)
    edge = [0.5, 3 - np.sqrt(9 - 0.25)]
    np.testing.assert_allclose(rock.section(0.0, "wide").right, edge, rtol=1e-9)
    assert float(wide.alpha1) == pytest.approx(np.arctan2(edge[0], rock.centre[2] - edge[1]), rel=1e-9)
    assert float(narrow.alpha1) < 0.5 * float(wide.alpha1)
    still = rk.Record([0.001, 0.0], 0.01)
    pair, quick = rk.motions.Components(still, still), {"progress": False, "engine": rk.Series(order=6)}
    with pytest.warns(UserWarning, match="The base is rounded: the rock is taken to rock about the outermost points"):
        rk.studies.azimuth_outcomes(rock, pair, [0.0, np.pi / 2], **quick)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rk.blocks.AsymmetricBlock.from_mesh(rock, np.pi / 2)  # along the cylinder it is flat
        rk.studies.azimuth_outcomes(rock, pair, [np.pi / 2], **quick)


@pytest.mark.parametrize("rotation", np.linspace(0.0, 0.9, 7))
def test_the_righting_moment_of_the_rolling_rock_lies_between(rotation):
    """Arm of the weight about the lowest vertex of the turned rock beyond its base, and about fixed ones."""
    rock = rk.blocks.Rock.from_mesh(rounded(), tolerance=0.005)
    narrow, wide = rock.section(0.0), rock.section(0.0, "wide")
    points = np.stack([rock.vertices[:, 0] - rock.centre[0], rock.vertices[:, 2]], 1) - narrow.centre
    points = points[points[:, 0] >= narrow.right[0] - 1e-12]
    across, up = np.array([np.cos(rotation), np.sin(rotation)]), np.array([-np.sin(rotation), np.cos(rotation)])
    rolling = points[(points @ up).argmin()] @ across
    arms = [(each.right - each.centre) @ across for each in (narrow, wide)]
    assert arms[0] - 1e-12 <= rolling <= arms[1] + 1e-12
    if 0.1 < rotation:
        assert arms[0] < rolling - 0.01


def test_polar_plot():
    axes = rk.plot.slenderness(rk.blocks.Rock.from_mesh(box()), points=24)
    assert axes[0].lines[0].get_ydata()[0] == pytest.approx(np.arctan2(WIDTH, HEIGHT), rel=1e-9)
    plt.close("all")


def test_words_of_a_polar_plot_do_not_overlap():
    axis = rk.plot.slenderness(rk.blocks.Rock.from_mesh(rounded(), tolerance=0.02), points=12)[0]
    axis.figure.canvas.draw()
    words = [axis.get_legend(), *axis.get_yticklabels(), *axis.get_xticklabels()]
    boxes = [each.get_window_extent() for each in words]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    plt.close("all")


def leaning():
    mesh = box()
    mesh.apply_transform([[1, 0, 0.5, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return mesh


def holed():
    mesh = box()
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


@pytest.mark.parametrize(
    "mesh, given, message",
    [
        (leaning(), {}, "`mesh` must stand"),
        (holed(), {}, "`mesh` must be closed"),
        (box(), {"unit": "ft"}, "`unit` must be one of"),
        (box(), {"tolerance": 0.0}, "`tolerance` must be positive"),
        ("x", {}, None),
        (3, {}, "`mesh` must be a mesh of trimesh"),
    ],
)
def test_what_is_refused(mesh, given, message):
    with pytest.raises(OSError if message is None else ValueError, match=message):
        rk.blocks.AsymmetricBlock.from_mesh(mesh, 0.0, **given)


# ------------------------------------------------------------------------------------------------ cuts by a plane


def ellipsoid(*axes, height=0.0):
    """A ball, drawn out; the ground takes the lowest part of it away."""
    mesh = trimesh.creation.icosphere(5)
    mesh.apply_scale(axes)
    if height:
        mesh = mesh.slice_plane([0, 0, -height], [0, 0, 1], cap=True)
    return mesh


def cone():
    return trimesh.creation.cone(0.5, 2.0, sections=720)


CUTS = {  # mesh, azimuth [rad]; alpha, height of the centre [m], gyration radius [m] of the cut
    "box": (box, 0.0, np.arctan2(WIDTH, HEIGHT), HEIGHT / 2, np.sqrt((WIDTH**2 + HEIGHT**2) / 12)),
    "box, from its narrow side": (box, np.pi / 2, np.arctan2(DEPTH, HEIGHT), 1.0, np.sqrt((DEPTH**2 + 4) / 12)),
    "box, across its corners": (box, np.arctan2(DEPTH, WIDTH), np.arctan2(np.hypot(DEPTH, WIDTH), HEIGHT), 1.0,
                                np.sqrt((DEPTH**2 + WIDTH**2 + 4) / 12)),
    # A triangle: its centre is at a third of the height, that of the cone at a quarter.
    "cone": (cone, 0.0, np.arctan2(0.5, 2 / 3), 2 / 3, np.sqrt(0.5**2 / 6 + 2**2 / 18)),
}  # fmt: skip


@pytest.mark.parametrize("name", CUTS)
def test_a_cut_is_the_slab_of_its_outline(name):
    mesh, azimuth, alpha, height, gyration = CUTS[name]
    section = rk.blocks.Rock.from_mesh(mesh(), tolerance=1e-6).section(azimuth, plane="cut")
    assert section.slenderness == pytest.approx((alpha, alpha), rel=2e-5)
    assert section.centre[1] == pytest.approx(height, rel=2e-5)
    assert section.gyration_radius == pytest.approx(gyration, rel=2e-5)


def test_what_a_plane_cuts_out_of_an_ellipsoid():
    """Compare the cut of an ellipsoid with an ellipse: area pi a c, second moment (a^2 + c^2)/4; also with a hole."""
    a, c, inner = 0.5, 0.8, ellipsoid(0.2, 0.2, 0.2)
    inner.invert()
    whole = trimesh.util.concatenate([ellipsoid(a, 0.6, c), inner])
    for mesh, hole in ((ellipsoid(a, 0.6, c), 0.0), (whole, 0.2)):
        slab = Slab.cut(mesh.vertices[:, [0, 2]], mesh.vertices[:, 1], mesh.faces)
        area = np.pi * (a * c - hole**2)
        second = np.pi / 4 * (a * c * (a**2 + c**2) - 2 * hole**4)
        assert slab.area == pytest.approx(area, rel=2e-3)
        np.testing.assert_allclose(slab.centre, 0, atol=1e-9)
        assert slab.gyration_radius == pytest.approx(np.sqrt(second / area), rel=2e-3)
    with pytest.raises(ValueError, match="passes it by"):
        Slab.cut(mesh.vertices[:, [0, 2]], mesh.vertices[:, 1] - 3.0, mesh.faces)


def test_a_cut_block_beside_its_outline():
    """A prism seen along its own axis: cut, projection and outline are one block."""
    outline = np.array([[-0.3, 0.0], [0.2, 0.0], [0.5, 1.5], [-0.2, 1.2]])
    ends = [np.column_stack([outline[:, 0], np.full(4, y), outline[:, 1]]) for y in (0.0, 0.7)]
    mesh = trimesh.convex.convex_hull(np.concatenate(ends))
    found = [rk.blocks.AsymmetricBlock.from_mesh(mesh, 0.0, plane=plane) for plane in ("cut", "projection")]
    for name in ("alpha1", "alpha2", "p1", "p2", "restitution1", "restitution2"):
        cut, projected, plane = (
            float(getattr(x, name)) for x in (*found, rk.blocks.AsymmetricBlock.from_outline(outline))
        )
        assert cut == pytest.approx(plane, rel=1e-9) and projected == pytest.approx(plane, rel=1e-9)


def test_a_rounded_cut_rolls_as_its_prism_does():
    rock = rk.blocks.Rock.from_mesh(rounded(), tolerance=0.005)
    openings = np.linspace(0, 0.3, 7)
    spacing = 1.0 / 400  # the plane cuts faces between their vertices, too
    np.testing.assert_allclose(rock.arms(0.0, openings, "cut"), rock.arms(0.0, openings), atol=spacing)
    assert rock.section(0.0, plane="cut").rolls == (True, True)
    for one, other in zip(rock.edges(0.0, plane="cut"), rock.edges(0.0)):
        np.testing.assert_allclose(one.run(openings), other.run(openings), atol=3 * spacing)


def test_a_cut_that_does_not_stand():
    """Check a rock on legs: the plane through the centre cuts no leg."""
    filled = np.ones((5, 5, 2), bool)
    filled[:, :, 0] = np.outer([0, 1, 0, 1, 0], [0, 1, 0, 1, 0])
    edges = [-0.5, -0.45, -0.35, 0.35, 0.45, 0.5]
    rock = rk.blocks.Rock.from_mesh(of_cells(filled, edges, edges, [0.0, 0.5, 1.0]))
    assert rock.section(0.0).slenderness[0] == pytest.approx(np.arctan2(0.45, rock.centre[2]))
    flat = rock.section(0.0, plane="cut")  # the plate alone, on its own ground
    assert flat.slenderness[0] == pytest.approx(np.arctan2(0.5, 0.25))
    bare = rock._replace(faces=None)
    with pytest.raises(ValueError, match="without `faces`"):
        bare.section(0.0, plane="cut")
