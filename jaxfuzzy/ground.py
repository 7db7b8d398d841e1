"""The supporting plane, the upright frame that stands on it, and what is neither table nor object: walls and background."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, ArrayLike, Bool, Float, Int, lengths, on_device, record
from jaxfuzzy.linalg import tangents
from jaxfuzzy.planes import (
    POINT_DELTA,
    Candidate,
    Prior,
    View,
    deviation_across,
    fit_plane,
    noise_of,
    prior_of,
    seen_at,
    view_of,
)
from jaxfuzzy.primitives import Plane
from jaxfuzzy.status import Status

# A plane whose standard deviation is larger than expected by this factor is called a slab.
SLAB = 1.3
# A plane that holds less than the first share of the view is believed to tell of no more than so many times the deviation expected:
# what bends or is cluttered has larger residuals. On photographs, noisy and compressed ones too, such planes told of 2.0 to 4.8
# times as much where against ground truth it was 1.0 to 2.0; tables that fill the view tell it right.
LITTLE, BELIEVED = 0.03, 2.0
# Points nearer to a plane than so many standard deviations are not told from it.
ABOVE = 3.0
# A wall has at most this share of the points behind it, at least that share before it, and spans at least that much of the view.
BEHIND, AHEAD, SPAN = 0.1, 0.01, 0.4
MOST_WALLS = 4
# The span of a wall is that of a fair share of its points: so many of all, and less than twice as many.
LOOKED_AT = 16_384
# Through so few points there is always a plane.
FEWEST = 10
# A supporting plane must hold the first share of the view, net of what is seen below it; a wall, of which other things are asked
# too, the second.
LEAST_SUPPORT, LEAST_OF_WALL = 0.004, 0.001
# Standard deviations tried where none is given, as shares of the scene's spread.
UNKNOWN_NOISE = (0.002, 0.004, 0.008, 0.016, 0.032)


@record
class Ground:
    """The supporting plane and how well it is founded.

    Attributes:
        plane: The plane, its normal pointing up; None where there is none.
        inliers: The points on it.
        depth_std: Standard deviation of each point along its viewing ray, as the plane's own residual tells it, though at most
            twice the one given where little of the plane is seen; without a plane the one given, or None.
        spread: The deviation told by the plane over the one given; 1 where none was given.
        support: Share of the view that lies on it, net of what is seen below it.
        status: NO_GROUND, GROUND_SLAB or 0.
    """

    plane: Plane | None
    inliers: Bool[Array, " N"]
    depth_std: Float[Array, " N"] | None
    spread: Float[Array, ""]
    support: Float[Array, ""]
    status: Int[Array, ""]


@record
class Foreground:
    """What stands on the ground.

    Attributes:
        mask: The points of objects, or at least of neither ground nor wall.
        walls: The walls that were removed, the rearmost first.
        cut: Height in metres, of the median point, up to which points were taken for ground.
        ground: These points, and what lies below.
    """

    mask: Bool[Array, " N"]
    walls: tuple[Plane, ...]
    cut: Float[Array, ""]
    ground: Bool[Array, " N"]


def find_ground(
    points: ArrayLike,
    *,
    up: ArrayLike = (0.0, 1.0, 0.0),
    noise_distance: Literal["auto"] | ArrayLike = "auto",
    weights: ArrayLike | None = None,
    depth_std: ArrayLike | None = None,
    camera: ArrayLike | None = (0.0, 0.0, 0.0),
    max_tilt: float = np.pi * 50 / 180,
) -> Plane | None:
    """The plane that the objects stand on; None where there is none. `fit_ground` tells more.

    Args:
        points: Points (N, 3) in metres.
        up: Roughly the vertical direction; its sign may be either.
        noise_distance: In metres, for all points or for each (N,); "auto" takes 2.5 standard deviations.
        weights: Weights (N,).
        depth_std: Standard deviation of each point along its viewing ray (N,); found from the scene where not given.
        camera: Where the points were seen from (3,), or None.
        max_tilt: Largest angle in radians between the plane's normal and `up`: small where gravity is known well.

    Returns:
        The plane, its normal towards the camera where that is known, and the corners of the patch that was seen.

    Raises:
        ValueError: An argument of wrong shape or value.
    """
    return fit_ground(
        points,
        up=up,
        noise_distance=noise_distance,
        weights=weights,
        depth_std=depth_std,
        camera=camera,
        max_tilt=max_tilt,
    ).plane


def fit_ground(
    points: ArrayLike,
    *,
    up: ArrayLike = (0.0, 1.0, 0.0),
    noise_distance: Literal["auto"] | ArrayLike = "auto",
    weights: ArrayLike | None = None,
    depth_std: ArrayLike | None = None,
    camera: ArrayLike | None = (0.0, 0.0, 0.0),
    max_tilt: float = np.pi * 50 / 180,
) -> Ground:
    """The supporting plane with its inliers, its own measure of the noise and a status. Arguments as for `find_ground`."""
    cloud = checks.places(points)
    dtype = cloud.dtype
    x = np.asarray(cloud)
    mass = checks.weights(weights, len(x))
    w = np.ones(len(x), dtype) if mass is None else np.asarray(mass, dtype)
    axis = checks.direction(up, "up")
    checks.number(max_tilt, "max_tilt", above=0.0)
    eye = None if camera is None else checks.position(camera, "camera").astype(x.dtype)
    std, known = _deviation(x, w, noise_distance, depth_std, eye)
    ray, floor = noise_of(x, std, eye if isinstance(noise_distance, str) else None)
    view = view_of(x, w, ray, floor, axis, eye)
    prior = prior_of(axis, (0.0, max_tilt / 2, max_tilt), eye, dtype)
    best, scale = _fit(view, prior, (1.0, 2.0) if known else UNKNOWN_NOISE, LEAST_SUPPORT)
    normal, offset, spread, inliers = np.zeros(3, dtype), 0.0, 0.0, np.zeros(len(x), bool)
    if best is not None:
        # An exact plane has no spread; rounding is the least there is.
        normal, offset = np.asarray(best.normal), float(best.offset)
        spread = max(scale * float(best.spread), float(np.finfo(dtype).eps))
        residual = (x @ normal - offset) / deviation_across(normal, ray, floor)
        inliers = (np.abs(residual) <= POINT_DELTA * spread) & (w > 0)
    if best is None or inliers.sum() < FEWEST:
        none = on_device(np.zeros(len(x), bool))
        return Ground(
            None,
            none,
            jax.device_put(np.array(std)) if known else None,
            on_device(1.0, dtype),
            on_device(0.0, dtype),
            on_device(int(Status.NO_GROUND), np.int32),
        )
    noise = min(spread, BELIEVED) if known and float(best.support) < LITTLE else spread
    return Ground(
        _rectangle(x[inliers], normal, offset),
        jax.device_put(inliers),
        jax.device_put(std * noise),
        on_device(spread if known else 1.0, dtype),
        best.support,
        on_device(int(Status.GROUND_SLAB) if known and spread > SLAB else 0, np.int32),
    )


def foreground(
    points: ArrayLike,
    ground: Ground,
    *,
    up: ArrayLike = (0.0, 1.0, 0.0),
    weights: ArrayLike | None = None,
    camera: ArrayLike | None = (0.0, 0.0, 0.0),
) -> Foreground:
    """The points that stand on the ground, without the ground and without the walls behind.

    A point is above the ground when its height is more than three standard deviations of that height. A wall is a plane
    that stands, leaning by 40 degrees at most, that ends the view (nothing is seen behind it, neither objects nor ground, and it
    is not seen edge on) and that spans two fifths of the view in width or height; a box on the table has table behind it. Walls
    go, with what is behind them.

    Args:
        points: Points (N, 3) in metres.
        ground: What `fit_ground` gave for them; where it found no plane, only walls are removed.
        up: Roughly the vertical direction, used where there is no plane.
        weights: Weights (N,).
        camera: Where the points were seen from (3,), or None.
    """
    cloud = checks.places(points)
    x = np.asarray(cloud)
    mass = checks.weights(weights, len(x))
    kept = np.ones(len(x), bool) if mass is None else np.asarray(mass) > 0
    eye = None if camera is None else checks.position(camera, "camera").astype(x.dtype)
    std, known = _deviation(x, kept, "auto", ground.depth_std, eye)
    ray, floor = noise_of(x, std, eye)
    cut, table, flat = on_device(0.0, cloud.dtype), np.asarray(ground.inliers), np.zeros(len(x), bool)
    axis = checks.direction(up, "up")
    if ground.plane is not None:
        axis = np.asarray(ground.plane.normal)
        height = (x - np.asarray(ground.plane.point)) @ axis
        least = ABOVE * deviation_across(axis, ray, floor)
        flat = height <= least
        kept &= ~flat
        cut = on_device(np.median(least), cloud.dtype)
    prior = prior_of(axis, (np.pi / 2, np.pi / 9, np.pi * 2 / 9), eye, cloud.dtype, ends_view=True)
    walls: list[Plane] = []
    standing = kept.copy()
    while len(walls) < MOST_WALLS and kept.any():
        view = view_of(x, kept.astype(x.dtype), ray, floor, axis, eye)
        wall, scale = _fit(view, prior, (1.0, 2.0) if known else UNKNOWN_NOISE, LEAST_OF_WALL)
        if wall is None:
            break
        normal, offset = np.asarray(wall.normal), float(wall.offset)
        residual = (x @ normal - offset) / deviation_across(normal, ray, floor) / max(scale * float(wall.spread), 1.0)
        on, behind, ahead = kept & (np.abs(residual) <= ABOVE), residual < -ABOVE, kept & (residual > ABOVE)
        ends_view = (behind & standing).sum() <= BEHIND * standing.sum() and (
            behind & table
        ).sum() <= BEHIND * table.sum()
        if not ends_view or ahead.sum() < AHEAD * standing.sum() or _span(x, standing, on, axis, eye) < SPAN:
            break
        walls.append(_rectangle(x[on], normal, offset))
        standing &= residual >= -ABOVE
        kept = ahead
    return Foreground(jax.device_put(kept), tuple(walls), cut, jax.device_put(flat))


def upright(points: Float[ArrayLike, "N 3"], ground: Plane) -> tuple[Array, Array, Array]:
    """Turns points into the frame that stands on the ground: y is the height above it, z leads away as it did before.

    Args:
        points: Points (N, 3).
        ground: The supporting plane, its normal up.

    Returns:
        The points turned (N, 3), the rotation (3, 3) and the origin (3,): turned = rotation @ (point - origin).
    """
    cloud = checks.places(points)
    checks.kind(ground, "ground", Plane)
    rotation = upright_rotation(ground.normal).astype(cloud.dtype)
    origin = ground.point.astype(cloud.dtype)
    return (cloud - origin) @ rotation.T, rotation, origin


def upright_rotation(up: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation that takes a unit vector to +y and keeps z pointing away as nearly as it can."""
    along_z = up[2] ** 2 > 0.99
    ahead = jnp.where(along_z, jnp.asarray([0.0, 1.0, 0.0]), jnp.asarray([0.0, 0.0, 1.0])).astype(up.dtype)
    ahead = ahead - (ahead @ up) * up
    ahead = ahead / jnp.linalg.norm(ahead)
    return jnp.stack([jnp.cross(up, ahead), up, ahead])


def _fit(view: View, prior: Prior, scales: tuple[float, ...], least: float) -> tuple[Candidate | None, float]:
    """The best plane at the smallest noise at which there is one that is no slab; and the factor on the noise."""
    best, factor = None, 1.0
    for scale in scales:
        found = fit_plane(view, prior, on_device(scale, view.points.dtype))
        if float(found.support) >= least:
            best, factor = found, scale
            if float(found.spread) <= SLAB:
                break
    return best, factor


def _deviation(
    x: np.ndarray,
    w: np.ndarray,
    noise_distance: Any,
    depth_std: ArrayLike | None,
    eye: np.ndarray | None,
) -> tuple[np.ndarray, bool]:
    """Standard deviation of each point, and whether it is known or only up to a factor."""
    given = checks.noise_distance_or_auto(noise_distance, len(x))
    if given is not None:
        return np.broadcast_to(np.asarray(given, x.dtype) / POINT_DELTA, len(x)), True
    if depth_std is not None:
        given = checks.noise_distance(depth_std, len(x), "depth_std")
        return np.broadcast_to(np.asarray(given, x.dtype), len(x)), True
    middle = np.median(x[w > 0], axis=0)
    # Points that are all equal have no spread; rounding is the least noise there is.
    least = np.finfo(x.dtype).eps * max(float(np.abs(x).max()), np.finfo(x.dtype).tiny)
    spread = max(float(np.median(lengths(x[w > 0] - middle))), least)
    if eye is None:
        return np.full(len(x), spread, x.dtype), False
    # A stereo match is wrong by so many pixels: its depth by the square of the distance.
    square = ((x - eye) ** 2).sum(axis=1)
    return np.maximum(spread * square / max(float(np.median(square[w > 0])), least), least).astype(x.dtype), False


def _rectangle(inliers: np.ndarray, normal: np.ndarray, offset: float) -> Plane:
    """The plane with the rectangle that holds its inliers, a hundredth left out at each side."""
    across = np.asarray(tangents(normal))
    middle = inliers.mean(axis=0) if len(inliers) else offset * normal
    point = middle - (middle @ normal - offset) * normal
    flat = (inliers - point) @ across.T if len(inliers) else np.zeros((1, 2))
    (low_a, low_b), (high_a, high_b) = np.quantile(flat, [0.01, 0.99], axis=0)
    corners = np.array([[low_a, low_b], [high_a, low_b], [high_a, high_b], [low_a, high_b]]) @ across + point
    return Plane(on_device(point), on_device(normal), on_device(corners.astype(normal.dtype)))


def _span(x: np.ndarray, standing: np.ndarray, on: np.ndarray, axis: np.ndarray, eye: np.ndarray | None) -> float:
    """The larger share of the view, in width or in height, that some of the points span; a twentieth left out at each side."""
    some = slice(None, None, max(1, len(x) // LOOKED_AT))
    x, standing, on = x[some], standing[some], on[some]
    seen = seen_at(x, axis, eye, standing)
    whole = np.diff(np.quantile(seen[standing], [0.01, 0.99], axis=0), axis=0)[0]
    part = np.diff(np.quantile(seen[on], [0.05, 0.95], axis=0), axis=0)[0] if on.any() else np.zeros(2)
    return float(np.max(part / np.maximum(whole, np.finfo(x.dtype).tiny)))
