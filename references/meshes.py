"""Bodies whose volume, centre and inertia are known, as surfaces of triangles."""

import itertools

import numpy as np


def triangles_of_cells(filled, *edges):
    """Vertices and faces of the surface of the filled cells of a grid, turned outward; `edges` along every axis."""
    filled = np.pad(np.asarray(filled, bool), 1)
    numbers, vertices, faces = {}, [], []
    for cell, axis, way in itertools.product(np.argwhere(filled), range(3), (0, 1)):
        beyond = cell.copy()
        beyond[axis] += 2 * way - 1
        if filled[tuple(beyond)]:
            continue
        across = [(axis + 1) % 3, (axis + 2) % 3]
        square = []
        for steps in ((0, 0), (1, 0), (1, 1), (0, 1)):
            corner = cell - 1
            corner[axis] += way
            corner[across] += steps
            place = tuple(corner)
            if place not in numbers:
                numbers[place] = len(vertices)
                vertices.append([along[k] for along, k in zip(edges, place)])
            square.append(numbers[place])
        a, b, c, d = square if way else square[::-1]
        faces += [[a, b, c], [a, c, d]]
    return np.array(vertices, float), np.array(faces)


def moments_of_cells(filled, *edges):
    """Volume, centre and inertia about it, over the mass, of the filled cells of a grid: sums over boxes."""
    low, high = (np.stack(np.meshgrid(*ends, indexing="ij"), -1)[np.asarray(filled, bool)]
                 for ends in ([np.asarray(x)[:-1] for x in edges], [np.asarray(x)[1:] for x in edges]))  # fmt: skip
    mass, middle = (high - low).prod(axis=1), (high + low) / 2
    volume = mass.sum()
    centre = mass @ middle / volume
    arms = middle - centre
    second = np.einsum("n,ni,nj->ij", mass, arms, arms) + np.diag(mass @ (high - low) ** 2 / 12)
    return volume, centre, (np.trace(second) * np.eye(3) - second) / volume


def of_cells(filled, *edges):
    """Return the surface of the filled cells of a grid as a mesh of trimesh."""
    import trimesh

    return trimesh.Trimesh(*triangles_of_cells(filled, *edges), process=False)
