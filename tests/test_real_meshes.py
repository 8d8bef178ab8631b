"""Meshes as surveys and programs write them: far origins, units, several bodies, seams, faces turned inward."""

import subprocess
import sys
import warnings

import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxrock as rk
from jaxrock.blocks.closed_surface import ClosedSurface
from jaxrock.blocks.solid import Solid
from references.meshes import moments_of_cells, of_cells, triangles_of_cells

trimesh = pytest.importorskip("trimesh")

SIZE = np.array([0.6, 0.4, 2.0])
ALPHA, P = np.arctan2(0.6, 2.0), np.sqrt(3 * 9.81 / (2 * np.hypot(0.6, 2.0)))
SURVEY = (431234.2, 3761987.05, 1522.75)
FAR = [(0.0, 0.0, 0.0), (1e5, 0.0, 0.0), (5e5, -5e5, 1e3), (4e6, 4e6, 4e6), SURVEY]


def box(at=(0.0, 0.0, 0.0), size=SIZE):
    """Upright, its corner of least coordinates at a place."""
    mesh = trimesh.creation.box(size)
    return trimesh.Trimesh(mesh.vertices + np.asarray(size) / 2 + at, mesh.faces, process=False)


def block(mesh, azimuth=0.0, **given):
    """alpha1, alpha2, p1, p2 of a mesh."""
    found = rk.blocks.AsymmetricBlock.from_mesh(mesh, azimuth, **given)
    return np.array([float(getattr(found, name)) for name in ("alpha1", "alpha2", "p1", "p2")])


RIGHT = [ALPHA, ALPHA, P, P]


def joined(*meshes):
    """Several surfaces in one mesh; no vertex is shared."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + k for mesh, k in zip(meshes, first)])
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, process=False)


def inverted(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


# ------------------------------------------------------------------------------------------ integrals, anywhere


def digits(place, size):
    """Relative error to which coordinates in double precision carry a length."""
    return 1e-9 + 4 * np.spacing(np.abs(place).max()) / np.min(size)


@pytest.mark.parametrize("place", FAR)
def test_a_box_stands_anywhere(place):
    assert block(box(place)) == pytest.approx(RIGHT, rel=digits(place, SIZE))
    assert block(box(place), plane="cut") == pytest.approx(RIGHT, rel=digits(place, SIZE))


@pytest.mark.parametrize("place", FAR)
def test_an_ellipsoid_stands_anywhere(place):
    """A half of one, flat side down: its centre is at 3/8 of its height."""
    axes, around, rings = np.array([0.5, 0.7, 0.9]), 120, np.linspace(0, np.pi / 2, 40)[:-1]
    turn = np.linspace(0, 2 * np.pi, around, endpoint=False)
    rows = [np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), 0 * turn + np.sin(up)], 1) for up in rings]
    vertices = np.concatenate([*rows, [[0, 0, 1], [0, 0, 0]]]) * axes
    k, n = np.arange(around), around * (len(rings) - 1)
    after, top = np.roll(k, -1), np.full(around, n + around)
    faces = [np.stack([n + k, n + after, top], 1), np.stack([after, k, top + 1], 1)]
    for begin in range(0, n, around):
        a, b, c, d = begin + k, begin + after, begin + around + after, begin + around + k
        faces += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    faces = np.concatenate(faces)
    found, near = (block(trimesh.Trimesh(vertices + at, faces, process=False)) for at in (place, (0, 0, 0)))
    height = 3 / 8 * axes[2]
    gyration = (axes[0] ** 2 + axes[2] ** 2) / 5 - height**2  # about the second axis
    radius = np.hypot(axes[0], height)
    right = [np.arctan2(axes[0], height)] * 2 + [np.sqrt(9.81 * radius / (gyration + radius**2))] * 2
    assert near == pytest.approx(right, rel=2e-3)
    assert found == pytest.approx(near, rel=digits(place, axes))


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.sampled_from(FAR), st.floats(-3, 3))
def test_tetrahedra_by_their_corners(seed, place, scale):
    """Volume |det|/6; second moments about the centre 1/20 of the sum over the corners."""
    corners = 10.0**scale * np.random.default_rng(seed).normal(size=(4, 3))
    corners = corners + place
    edges = corners[1:] - corners[0]
    volume, sizes = np.linalg.det(edges) / 6, np.linalg.svd(edges)[1]
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    surface = ClosedSurface.of(corners, faces)
    assert surface.turned == (0 if volume > 0 else 4)
    found = Solid.within(surface.vertices, surface.faces)
    arms = (corners - corners[0]) - (corners - corners[0]).mean(axis=0)
    second = arms.T @ arms / 20
    lost = 1e-9 * sizes[0] / sizes[-1]
    assert found.volume == pytest.approx(abs(volume), rel=lost)
    near = sizes[0] * 1e-9 + 4 * np.spacing(np.abs(place).max())
    np.testing.assert_allclose(found.centre, corners[0] + edges.sum(axis=0) / 4, rtol=0, atol=near)
    np.testing.assert_allclose(
        found.inertia, np.trace(second) * np.eye(3) - second, rtol=0, atol=lost * np.trace(second)
    )


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from(FAR))
def test_bodies_of_boxes_by_their_boxes(seed, place):
    """A pile of columns is one body with edges inward and outward; its boxes are summed."""
    random = np.random.default_rng(seed)
    heights = random.integers(1, 4, 4)
    filled = (np.arange(3) < heights[:, None])[:, None, :]
    edges = [at + np.cumsum(np.append(0.0, random.uniform(0.1, 1.0, n))) for at, n in zip(place, filled.shape)]
    surface = ClosedSurface.of(*triangles_of_cells(filled, *edges))
    found, (volume, centre, inertia) = Solid.within(surface.vertices, surface.faces), moments_of_cells(filled, *edges)
    assert surface.turned == 0 and found.volume == pytest.approx(volume, rel=1e-9)
    np.testing.assert_allclose(found.centre, centre, rtol=1e-15, atol=1e-9)
    np.testing.assert_allclose(found.inertia, inertia, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb"])
@pytest.mark.parametrize("place", [(5e5, 1e5, 1522.75), (2e6, 4e6, 0.0), (1e5, 0.0, 0.0)])
def test_single_precision_keeps_the_box_that_it_rounds_to(tmp_path, suffix, place):
    """The rounded corners are another box, known in closed form; a warning says how far they are rounded."""
    mesh, path = box(place), tmp_path / f"rock.{suffix}"
    mesh.export(path)
    width, _, height = (np.ptp(mesh.vertices.astype(np.float32).astype(float), axis=0)).tolist()
    alpha, p = np.arctan2(width, height), np.sqrt(3 * 9.81 / (2 * np.hypot(width, height)))
    with pytest.warns(UserWarning, match="Argument `mesh` must have coordinates that resolve its shape, but in single"):
        assert block(path) == pytest.approx([alpha, alpha, p, p], rel=1e-9)


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb"])
def test_single_precision_near_its_origin_is_right(tmp_path, suffix):
    box((100.0, 50.0, 20.0)).export(tmp_path / f"rock.{suffix}")
    assert block(tmp_path / f"rock.{suffix}") == pytest.approx(RIGHT, rel=3e-5)


def test_single_precision_of_jax_does_not_round_heights_above_the_sea():
    with jax.enable_x64(False):
        assert block(box((431234.2, 3761987.05, 1522.7134))) == pytest.approx(RIGHT, rel=1e-6)


# ------------------------------------------------------------------------------------------------------- units


@pytest.mark.parametrize(
    "stated, unit, length",
    [
        (None, None, 1.0), (None, "mm", 1e-3), ("mm", None, 1e-3), ("millimeters", "mm", 1e-3), ("Meters", "m", 1.0),
        ("centimetre", None, 1e-2), ("inches", None, 0.0254), ("feet", None, 0.3048), ("0.0254 * meters", None, 0.0254),
        ("0.001 * meters", "mm", 1e-3), ("cubits", "cm", 1e-2), ("", None, 1.0),
    ],
)  # fmt: skip
def test_stated_units_are_honoured(stated, unit, length):
    mesh = box(size=SIZE / length)
    if stated is not None:
        mesh.units = stated
    assert block(mesh, unit=unit) == pytest.approx(RIGHT, rel=1e-12)
    assert rk.blocks.Rock.from_mesh(mesh, unit=unit).volume == pytest.approx(SIZE.prod(), rel=1e-12)


@pytest.mark.parametrize(
    "stated, unit, message",
    [
        ("mm", "m", "must be in the unit of `unit`, but states 'mm' where `unit` is 'm'"),
        ("inches", "cm", "must be in the unit of `unit`, but states 'inches'"),
        ("2 * meters", "m", "must be in the unit of `unit`, but states"),
        ("cubits", None, "must state a known unit, but states 'cubits': give `unit`"),
        ("-1 * meters", None, "must state a known unit"),
        ("x * meters", None, "must state a known unit"),
    ],
)
def test_units_that_contradict_are_refused(stated, unit, message):
    mesh = box()
    mesh.units = stated
    with pytest.raises(ValueError, match=f"^Argument `mesh` {message}"):
        block(mesh, unit=unit)


@pytest.mark.parametrize("unit, length", [("mm", 1e-3), ("meters", 1.0), ("inches", 0.0254)])
def test_files_state_units(tmp_path, unit, length):
    mesh, path = box(size=SIZE / length), tmp_path / "rock.glb"
    mesh.units = unit
    mesh.export(path)
    assert block(path) == pytest.approx(RIGHT, rel=1e-6)
    assert block(trimesh.load(path)) == pytest.approx(RIGHT, rel=1e-6)  # a scene
    with pytest.raises(ValueError, match="must be in the unit of `unit`, but states"):
        block(path, unit="cm")


# ------------------------------------------------------------------------------------ several bodies, and cavities


@pytest.mark.parametrize("apart", [(3.0, 0.0, 0.0), (0.6, 0.0, 0.0), (0.6, 0.4, 0.0), (0.6, 0.4, 2.0), (0.3, 0.1, 0.0)])
def test_two_bodies_are_refused(apart):
    """Apart, touching at a face, an edge, a corner, and through each other."""
    with pytest.raises(ValueError, match="^Argument `mesh` must be one body, but holds 2; the second has 1 of"):
        block(joined(box(), box(apart)))


def test_bodies_are_refused_by_their_number_and_the_advice_takes_one(tmp_path):
    crumb = box((2.0, 0, 0), size=(0.06, 0.04, 0.2))
    joined(crumb, box(), box((4.0, 0, 0), size=SIZE / 2)).export(path := tmp_path / "rock.obj")
    with pytest.raises(ValueError, match="must be one body, but holds 3; the second has 0.12 of") as refused:
        block(path)
    first, second, third = str(refused.value).split("`")[3:8:2]
    scope = {"trimesh": trimesh, "path": path}
    exec(f"{first}\n{second}\npart = {third}", scope)
    assert block(scope["part"]) == pytest.approx(RIGHT, rel=1e-6)


def test_thousands_of_crumbs_are_refused_at_once():
    crumbs = [box((3.0 + k, 0, 0), size=(0.1, 0.1, 0.1)) for k in range(60)]
    with pytest.raises(ValueError, match="must be one body, but holds 61"):
        block(joined(box(), *crumbs))


def hollow(turn=False):
    """A box with a box-shaped cavity beside its middle."""
    inner = box((0.1, 0.1, 0.2), size=(0.2, 0.2, 0.5))
    return joined(box(), inner if turn else inverted(inner))


def test_a_cavity_is_taken_out():
    edges = [0, 0.1, 0.3, 0.6], [0, 0.1, 0.3, 0.4], [0, 0.2, 0.7, 2.0]
    filled = np.ones((3, 3, 3))
    filled[1, 1, 1] = 0
    rock, (volume, centre, inertia) = rk.blocks.Rock.from_mesh(hollow()), moments_of_cells(filled, *edges)
    assert rock.volume == pytest.approx(volume, rel=1e-12) and volume == pytest.approx(SIZE.prod() - 0.02)
    np.testing.assert_allclose(rock.centre, centre, rtol=1e-12)
    np.testing.assert_allclose(rock.inertia, inertia, atol=1e-12)
    with pytest.warns(UserWarning, match="must be turned outward, but 24 of its 24 faces were not"):
        turned = rk.blocks.Rock.from_mesh(inverted(hollow()))
    assert turned.volume == pytest.approx(volume, rel=1e-12)


def test_a_surface_within_that_is_turned_outward_is_refused():
    with pytest.raises(ValueError, match="must be turned inward around its cavities, but a surface that lies within"):
        block(hollow(turn=True))


def test_a_stone_in_a_cavity_is_a_second_body():
    stone = box((0.15, 0.15, 0.3), size=(0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match="must be one body, but holds 2; the second has 0.0021 of"):
        block(joined(hollow(), stone))


def test_a_cavity_of_another_body_is_none():
    """Turned inward, but beside the rock: within its box of coordinates, where the rock is not."""
    filled = np.ones((2, 1, 3), bool)
    filled[1, 0, 1] = False
    rock = of_cells(filled, [0, 1, 2], [0, 1], [0, 1, 2, 3])
    assert block(rock) is not None
    with pytest.raises(ValueError, match="must be one body, but holds 2"):
        block(joined(rock, inverted(box((1.4, 0.4, 1.4), size=(0.2, 0.2, 0.2)))))


# ---------------------------------------------------------------------------------------------- turned inside out


def cells():
    return of_cells(np.ones((3, 2, 5)), np.linspace(0, 0.6, 4), np.linspace(0, 0.4, 3), np.linspace(0, 2, 6))


@pytest.mark.parametrize("axis", [None, 0, 1, 2])
@pytest.mark.parametrize("place", FAR)
def test_inside_out_is_turned(axis, place):
    """By the order of its vertices, or as a mirror leaves it."""
    mesh = inverted(cells()) if axis is None else cells()
    mirror = np.ones(3) if axis is None else np.where(np.arange(3) == axis, -1.0, 1.0)
    mesh = trimesh.Trimesh(mesh.vertices * mirror + place, mesh.faces, process=False)
    with pytest.warns(UserWarning, match=f"^Argument `mesh` must be turned outward, but {len(mesh.faces)} of its"):
        rock = rk.blocks.Rock.from_mesh(mesh)
    for plane in ("projection", "cut"):
        assert block(rock, plane=plane) == pytest.approx(RIGHT, rel=digits(place, SIZE))
    assert rock.volume == pytest.approx(SIZE.prod(), rel=10 * digits(place, SIZE))


@settings(deadline=None, max_examples=40)
@given(st.sets(st.integers(0, 123), max_size=60))
def test_some_faces_inward_are_turned(some):
    mesh = cells()
    assert len(mesh.faces) == 124
    faces = np.array(mesh.faces)
    faces[sorted(some)] = faces[sorted(some)][:, ::-1]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        rock = rk.blocks.Rock.from_mesh(trimesh.Trimesh(mesh.vertices, faces, process=False))
    said = f"Argument `mesh` must be turned outward, but {len(some)} of its 124 faces were not: they are turned."
    assert [str(each.message) for each in told] == [said] * bool(some)
    assert block(rock) == pytest.approx(RIGHT, rel=1e-12)
    np.testing.assert_array_equal(np.sort(rock.faces), np.sort(mesh.faces))
    assert rock.volume == pytest.approx(SIZE.prod(), rel=1e-12)


def test_a_one_sided_surface_is_refused():
    """The projective plane of six vertices is closed, and has no inside."""
    faces = [[0, k, k % 5 + 1] for k in range(1, 6)] + [[k, k % 5 + 1, (k + 2) % 5 + 1] for k in range(1, 6)]
    vertices = np.random.default_rng(1).normal(size=(6, 3))
    with pytest.raises(ValueError, match="must have an inside and an outside, but is one-sided"):
        block(trimesh.Trimesh(vertices, faces, process=False))


# ------------------------------------------------------------------------------------ what is no closed surface


@pytest.mark.parametrize("suffix, text", [
    ("obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"), ("xyz", "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"),
    ("ply", "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
            "end_header\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n"),
])  # fmt: skip
def test_clouds_of_points_are_told_so(tmp_path, suffix, text):
    path = tmp_path / f"points.{suffix}"
    path.write_text(text)
    for mesh in (path, trimesh.PointCloud(np.eye(4)[:, :3])):
        with pytest.raises(
            ValueError, match="^Argument `mesh` must be a closed surface, but is 4 points without faces"
        ):
            block(mesh)


def test_a_file_of_nothing_is_told_so(tmp_path):
    (tmp_path / "rock.obj").write_text("# nothing\n")
    with pytest.raises(ValueError, match="^Argument `mesh` must be a closed surface, but is empty"):
        block(tmp_path / "rock.obj")


def changed(vertices=None, faces=None):
    mesh = box()
    return trimesh.Trimesh(
        mesh.vertices if vertices is None else vertices(np.array(mesh.vertices)),
        mesh.faces if faces is None else faces(np.array(mesh.faces)), process=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    "mesh, message",
    [
        (lambda: changed(faces=lambda x: x[1:]), "must be closed, but 3 of its 18 edges belong to one face only"),
        (lambda: changed(faces=lambda x: x[[0, *range(12)]]), "must have two faces at every edge, but 3 of its 18"),
        (lambda: changed(faces=lambda x: np.append(x[:1], x[:1, ::-1], 0)), "must enclose a volume, but is flat"),
        (lambda: changed(lambda x: np.where(x == x.max(), np.nan, x)), "must have finite vertices, but one is not"),
        (lambda: changed(lambda x: x[:-1]), "must have faces of its 7 vertices, but one has others"),
        (lambda: changed(lambda x: x * [1, 1, 0]), "must enclose a volume, but is flat"),
        (lambda: 3, "must be a mesh of trimesh, or the path of a file, but is 3"),
    ],
)
def test_what_is_no_body_is_refused(mesh, message):
    with pytest.raises(ValueError, match=f"^Argument `mesh` {message}"):
        rk.blocks.Rock.from_mesh(mesh())


def test_stray_vertices_are_no_ground():
    mesh = changed(lambda x: np.append(x, [[5.0, 5.0, -3.0], [np.nan] * 3], 0))
    assert block(mesh) == pytest.approx(RIGHT, rel=1e-12)


# -------------------------------------------------------------------------------------------------------- seams


@settings(deadline=None, max_examples=40)
@given(st.sets(st.integers(0, 371)), st.sampled_from(FAR), st.booleans())
def test_seams_are_welded(own, place, inside_out):
    """Corners of faces that have a vertex of their own, as at the seams of a texture; all of them are a soup."""
    mesh = cells()
    vertices, corners = mesh.vertices + place, np.array(mesh.faces).reshape(-1)
    for k in own:
        vertices, corners[k] = np.append(vertices, vertices[corners[k]][None], 0), len(vertices)
    faces = corners.reshape(-1, 3)[:, :: -1 if inside_out else 1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if inside_out else "error")
        rock = rk.blocks.Rock.from_mesh(trimesh.Trimesh(vertices, faces, process=False))
    assert len(rock.vertices) == 64 and block(rock) == pytest.approx(RIGHT, rel=digits(place, SIZE))


@pytest.mark.parametrize("shift", [1e-9, 1e-8])
def test_seams_are_welded_to_rounding(shift):
    mesh = trimesh.Trimesh(cells().triangles.reshape(-1, 3), np.arange(372).reshape(-1, 3), process=False)
    random = np.random.default_rng(0).uniform(-shift, shift, mesh.vertices.shape)
    rock = rk.blocks.Rock.from_mesh(trimesh.Trimesh(mesh.vertices + random, mesh.faces, process=False))
    assert len(rock.vertices) == 64 and block(rock) == pytest.approx(RIGHT, rel=1e-7)


def test_openings_are_not_welded():
    """A slit of a millimetre is no seam."""
    mesh = cells()
    vertices, faces = np.append(mesh.vertices, mesh.vertices[mesh.faces[0]] + 1e-3, 0), np.array(mesh.faces)
    faces[0] = len(mesh.vertices) + np.arange(3)
    with pytest.raises(ValueError, match="must be closed, but 6 of its 189 edges belong to one face only"):
        block(trimesh.Trimesh(vertices, faces, process=False))


def test_a_textured_file_is_welded(tmp_path):
    """Three seams: every side of the box has coordinates of its own in the picture."""
    mesh, lines = box(SURVEY), []
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.vertices]
    lines += [f"vt {k / 36} {k % 3 / 2}" for k in range(36)]
    lines += ["f " + " ".join(f"{v + 1}/{3 * k + j + 1}" for j, v in enumerate(f)) for k, f in enumerate(mesh.faces)]
    (tmp_path / "rock.obj").write_text("\n".join(lines))
    assert len(trimesh.load(tmp_path / "rock.obj", force="mesh").vertices) > 8  # trimesh keeps the seams
    assert block(tmp_path / "rock.obj") == pytest.approx(RIGHT, rel=1e-8)


# ------------------------------------------------------------------------------------------------ without trimesh

WITHOUT = """
import sys
sys.modules["trimesh"] = None
from types import SimpleNamespace
import numpy as np, jaxrock as rk
faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
mesh = SimpleNamespace(vertices=np.append(np.zeros((1, 3)), np.eye(3), 0) + 5e5, faces=faces, units=None)
print(rk.blocks.Rock.from_mesh(mesh).volume * 6)
try:
    rk.blocks.Rock.from_mesh("rock.ply")
except ImportError as error:
    print(error)
"""


def test_a_mesh_needs_no_trimesh_and_a_file_does():
    done = subprocess.run([sys.executable, "-W", "error", "-c", WITHOUT], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    volume, message = done.stdout.splitlines()
    assert float(volume) == pytest.approx(1.0) and message.startswith("Reading a mesh needs trimesh: pip install")
