"""Steps of depth: the pieces of a group's picture between which the depth steps.

Places may gather what stands before each other, such as a cup and a ring behind it; the picture shows where one ends and the other
begins. Neighboring pixels belong to one piece where their depths differ by no more than the noise distance a pixel.
"""

import cv2
import numpy as np

from jaxfuzzy.flecks import GAP, SPARSE


def between_steps(pixels: np.ndarray, depth: np.ndarray, noise: float, each: float) -> list[np.ndarray]:
    """Indices of the points of each piece, the largest first; none where points are too sparse to have neighbors.

    Args:
        pixels: Column and row of each point (N, 2).
        depth: Its distance from the camera (N,).
        noise: The noise distance.
        each: How many pixels of the picture there are to each of its points, as `flecks.pixels_a_point` tells.
    """
    if not each <= SPARSE:
        return []
    # In cells of so many pixels, each as deep as one of its points: gaps of single pixels part nothing.
    cell = np.ceil(GAP * np.sqrt(each))
    column, row = (((along - along.min()) / cell).astype(int) for along in pixels.T)
    deep = np.full((row.max() + 1, column.max() + 1), np.inf)
    deep[row, column] = depth
    # Cells, and between them what joins them, as a picture of twice the size.
    joined = np.zeros((2 * deep.shape[0] - 1, 2 * deep.shape[1] - 1), np.uint8)
    joined[::2, ::2] = np.isfinite(deep)
    with np.errstate(invalid="ignore"):  # of two cells without points
        joined[::2, 1::2] = np.abs(np.diff(deep, axis=1)) <= cell * noise
        joined[1::2, ::2] = np.abs(np.diff(deep, axis=0)) <= cell * noise
    count, piece = cv2.connectedComponents(joined, connectivity=4)
    own = piece[2 * row, 2 * column]
    order = np.argsort(own, kind="stable")
    pieces = np.split(order, np.cumsum(np.bincount(own, minlength=count))[:-1])
    return sorted((of for of in pieces if len(of)), key=len, reverse=True)
