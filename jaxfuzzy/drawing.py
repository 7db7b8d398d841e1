"""What a shape looks like on paper and screen: its color, its name, its sizes in words, its outline in the photograph.

Shared by figures, report, exports and command line, so that an object has one color and one name everywhere.
"""

import math
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Primitive, Quadric, Sphere
from jaxfuzzy.rig import Rig
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status

# Okabe & Ito, "Color Universal Design", 2008, without black: told apart with any common color vision. The object's
# number is always written beside its color, because there are more objects than colors.
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#F0E442")
NOISE_COLOR = "#606060"
# Edges where the surface turns by more than this are drawn; those of a round side turn by 7.5 degrees.
SHARP = math.radians(30.0)
# Of a quadric's mesh along each coordinate: enough for a picture, a fifth of the triangles of its own default.
CELLS = 24
# Pixels along the longer side of the picture in which its border is found.
MOST_PAINTED = 2000


class Measure(NamedTuple):
    """One size of a shape: its name, its value and one standard deviation (None where unknown), in metres or radians."""

    name: str
    value: float
    deviation: float | None
    angle: bool = False
    lower_bound: bool = False


def color(index: int) -> str:
    """The color of object `index` as #rrggbb; grey for -1, no object."""
    return NOISE_COLOR if index < 0 else PALETTE[index % len(PALETTE)]


def rgb(index: int) -> tuple[float, float, float]:
    """The color of object `index` as red, green, blue in 0..1."""
    value = int(color(index)[1:], 16)
    return (value >> 16) / 255, (value >> 8 & 255) / 255, (value & 255) / 255


def name(index: int, shape: Shape) -> str:
    """What object `index` is called in tables and figures."""
    return f"{index} {shape.kind}"


def measures(shape: Shape) -> tuple[Measure, ...]:
    """The sizes a person asks for, with their deviations where the covariance holds them.

    Ends of a body come from its outermost points, not from the fit, so heights and a plane's edges have no deviation.
    """
    body = shape.primitive
    open_end = bool(int(shape.status) & Status.LOWER_BOUND)
    match body:
        case Plane():
            corners = np.asarray(body.corners, float)
            edges = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
            lengths = ((edges[0] + edges[2]) / 2, (edges[1] + edges[3]) / 2)
            named = zip(("length", "width"), sorted(lengths)[::-1], strict=True)
            return tuple(Measure(n, v, None, lower_bound=open_end) for n, v in named)
        case Box():
            deviations = [_deviation(shape, f"size_{i}") for i in (1, 2, 3)]
            seen = np.asarray(body.seen, bool)
            return tuple(
                Measure(f"edge {i + 1}", float(body.size[i]), deviations[i], lower_bound=not seen[i]) for i in range(3)
            )
        case Cylinder():
            return (
                Measure("radius", float(body.radius), _deviation(shape, "radius")),
                Measure("height", float(body.height), None, lower_bound=open_end),
            )
        case Cone():
            low, high = (float(h) for h in np.asarray(body.height))
            slope = math.tan(float(body.half_angle))
            found = [Measure("half-angle", float(body.half_angle), _deviation(shape, "half_angle"), angle=True)]
            if low * slope > 1e-3 * high * slope:
                found.append(Measure("smaller radius", low * slope, None))
            found.append(Measure("base radius", high * slope, None, lower_bound=open_end))
            found.append(Measure("height", high - low, None, lower_bound=open_end))
            return tuple(found)
        case Sphere():
            return (Measure("radius", float(body.radius), _deviation(shape, "radius")),)
    return ()


def measure_text(measure: Measure, *, metric: bool = True) -> str:
    """A size in words: millimetres below a metre, degrees, digits as fine as the deviation deserves.

    Args:
        measure: The size.
        metric: False where lengths are in arbitrary units.
    """
    if measure.angle:
        factor, unit, digits = 180 / math.pi, "°", 1
    elif not metric:
        factor, unit, digits = 1.0, " units", 4
    elif abs(measure.value) < 1:
        factor, unit, digits = 1e3, " mm", 1
    else:
        factor, unit, digits = 1.0, " m", 3
    value, deviation = measure.value * factor, measure.deviation
    bound = "at least " if measure.lower_bound else ""
    if deviation is None:
        return f"{bound}{value:.{digits}f}{unit}"
    deviation *= factor
    if deviation > 0:
        digits = min(max(1 - math.floor(math.log10(deviation)), 0), 6)
    plus_minus = f"{value:.{digits}f} ± {deviation:.{digits}f}"
    return f"{bound}({plus_minus})°" if measure.angle else f"{bound}{plus_minus}{unit}"


def size_text(shape: Shape, *, metric: bool = True) -> str:
    """All sizes of a shape on one line; empty for a shape without any."""
    return ", ".join(f"{m.name} {measure_text(m, metric=metric)}" for m in measures(shape))


def score_text(score: float | None) -> str:
    """A score in words; a dash for a kind that could not be fitted."""
    if score is None or not math.isfinite(score):
        return "–"
    return f"{score:,.0f}" if abs(score) >= 1000 else f"{score:.4g}"


def position(shape: Shape) -> np.ndarray | None:
    """A point (3,) to say where a shape is: the middle of its body; None where unknown."""
    body = shape.primitive
    match body:
        case Plane():
            return np.asarray(body.corners, float).mean(0)
        case Box() | Sphere():
            return np.asarray(body.center, float)
        case Cylinder():
            return np.asarray(body.base, float) + np.asarray(body.axis, float) * float(body.height) / 2
        case Cone():
            return np.asarray(body.apex, float) + np.asarray(body.axis, float) * float(np.mean(np.asarray(body.height)))
    return None


def mesh(body: Primitive | None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a primitive; empty for one that cannot be drawn."""
    if body is None or (getattr(body, "bounds", 0) is None):
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    vertices, faces = body.mesh(CELLS) if isinstance(body, Quadric) else body.mesh()
    return np.asarray(vertices, float), np.asarray(faces)


def upright_frame(up: Any) -> np.ndarray:
    """Rotation (3, 3) from the camera's frame to one for looking at: x right, y away from the camera, z up."""
    vertical = np.asarray(up, float) / np.linalg.norm(np.asarray(up, float))
    # A camera that looks straight up or down has no forward on the ground; then the image's own up serves.
    forward = np.array([0.0, 0.0, 1.0]) if abs(vertical[2]) < 0.99 else np.array([0.0, -1.0, 0.0])
    away = forward - forward @ vertical * vertical
    away /= np.linalg.norm(away)
    return np.stack([np.cross(away, vertical), away, vertical])


def project(points: Any, rig: Rig) -> np.ndarray:
    """Columns and rows (N, 2) in the left image; not a number for what is not in front of the camera."""
    points = np.asarray(points, float)
    depth = np.where(points[:, 2:] > 1e-9, points[:, 2:], np.nan)
    return points[:, :2] / depth * np.asarray(rig.focal_px) + np.asarray(rig.center_px)


def outline(body: Primitive | None, rig: Rig) -> np.ndarray:
    """The visible edges of a primitive in the left image, as segments (S, 2, 2) in pixels.

    Drawn are edges between a face turned towards the camera and one turned away, free edges, and sharp edges of faces
    turned towards the camera; of a quadric, which may fold many times, the border of all it covers. Parts behind the camera are
    left out.
    """
    vertices, faces = mesh(body)
    if len(faces) == 0:
        return np.zeros((0, 2, 2))
    if isinstance(body, Quadric):
        return _border(project(vertices, rig)[faces])
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    towards = np.sum(normals * corners[:, 0], 1) < 0  # the camera is the origin
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)

    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((sides[:, 1], sides[:, 0]))
    sides, owner = sides[order], owner[order]
    first = np.flatnonzero(np.r_[True, (sides[1:] != sides[:-1]).any(1)])
    shared = np.diff(np.r_[first, len(sides)]) == 2
    one = owner[first]
    other = owner[np.where(shared, first + 1, first)]
    silhouette = towards[one] != towards[other]
    sharp = (np.sum(normals[one] * normals[other], 1) < math.cos(SHARP)) & (towards[one] | towards[other])
    drawn = sides[first[~shared | silhouette | sharp]]
    segments = project(vertices, rig)[drawn]
    return segments[np.isfinite(segments).all((1, 2))]


def _border(triangles: np.ndarray) -> np.ndarray:
    """The border (S, 2, 2) of what triangles (F, 3, 2) cover together."""
    triangles = triangles[np.isfinite(triangles).all((1, 2))]
    if not len(triangles):
        return np.zeros((0, 2, 2))
    # Painted small enough that even what comes close to the camera fits.
    low, high = triangles.min((0, 1)), triangles.max((0, 1))
    step = max(1.0, float((high - low).max()) / MOST_PAINTED)
    painted = np.zeros(np.ceil((high - low) / step).astype(int)[::-1] + 3, np.uint8)
    for corners in np.round((triangles - low) / step).astype(np.int32) + 1:
        cv2.fillConvexPoly(painted, corners, 1)
    borders, _ = cv2.findContours(painted, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    smooth = [cv2.approxPolyDP(border, 1.0, True)[:, 0] for border in borders]
    segments = [np.stack([border, np.roll(border, -1, axis=0)], 1) for border in smooth]
    return low + (np.concatenate(segments) - 1) * step


def silhouette(body: Primitive | None, rig: Rig) -> np.ndarray:
    """The convex hull (H, 2) of a primitive in the left image, in pixels; empty where it is not wholly in front."""
    vertices, faces = mesh(body)
    points = project(vertices, rig)
    if len(faces) == 0 or not np.isfinite(points).all():
        return np.zeros((0, 2))
    points = np.unique(points.round(2), axis=0)

    def chain(ordered: np.ndarray) -> list[np.ndarray]:
        hull: list[np.ndarray] = []
        for point in ordered:
            while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0:
                hull.pop()
            hull.append(point)
        return hull[:-1]

    return np.array(chain(points) + chain(points[::-1])).reshape(-1, 2)


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _deviation(shape: Shape, parameter: str) -> float | None:
    """One standard deviation of a named parameter; None where the covariance does not hold it."""
    if shape.primitive is None:
        return None
    names = shape.primitive.parameter_names
    covariance = np.asarray(shape.covariance, float)
    if covariance.shape != (len(names), len(names)):
        return None
    variance = covariance[names.index(parameter), names.index(parameter)]
    return math.sqrt(variance) if 0 <= variance < math.inf else None
