"""Whether a group is a piece of something larger: an object ends where the depth steps or where it stands, a piece goes on.

What a threshold takes from the ground, a wall or a cloth has a border like any group, but across that border the surface goes on
at the same depth. Such a piece of a wall bends a little and would be a wide cylinder. The picture tells: of the pixels a few steps
away from those of a group, in the four directions, that are not its own, it is counted how many belong to nobody, are not the
ground, and lie as deep. Those that were not matched count as steps, since matching leaves them out there; those of another object
that lie as deep do not count at all.
"""

from collections.abc import Sequence

import numpy as np

from jaxfuzzy.flecks import SPARSE, pixels_a_point
from jaxfuzzy.primitives import Plane, Quadric
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import Status
from jaxfuzzy.trials import refused

# Neighbors are so many pixels away.
STEP = 5
# A group is a piece where so large a share of these neighbors goes on. On photographs and rendered tables objects have at most
# 0.01, a beam along a wall and things wrapped in cloth 0.11, bent pieces of a wall 0.41 and 0.49.
GOES_ON = 0.25
# As deep means by no more than so many noise distances.
LEVEL = 2.0
# Of the whole border such a share must be none with another object at the same depth, or it tells nothing.
TELLING = 0.2


def without_pieces(
    pixels: np.ndarray,
    depth: np.ndarray,
    ground: np.ndarray,
    members: Sequence[np.ndarray],
    shapes: Sequence[Shape],
) -> tuple[Shape, ...]:
    """Names "unknown" what is a piece of something larger, by the status PIECE; a piece of a plane is a plane and stays.

    Args:
        pixels: Column and row of each point of the cloud (N, 2).
        depth: Its distance from the camera (N,).
        ground: Which points lie on the ground (N,).
        members: Indices of the points of each shape.
        shapes: The shapes.
    """
    if not pixels_a_point(pixels) <= SPARSE:
        return tuple(shapes)
    column, row = (np.round(along - along.min()).astype(int) + STEP for along in pixels.T)
    point = np.full((row.max() + STEP + 1, column.max() + STEP + 1), -1)
    point[row, column] = np.arange(len(pixels))
    owner = np.full(len(pixels), -1)
    for k, own in enumerate(members):
        owner[own] = k
    told = []
    for k, (own, shape) in enumerate(zip(members, shapes, strict=True)):
        if shape.primitive is not None and not isinstance(shape.primitive, Plane | Quadric):
            goes_on, border, every = 0, 0, 0
            for across, down in ((STEP, 0), (-STEP, 0), (0, STEP), (0, -STEP)):
                other = point[row[own] + down, column[own] + across]
                outside = (other < 0) | (owner[other] != k)
                level = (other >= 0) & (np.abs(depth[other] - depth[own]) <= LEVEL * float(shape.noise_distance))
                every += int(np.sum(outside))
                # Where it meets another object at its own depth, as where one was cut from it, nothing can be told.
                border += int(np.sum(outside & ~(level & (owner[other] >= 0))))
                goes_on += int(np.sum(outside & level & (owner[other] < 0) & ~ground[other]))
            if goes_on > GOES_ON * border and border >= TELLING * every:
                shape = refused(shape, Status.PIECE, "its surface goes on beyond its points")
        told.append(shape)
    return tuple(told)
