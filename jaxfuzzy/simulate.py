"""Simulated clouds: what a stereo camera sees of primitives of known size; for tests, benchmarks and notebooks.

Only the side that faces the camera is there, found by casting rays. Noise moves a point along its viewing ray, with a
deviation that grows with the square of the depth; silhouettes leave flying pixels between object and background; wrong
matches leave outliers anywhere in the box around the object. The camera stands at the origin of an upright frame (y up,
z away from the camera), so a cloud needs no turning. NumPy only; the same seed gives the same cloud.
"""

from typing import Any

import numpy as np

from jaxfuzzy.arrays import record, static
from jaxfuzzy.bodies import Body, body_of
from jaxfuzzy.primitives import KINDS, Primitive

OTHERS = ("torus", "ellipsoid", "saddle", "blob")

# Wrong matches fill the box around the object, padded by this share of its longest side.
PADDING = 0.25
# Of all visible points, a box face that holds fewer than the first share cannot be found, more than the second must be.
HARDLY_SEEN, CLEARLY_SEEN = 0.02, 0.08


@record
class Truth:
    """What an object really is.

    Attributes:
        primitive: The primitive in the cloud's frame, None for what is none of the five kinds.
        made: What was simulated.
        answers: The names that are right; a box of which hardly more than one face was seen may be called a plane.
    """

    primitive: Primitive | None
    made: str = static()
    answers: tuple[str, ...] = static()


@record
class Simulated:
    """A simulated cloud.

    Attributes:
        points: The points (N, 3) in metres, upright, y up.
        labels: The object of each point (N,), -1 for flying pixels and outliers.
        truths: What each object is, in the order of the labels.
        camera: Where the points were seen from (3,).
        depth_std: Standard deviation of each point along its viewing ray (N,).
    """

    points: Any
    labels: Any
    truths: tuple[Truth, ...]
    camera: Any
    depth_std: Any


def simulate_object(
    kind: str,
    seed: int,
    *,
    outliers: float = 0.1,
    flying: float = 0.02,
    depth_std: float = 0.001,
    points: tuple[int, int] = (400, 1600),
    lid: str = "none",
    elevation: tuple[float, float] = (-5.0, 10.0),
    tilt: float = 0.0,
    radius: tuple[float, float] = (0.04, 0.15),
    distance: tuple[float, float] = (0.9, 1.5),
) -> Simulated:
    """One object as a stereo camera sees it.

    Args:
        kind: "plane", "box", "cylinder", "cone", "sphere", or none of these: "torus", "ellipsoid", "saddle", "blob".
        seed: Everything random follows from it.
        outliers: Share of all points that are uniform outliers.
        flying: Share of all points that are flying pixels at the silhouette.
        depth_std: Deviation of the depth of a point one metre away, metres; it grows with the square of the depth.
        points: Fewest and most points.
        lid: Of cylinders and cones: "none" shows the side alone, "closed" a top, "open" the inside over the rim.
        elevation: How far above the object the camera stands, from and to, degrees.
        tilt: How far the object leans from the vertical, degrees, in a random direction.
        radius: Smallest and largest radius (half edge of boxes and planes), metres.
        distance: Nearest and farthest distance from the camera, metres.

    Returns:
        The cloud, its object labelled 0.

    Raises:
        ValueError: The kind or the lid is none of those above.
    """
    if kind not in KINDS + OTHERS:
        raise ValueError(f"kind must be one of {', '.join(map(repr, KINDS + OTHERS))}, got {kind!r}")
    if lid not in ("none", "closed", "open"):
        raise ValueError(f"lid must be one of 'none', 'closed', 'open', got {lid!r}")
    rng = np.random.default_rng([seed, 1, *map(ord, kind)])
    body = body_of(kind, rng, rng.uniform(*radius), lid)
    down, away = np.deg2rad(rng.uniform(*elevation)), rng.uniform(*distance)
    aside = np.deg2rad(rng.uniform(-15, 15))
    center = away * np.array([np.sin(aside) * np.cos(down), -np.sin(down), np.cos(aside) * np.cos(down)])
    body.rotation = _leaning(np.deg2rad(tilt), rng) @ _yaw(_facing(kind, rng) - aside)
    body.origin = center - body.turn(np.array([0.0, body.height / 2, 0.0]))
    count = int(rng.integers(points[0], points[1] + 1))
    return _expose([body], [round(count * (1 - outliers - flying))], rng, outliers, flying, depth_std, 0.0)


def simulate_scene(
    n_objects: int,
    seed: int,
    *,
    outliers: float = 0.1,
    flying: float = 0.02,
    depth_std: float = 0.001,
    points: tuple[int, int] = (150, 1800),
    gap: float = 0.06,
    spacing: float | None = None,
    touching: bool = False,
    stripes: float = 0.0,
    kinds: tuple[str, ...] = ("box", "cylinder", "cone", "sphere"),
    lid: str = "closed",
    elevation: tuple[float, float] = (0.0, 25.0),
) -> Simulated:
    """Objects standing on a table (which is not among the points), with the occlusions between them.

    Args:
        n_objects: How many.
        seed: Everything random follows from it.
        outliers: Share of all points that are uniform outliers, anywhere in the scene.
        flying: Share of all points that are flying pixels.
        depth_std: Deviation of the depth of a point one metre away, metres.
        points: Fewest and most points an object.
        gap: Least free distance between two footprints, metres.
        spacing: Distance between neighbouring centres, metres, in place of `gap`; objects are made small enough for it.
        touching: The second object touches the first, the fourth the third, and so on.
        stripes: Share of the surface that is missing in upright stripes 8 to 16 cm apart.
        kinds: Kinds to draw from.
        lid: Of cylinders and cones: "none", "closed" or "open".
        elevation: How far above the table's middle the camera stands, from and to, degrees.

    Returns:
        The cloud, with labels 0 ... n_objects - 1.

    Raises:
        RuntimeError: No place was found for that many objects so far apart.
    """
    rng = np.random.default_rng([seed, 2, n_objects])
    for attempt in range(400):
        largest = 0.11 if spacing is None else 0.36 * spacing
        largest *= 0.6 if n_objects > 3 and spacing is None else 1.0
        bodies = [
            body_of(str(rng.choice(kinds)), rng, rng.uniform(0.04, max(largest * 0.99**attempt, 0.045)), lid)
            for _ in range(n_objects)
        ]
        places = _layout([b.footprint for b in bodies], rng, gap, spacing, touching)
        if places is None:
            continue
        table = -1.2 * np.tan(np.deg2rad(rng.uniform(*elevation))) - (0.1 if elevation[0] < 5 else 0.0)
        for body, (x, z) in zip(bodies, places, strict=True):
            body.rotation, body.origin = _yaw(rng.uniform(0, 2 * np.pi)), np.array([x, table, z])
        counts = [int(rng.integers(points[0], points[1] + 1)) for _ in bodies]
        if _hidden(bodies, rng) < 0.5:
            return _expose(bodies, counts, rng, outliers, flying, depth_std, stripes)
    raise RuntimeError(f"no place found for {n_objects} objects; lower gap or spacing")


def _layout(
    footprints: list[float], rng: np.random.Generator, gap: float, spacing: float | None, touching: bool
) -> list[tuple[float, float]] | None:
    """Places (x, z) on the table whose footprints, circles, keep their distance; None where none was found."""
    places: list[tuple[float, float]] = []
    for i, reach in enumerate(footprints):
        for _ in range(60):
            if touching and i % 2:
                heading, apart = rng.uniform(0, 2 * np.pi), footprints[i - 1] + reach
            elif spacing is not None and i:
                heading, apart = rng.uniform(0, 2 * np.pi), spacing
            else:
                heading, apart = 0.0, 0.0
            if apart:
                x, z = places[i - 1][0] + apart * np.cos(heading), places[i - 1][1] + apart * np.sin(heading)
            else:
                z = rng.uniform(0.9, 1.5)
                x = rng.uniform(-0.5, 0.5) * z
            if not (0.85 <= z <= 1.6 and abs(x) <= 0.6 * z):
                continue
            free = [
                np.hypot(x - a, z - b) >= (spacing * 0.999 if spacing is not None else reach + other + gap)
                for j, ((a, b), other) in enumerate(zip(places, footprints, strict=False))
                if not (touching and i % 2 and j == i - 1)
            ]
            if all(free):
                places.append((x, z))
                break
        else:
            return None
    return places


def _hidden(bodies: list[Body], rng: np.random.Generator) -> float:
    """The largest share of an object's visible side that other objects hide."""
    worst = 0.0
    for body in bodies:
        rays = _rays(body, 200, rng)
        own = body.hit(rays)[0]
        rest = [other.hit(rays)[0] for other in bodies if other is not body]
        first = np.min(rest, axis=0) if rest else np.full(len(rays), np.inf)
        seen = np.isfinite(own)
        worst = max(worst, float(np.mean(first[seen] < own[seen])) if seen.any() else 1.0)
    return worst


def _expose(
    bodies: list[Body],
    counts: list[int],
    rng: np.random.Generator,
    outliers: float,
    flying: float,
    depth_std: float,
    stripes: float,
) -> Simulated:
    """The picture: first hits along random rays, depth noise, flying pixels, outliers."""
    clean, labels, truths = [], [], []
    period, phase = rng.uniform(0.08, 0.16), rng.uniform(0, 1)
    for index, (body, count) in enumerate(zip(bodies, counts, strict=True)):
        hits, parts = np.empty((0, 3)), np.empty(0, int)
        while len(hits) < count:
            rays = _rays(body, 4 * count, rng)
            depth, part = body.hit(rays)
            for other in bodies:
                if other is not body:
                    depth = np.where(other.hit(rays)[0] < depth, np.inf, depth)
            seen = np.isfinite(depth)
            place = rays[seen] * depth[seen, None]
            kept = (place[:, 0] / period + phase) % 1.0 >= stripes
            hits = np.concatenate([hits, place[kept]])
            parts = np.concatenate([parts, part[seen][kept]])
        hits, parts = hits[:count], parts[:count]
        clean.append(hits)
        labels.append(np.full(count, index))
        truths.append(_truth(body, parts))
    surface, label = np.concatenate(clean), np.concatenate(labels)
    total = len(surface) / max(1 - outliers - flying, 1e-6)
    strays = [
        _flying(bodies, surface, label, round(flying * total), rng),
        _anywhere(surface, round(outliers * total), rng),
    ]
    points = np.concatenate([surface, *strays])
    labels_all = np.concatenate([label, np.full(sum(map(len, strays)), -1)])
    deviation = depth_std * points[:, 2] * np.linalg.norm(points, axis=1)
    direction = points / np.linalg.norm(points, axis=1, keepdims=True)
    noise = rng.normal(size=len(points)) * deviation * (labels_all >= 0)
    points = points + direction * noise[:, None]
    order = rng.permutation(len(points))
    return Simulated(
        points=points[order],
        labels=labels_all[order],
        truths=tuple(truths),
        camera=np.zeros(3),
        depth_std=(depth_std * points[:, 2] * np.linalg.norm(points, axis=1))[order],
    )


def _rays(body: Body, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rays (count, 3) of unit length, spread over the picture window that holds the body."""
    middle = body.place(np.array([0.0, body.height / 2, 0.0]))
    away = np.linalg.norm(middle)
    forward = middle / away
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    half = 1.05 * body.reach / np.sqrt(max(float(away) ** 2 - body.reach**2, 1e-6))
    across = rng.uniform(-half, half, (count, 2))
    rays = forward + across[:, :1] * right + across[:, 1:] * np.cross(forward, right)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _flying(
    bodies: list[Body], surface: np.ndarray, label: np.ndarray, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Points between a silhouette and the background behind it."""
    if count == 0:
        return np.empty((0, 3))
    direction = surface / np.linalg.norm(surface, axis=1, keepdims=True)
    edge = np.zeros(len(surface), bool)
    for index, body in enumerate(bodies):
        own = label == index
        beside = direction[own] + rng.normal(size=(own.sum(), 3)) * 0.02 * body.reach
        edge[own] = ~np.isfinite(body.hit(beside / np.linalg.norm(beside, axis=1, keepdims=True))[0])
    chosen = rng.choice(np.flatnonzero(edge) if edge.any() else len(surface), count)
    return surface[chosen] + direction[chosen] * rng.uniform(0.01, 0.3, (count, 1))


def _anywhere(surface: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    low, high = surface.min(0), surface.max(0)
    pad = PADDING * (high - low).max()
    return rng.uniform(low - pad, high + pad, (count, 3))


def _truth(body: Body, parts: np.ndarray) -> Truth:
    answers: tuple[str, ...] = (body.made,) if body.made in KINDS else ("quadric", "unknown")
    if body.made == "box":
        shares: np.ndarray = np.sort(np.bincount(parts, minlength=6) / max(parts.size, 1))[::-1]
        if shares[1] < HARDLY_SEEN:
            answers = ("plane",)
        elif shares[1] < CLEARLY_SEEN:
            answers = ("plane", "box")
    return Truth(primitive=body.describe(body), made=body.made, answers=answers)


def _yaw(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _leaning(angle: float, rng: np.random.Generator) -> np.ndarray:
    heading = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return _yaw(heading) @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]) @ _yaw(-heading)


def _facing(kind: str, rng: np.random.Generator) -> float:
    """Yaw: patches and saddles show their face, everything else any side."""
    return rng.uniform(-0.9, 0.9) if kind in ("plane", "saddle") else rng.uniform(0, 2 * np.pi)
