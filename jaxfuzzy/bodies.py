"""Bodies that viewing rays can hit: the surfaces behind the simulated clouds, each in its own upright frame (y up).

A body knows where a ray meets it first and which part of it was met (a face of a box, the side or the inside of
a vessel).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxfuzzy import primitives
from jaxfuzzy.primitives import Primitive

# Record fields are typed as JAX arrays; known values stay NumPy's, so that simulating never wakes JAX.
_known: Callable[[Any], Any] = np.asarray

Cast = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Body:
    """A surface that rays can hit, in its own upright frame, and its place in the cloud's frame."""

    def __init__(
        self, made: str, cast: Cast, reach: float, height: float, footprint: float, describe: Callable[..., Any]
    ):
        self.made, self.cast, self.reach, self.height, self.footprint = made, cast, reach, height, footprint
        self.describe = describe
        self.rotation, self.origin = np.eye(3), np.zeros(3)

    def hit(self, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance along each ray from the camera at the origin (inf where it misses) and the part that was hit."""
        return self.cast(np.broadcast_to(-self.rotation @ self.origin, rays.shape), rays @ self.rotation.T)

    def place(self, local: np.ndarray) -> Any:
        """Points of the body's own frame in the cloud's frame."""
        return local @ self.rotation + self.origin

    def turn(self, local: np.ndarray) -> Any:
        """Directions of the body's own frame in the cloud's frame."""
        return local @ self.rotation


def body_of(kind: str, rng: np.random.Generator, size: float, lid: str) -> Body:
    """A body of about the given radius, other proportions random."""
    if kind == "box":
        half = size * np.array([1.0, rng.uniform(0.8, 1.6), rng.uniform(0.5, 1.0)])
        return box(half)
    if kind == "plane":
        return _plane(size * np.array([1.0, rng.uniform(0.6, 1.0)]), rng.uniform(-0.7, 0.7))
    if kind == "sphere":
        return ellipsoid("sphere", np.full(3, size))
    if kind == "cylinder":
        return frustum("cylinder", size, size, size * rng.uniform(1.2, 4.0), lid)
    if kind == "cone":
        height, cut = size * rng.uniform(1.3, 3.0), rng.uniform(0.0, 0.5)
        ends = (size, cut * size) if rng.uniform() < 0.7 else (cut * size, size)
        return frustum("cone", *ends, height, lid)
    if kind == "ellipsoid":
        return ellipsoid("ellipsoid", size * rng.permutation([rng.uniform(0.5, 0.65), rng.uniform(0.8, 1.0), 1.5]))
    implicit = {"torus": _torus, "saddle": _saddle, "blob": _blob}[kind]
    return implicit(size, rng)


def _roots(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Both roots (2, N) of a t² + 2 b t + c = 0 in rising order, inf where there is none."""
    inside = b * b - a * c
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(np.maximum(inside, 0.0))
        both = np.sort(np.stack([(-b - root) / a, (-b + root) / a]), axis=0)
    return np.where(inside >= 0, both, np.inf)


def frustum(made: str, low: float, high: float, height: float, lid: str) -> Body:
    """Surface of revolution about y with a straight side: radius `low` at y = 0, `high` at y = height."""
    slope = (high - low) / height

    def cast(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rim = low + slope * o[:, 1]
        t = _roots(
            d[:, 0] ** 2 + d[:, 2] ** 2 - (slope * d[:, 1]) ** 2,
            o[:, 0] * d[:, 0] + o[:, 2] * d[:, 2] - rim * slope * d[:, 1],
            o[:, 0] ** 2 + o[:, 2] ** 2 - rim**2,
        )
        best, part = np.full(len(o), np.inf), np.zeros(len(o), int)
        for distance in t:
            with np.errstate(invalid="ignore"):
                at = o + distance[:, None] * d
                outside = at[:, 0] * d[:, 0] + at[:, 2] * d[:, 2] - (low + slope * at[:, 1]) * slope * d[:, 1] < 0
                hit = (at[:, 1] >= 0) & (at[:, 1] <= height) & (distance > 0) & (low + slope * at[:, 1] >= 0)
            hit &= outside | (lid == "open")
            nearer = hit & (distance < best)
            best, part = np.where(nearer, distance, best), np.where(nearer, np.where(outside, 0, 1), part)
        for level, radius, there in ((height, high, lid == "closed"), (0.0, low, lid != "none")):
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = (level - o[:, 1]) / d[:, 1]
                at = o + distance[:, None] * d
                nearer = there & (distance > 0) & (at[:, 0] ** 2 + at[:, 2] ** 2 <= radius**2) & (distance < best)
            best, part = np.where(nearer, distance, best), np.where(nearer, 2, part)
        return best, part

    def describe(body: Body) -> Primitive:
        if made == "cylinder":
            base = body.place(np.zeros(3))
            return primitives.Cylinder(
                base=base, axis=body.turn(np.array([0.0, 1, 0])), radius=_known(low), height=_known(height)
            )
        tip = -low / slope
        axis = np.array([0.0, 1.0 if slope > 0 else -1.0, 0.0])
        ends = np.sort(np.abs(np.array([0.0, height]) - tip))
        return primitives.Cone(
            apex=body.place(np.array([0.0, tip, 0.0])),
            axis=body.turn(axis),
            half_angle=_known(np.arctan(abs(slope))),
            height=_known(ends),
        )

    widest = max(low, high)
    return Body(made, cast, np.hypot(widest, height / 2), height, widest, describe)


def box(half: np.ndarray) -> Body:
    """A box of half edges `half` (3,), standing on the origin."""
    height = 2 * half[1]

    def cast(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(divide="ignore", invalid="ignore"):
            near = (np.array([0, half[1], 0]) - np.sign(d) * half - o) / d
            far = (np.array([0, half[1], 0]) + np.sign(d) * half - o) / d
        entry, leave, part = near.max(1), far.min(1), near.argmax(1)
        hit = (entry <= leave) & (entry > 0)
        return np.where(hit, entry, np.inf), part

    def describe(body: Body) -> Primitive:
        center = body.place(np.array([0.0, half[1], 0.0]))
        return primitives.Box(
            center=center, size=_known(2 * half), axes=_known(body.rotation), seen=_known(np.zeros(3, bool))
        )

    return Body("box", cast, float(np.linalg.norm(half)), height, float(np.hypot(half[0], half[2])), describe)


def _plane(half: np.ndarray, pitch: float) -> Body:
    """A rectangular patch about the height of its half edges, facing -z and pitched."""
    normal = np.array([0.0, np.sin(pitch), -np.cos(pitch)])
    upward = np.array([0.0, np.cos(pitch), np.sin(pitch)])
    middle = np.array([0.0, half[1], 0.0])

    def cast(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((middle - o) @ normal) / (d @ normal)
            at = o + t[:, None] * d - middle
            hit = (np.abs(at[:, 0]) <= half[0]) & (np.abs(at @ upward) <= half[1]) & (t > 0)
        return np.where(hit, t, np.inf), np.zeros(len(o), int)

    def describe(body: Body) -> Primitive:
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        corners = middle + signs[:, :1] * np.array([1.0, 0, 0]) + signs[:, 1:] * upward
        return primitives.Plane(point=body.place(middle), normal=body.turn(normal), corners=body.place(corners))

    return Body("plane", cast, float(np.linalg.norm(half)), 2 * half[1], half[0], describe)


def ellipsoid(made: str, half: np.ndarray) -> Body:
    """An ellipsoid of half axes `half` (3,), standing on the origin; `made` names it."""
    middle = np.array([0.0, half[1], 0.0])

    def cast(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        p, q = (o - middle) / half, d / half
        t = _roots((q * q).sum(1), (p * q).sum(1), (p * p).sum(1) - 1)[0]
        return t, np.zeros(len(o), int)

    def describe(body: Body) -> Primitive | None:
        return primitives.Sphere(center=body.place(middle), radius=_known(half[0])) if made == "sphere" else None

    return Body(made, cast, float(half.max()), 2 * half[1], float(max(half[0], half[2])), describe)


def _implicit(made: str, inside: Callable[[np.ndarray], np.ndarray], reach: float, height: float) -> Body:
    """The surface where `inside` changes sign, found by marching along the ray and halving the step that crosses it."""
    middle = np.array([0.0, height / 2, 0.0])

    def cast(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        near, far = _roots(np.ones(len(o)), ((o - middle) * d).sum(1), ((o - middle) ** 2).sum(1) - reach**2)
        found = np.isfinite(near)
        near, far = np.where(found, near, 0.0), np.where(found, far, 1.0)
        steps = near + np.linspace(0, 1, 160)[:, None] * (far - near)
        value = inside(o + steps[..., None] * d - middle)
        crossed = (value[:-1] < 0) != (value[1:] < 0)
        first = crossed.argmax(0)
        found &= crossed.any(0)
        each = np.arange(len(o))
        a, b, sign = steps[first, each], steps[first + 1, each], value[first, each] < 0
        for _ in range(30):
            c = (a + b) / 2
            same = (inside(o + c[:, None] * d - middle) < 0) == sign
            a, b = np.where(same, c, a), np.where(same, b, c)
        return np.where(found, a, np.inf), np.zeros(len(o), int)

    return Body(made, cast, reach, height, reach, lambda body: None)


def _torus(size: float, rng: np.random.Generator) -> Body:
    tube = size * rng.uniform(0.25, 0.4)
    ring, lean = size - tube, rng.uniform(0.3, 1.2)
    across = np.array([0.0, np.cos(lean), -np.sin(lean)])

    def inside(p: np.ndarray) -> np.ndarray:
        along = p @ across
        return np.hypot(np.sqrt(np.maximum((p * p).sum(-1) - along**2, 0)) - ring, along) - tube

    return _implicit("torus", inside, size * 1.01, 2 * size)


def _saddle(size: float, rng: np.random.Generator) -> Body:
    bend, turn = rng.uniform(0.6, 1.0) / size, rng.uniform(0, np.pi)

    def inside(p: np.ndarray) -> np.ndarray:
        a, b = np.cos(turn) * p[..., 0] + np.sin(turn) * p[..., 1], np.cos(turn) * p[..., 1] - np.sin(turn) * p[..., 0]
        return p[..., 2] - bend * (a * a - b * b)

    return _implicit("saddle", inside, size, 2 * size)


def _blob(size: float, rng: np.random.Generator) -> Body:
    waves = rng.normal(size=(6, 3)) * 2.2
    phases, heights = rng.uniform(0, 2 * np.pi, 6), rng.uniform(0.08, 0.16, 6)

    def inside(p: np.ndarray) -> np.ndarray:
        away = np.linalg.norm(p, axis=-1)
        toward = p / np.maximum(away, 1e-9)[..., None]
        return away - 0.75 * size * (1 + (heights * np.sin(toward @ waves.T + phases)).sum(-1))

    return _implicit("blob", inside, size * 1.5, 2 * size)
