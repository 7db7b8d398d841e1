"""Photographs as users have them: with the noise of a sensor, compressed. For `scenes.py` and `stereo.py`."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

Pair = tuple[np.ndarray, np.ndarray]


def noisy(left: np.ndarray, right: np.ndarray, *, levels: float) -> Pair:
    """With normal noise of so many grey levels, in each channel and image its own."""
    random = np.random.default_rng(3)
    spoil = lambda image: np.clip(np.rint(image + random.normal(0, levels, image.shape)), 0, 255).astype(np.uint8)
    return spoil(left), spoil(right)


def compressed(left: np.ndarray, right: np.ndarray, *, quality: int) -> Pair:
    """As JPEG of a quality of 0 to 100 leaves them."""
    spoil = lambda image: cv2.imdecode(
        cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR
    )
    return spoil(left), spoil(right)


SPOILT: dict[str, Callable[[np.ndarray, np.ndarray], Pair]] = {
    "noise of 2 grey levels": partial(noisy, levels=2),
    "noise of 4 grey levels": partial(noisy, levels=4),
    "JPEG of quality 90": partial(compressed, quality=90),
    "JPEG of quality 60": partial(compressed, quality=60),
}
