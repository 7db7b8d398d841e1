"""Triangle meshes of the primitives, in NumPy: closed where the body is, wound so that normals point outwards."""

from collections.abc import Callable

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]

# A cube's corners are numbered by the bits of (x, y, z); two triangles a face, clockwise from outside.
CUBE_FACES = np.array(
    [
        [0, 2, 3],
        [0, 3, 1],
        [4, 5, 7],
        [4, 7, 6],
        [0, 1, 5],
        [0, 5, 4],
        [2, 6, 7],
        [2, 7, 3],
        [0, 4, 6],
        [0, 6, 2],
        [1, 3, 7],
        [1, 7, 5],
    ]
)
CUBE_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
# Six tetrahedra round the cube's diagonal 0-7; neighbouring cubes then share the diagonals of their faces.
TETRAHEDRA = np.array([[0, 4, 6, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7]])


def box(center: np.ndarray, size: np.ndarray, axes: np.ndarray) -> Mesh:
    """The closed surface of a box; `axes` may be left-handed."""
    vertices = center + (CUBE_CORNERS - 0.5) * size @ axes
    return vertices, CUBE_FACES[:, ::-1] if np.linalg.det(axes) > 0 else CUBE_FACES


def revolved(origin: np.ndarray, frame: np.ndarray, profile: np.ndarray, segments: int) -> Mesh:
    """The closed surface swept by a profile round an axis.

    Args:
        origin: Where the axis starts, (3,).
        frame: Rows are two directions across and the axis, right-handed, (3, 3).
        profile: Radius and height of each ring from the lower end to the upper, (R, 2). An end whose radius is 0 is a
            tip, any other is closed by a disc.
        segments: Number of sides.
    """
    rings = profile if profile[0, 0] == 0 else np.vstack([[0.0, profile[0, 1]], profile])
    rings = rings if rings[-1, 0] == 0 else np.vstack([rings, [0.0, rings[-1, 1]]])
    angle = np.arange(segments) * (2 * np.pi / segments)
    circle = np.stack([np.cos(angle), np.sin(angle)], 1) @ frame[:2]
    inner = rings[1:-1]
    sides = origin + inner[:, :1, None] * circle + inner[:, 1:, None] * frame[2]
    tips = origin + rings[[0, -1], 1:] * frame[2]
    vertices = np.vstack([tips, sides.reshape(-1, 3)])

    here = np.arange(segments)
    there = np.roll(here, -1)
    first = 2
    last = 2 + (len(inner) - 1) * segments
    faces = [np.stack([np.zeros_like(here), first + there, first + here], 1)]
    for low in range(first, last, segments):
        faces.append(np.stack([low + here, low + there, low + segments + there], 1))
        faces.append(np.stack([low + here, low + segments + there, low + segments + here], 1))
    faces.append(np.stack([np.ones_like(here), last + here, last + there], 1))
    return vertices, np.concatenate(faces)


def implicit(function: Callable[[np.ndarray], np.ndarray], bounds: np.ndarray, cells: int) -> Mesh:
    """The surface where a function vanishes, by marching tetrahedra, cut off at the bounds.

    Args:
        function: Its value at points (M, 3).
        bounds: Lowest and highest coordinates, (2, 3).
        cells: Number of cells along each coordinate.

    Returns:
        Vertices (V, 3) and faces (F, 3), wound towards positive values; empty where there is no such surface.
    """
    steps = [np.linspace(low, high, cells + 1) for low, high in bounds.T]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
    value = function(grid)
    # A node exactly on the surface would make triangles without area; it is counted as just outside.
    value = np.where(value == 0, np.finfo(value.dtype).tiny, value)
    stride = np.array([(cells + 1) ** 2, cells + 1, 1])
    corner = np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), -1).reshape(-1, 3) @ stride
    cubes = corner[:, None] + CUBE_CORNERS @ stride
    sign = value[cubes] < 0
    nodes = cubes[sign.any(1) & ~sign.all(1)][:, TETRAHEDRA].reshape(-1, 4)
    inside = value[nodes] < 0

    edges: list[np.ndarray] = []  # three edges (pairs of nodes, inside first) a triangle
    for lone in range(4):  # one corner differs from the three others: one triangle
        others = [i for i in range(4) if i != lone]
        for is_inside in (True, False):
            rows = nodes[(inside[:, lone] == is_inside) & (inside[:, others] != is_inside).all(1)]
            edges.append(np.stack([np.stack([rows[:, lone], rows[:, o]], -1) for o in others], 1))
    for i, j, k, l in ((0, 1, 2, 3), (0, 2, 1, 3), (0, 3, 1, 2), (1, 2, 0, 3), (1, 3, 0, 2), (2, 3, 0, 1)):
        rows = nodes[inside[:, i] & inside[:, j] & ~inside[:, k] & ~inside[:, l]]  # two and two: a quadrilateral
        quad = [np.stack([rows[:, a], rows[:, b]], -1) for a, b in ((i, k), (i, l), (j, l), (j, k))]
        edges += [np.stack([quad[0], quad[1], quad[2]], 1), np.stack([quad[0], quad[2], quad[3]], 1)]
    corners = np.sort(np.concatenate(edges).reshape(-1, 2), axis=1)
    if len(corners) == 0:
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    unique, index = np.unique(corners, axis=0, return_inverse=True)
    low, high = value[unique[:, 0]], value[unique[:, 1]]
    share = (low / (low - high))[:, None]
    vertices = grid[unique[:, 0]] * (1 - share) + grid[unique[:, 1]] * share
    faces = index.reshape(-1, 3)

    # Wind every triangle so that it faces the side where the function grows.
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    step = 1e-3 * np.linalg.norm((bounds[1] - bounds[0]) / cells)
    unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    middle = (a + b + c) / 3
    falls = function(middle + step * unit) < function(middle - step * unit)
    return vertices, np.where(falls[:, None], faces[:, ::-1], faces)
