"""Flecks: connected pieces of the picture that are too small to say anything, such as what matching errors lift above a table.

Neighboring pixels err alike, so that a piece of fewer pixels than tell as much as one independent point may be no more than one
error. Pixels belong to one piece where few steps lie between them, as between those around one that was not matched.
"""

import cv2
import numpy as np

from jaxfuzzy.arrays import extents

# Gaps of so many times the usual spacing of pixels do not part a piece.
GAP = 1.5
# Points that are fewer than one in so many pixels of their picture are in no pieces, and have no neighbors.
SPARSE = 100


def in_flecks(pixels: np.ndarray, kept: np.ndarray, fewest: int) -> np.ndarray:
    """Which of some points are in pieces of less than so many.

    Args:
        pixels: Column and row of each point of the cloud (N, 2).
        kept: Which points are asked about (N,).
        fewest: Pieces of fewer points are flecks.
    """
    each = pixels_a_point(pixels)
    if not kept.any() or not each <= SPARSE:
        return np.zeros(len(pixels), bool)
    # In cells of so many pixels, with those around: that is quicker than to grow every pixel.
    cell = np.ceil(GAP * np.sqrt(each))
    column, row = (((along - along.min()) / cell).astype(int) for along in pixels.T)
    mask = np.zeros((row.max() + 1, column.max() + 1), np.uint8)
    mask[row[kept], column[kept]] = 1
    count, piece = cv2.connectedComponents(mask, connectivity=8)
    own = piece[row, column]
    size = np.bincount(own[kept], minlength=count)
    return kept & (size[own] < fewest)


def pixels_a_point(pixels: np.ndarray) -> float:
    """How many pixels of the picture that points (N, 2) span there are to each of them; infinite where there is none."""
    return float((extents(pixels) + 1).prod() / len(pixels)) if len(pixels) else np.inf
