"""From disparity or depth to a metric point cloud, with a standard deviation for every point.

Depth is z = f B / (d + doffs) (`Rig` says what these are), x = (u - cx) z / fx, y = (v - cy) z / fy, in the left
camera's frame. The standard deviation of z follows from that of the disparity, σ_z = z² σ_d / (f B).
"""

import dataclasses
import warnings
from typing import Any

import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.arrays import Array, as_float, on_device
from jaxfuzzy.checks import DataError
from jaxfuzzy.cloud import Cloud
from jaxfuzzy.linalg import TO_STD
from jaxfuzzy.rig import Rig
from jaxfuzzy.status import Status

# Robust deviation from ground truth of refined semi-global matching: 0.13 to 0.32 px on twelve Middlebury scenes of 370
# to 560 rows. The left-right residual and local differences understate it two to nine times. Images with more rows are as sharp,
# not sharper: at 1,500 rows 0.6 px were measured.
DISPARITY_STD_PX, MEASURED_ROWS = 0.2, 560
# Disparities above the width of a picture, or above this, are told.
NARROWEST_PX = 64
# A plane is fitted with weights that follow from it, so many times.
MOST_SWEEPS = 30


def usual_std_px(rows: int) -> float:
    """Standard deviation of a disparity in images of so many rows, where nothing better is known."""
    return DISPARITY_STD_PX * max(1.0, rows / MEASURED_ROWS)


def cloud_from_disparity(
    disparity_px: Any, valid: Any, rig: Rig, *, image: Any = None, disparity_std_px: Any = None
) -> Cloud:
    """Turns a disparity map into points in metres in the left camera's frame (x right, y down, z forward).

    Args:
        disparity_px: Disparities (H, W) of the left image in whole pixels and fractions of them. OpenCV's matchers give
            16 times that as int16, which is refused here: divide by 16.0 first.
        valid: Which pixels to use (H, W), or None for every finite disparity above 0. Pixels whose disparity is not
            finite, or puts them at infinity or behind the camera (disparity + doffs not above 0), are left out.
        rig: The rig of the image.
        image: The left image for colors, grey (H, W) or BGR (H, W, 3), uint8.
        disparity_std_px: Standard deviation of the disparity, one number or a map (H, W); None takes what is usual at so many
            rows, as `Matcher` does.

    Returns:
        The points in row order of their pixels, with colors, `depth_std` and `pixels_px`.

    Raises:
        ValueError: Shapes disagree, disparities are OpenCV's fixed point, or a standard deviation is not above 0.
        DataError: No pixel is left.
    """
    disparity = np.asarray(disparity_px)
    if disparity.dtype == np.int16:
        raise ValueError(
            "disparity_px must be in pixels, got int16, which is OpenCV's fixed point: divide by 16.0 and mask what is"
            " below the smallest disparity"
        )
    disparity = _map(disparity, "disparity_px", rig)
    valid = np.isfinite(disparity) & (disparity > 0) if valid is None else _mask(valid, disparity.shape)
    with np.errstate(invalid="ignore"):
        valid = valid & np.isfinite(disparity) & (disparity + rig.doffs_px > 0)
    widest = max(disparity.shape[1], NARROWEST_PX)
    if (disparity[valid] > widest).sum() > valid.sum() / 2:
        warnings.warn(
            f"disparities are mostly above the {disparity.shape[1]} px that the image is wide: unless it is cut out of a larger"
            " one they are multiples, 16 of which are a pixel (OpenCV), 256 (KITTI) or 4 (Middlebury), see read_disparity",
            stacklevel=2,
        )
    scale = rig.focal_px[0] * rig.baseline_m
    depth = np.full_like(disparity, np.nan)
    depth[valid] = scale / (disparity[valid] + np.asarray(rig.doffs_px, disparity.dtype))
    std_px = usual_std_px(len(disparity)) if disparity_std_px is None else disparity_std_px
    cloud = _cloud(depth, valid, rig, image, _std(std_px, disparity, valid) * depth**2 / scale)
    return cloud if rig.metric else dataclasses.replace(cloud, status=int(Status.ARBITRARY_UNITS))


def cloud_from_depth(depth_m: Any, valid: Any, rig: Rig, *, image: Any = None, depth_std: Any = None) -> Cloud:
    """Turns a depth map of any other source (a depth camera, a learned matcher) into points in metres.

    Args:
        depth_m: Depth along the optical axis (H, W), metres; NaN, infinity, 0 and negative values mean unknown.
        valid: Which pixels to use (H, W), or None for all that are known.
        rig: The rig of the image; of a single camera only focal lengths and center matter.
        image: The image for colors, grey (H, W) or BGR (H, W, 3), uint8.
        depth_std: Standard deviation of the depth, one number or a map (H, W); None takes the rig's stereo error, or where its
            baseline is not known leaves it open.

    Returns:
        The points in metres, in row order of their pixels, with colors, `pixels_px`, and `depth_std` where that is known.

    Raises:
        ValueError: Shapes disagree, depths are whole numbers, or a standard deviation is not above 0.
        DataError: No pixel is left.
    """
    values = np.asarray(depth_m)
    if values.dtype.kind in "iu":
        raise ValueError(
            f"depth_m must be in metres, got {values.dtype}, which depth cameras give in millimetres: multiply by 0.001"
        )
    depth = _map(values, "depth_m", rig)
    known = np.isfinite(depth) & (depth > 0)
    valid = known if valid is None else _mask(valid, depth.shape) & known
    std = None
    if depth_std is not None:
        std = np.broadcast_to(_std(depth_std, depth, valid, "depth_std"), depth.shape)
    elif rig.metric:
        std = usual_std_px(len(depth)) * depth**2 / (rig.focal_px[0] * rig.baseline_m)
    return _cloud(depth, valid, rig, image, std)


@dataclasses.dataclass(frozen=True)
class Noise:
    """Errors of disparities, measured where the surface is known.

    Attributes:
        std_px: Standard deviation of a disparity, robust against wrong matches.
        pixels_per_point: How many neighboring pixels together tell as much as one independent point would: N of them are
            worth N / pixels_per_point in a covariance or in the price of a parameter.
    """

    std_px: float
    pixels_per_point: float


def measure_noise(disparity_px: Any, mask: Any, *, truth_px: Any = None, block: int = 32) -> Noise:
    """Measures the errors of disparities on a plane, or against known disparities.

    A plane in space is a plane in (column, row, disparity), so no calibration is needed. Errors of neighboring pixels are
    alike over tens of pixels: the mean of a block of b × b varies by far more than 1 / b² of what one pixel does, and the
    ratio of the two is the number of pixels that make one independent point.

    Args:
        disparity_px: Disparities (H, W).
        mask: Pixels of the plane (H, W), or those where the truth is known.
        truth_px: True disparities (H, W) in place of a plane.
        block: Side of the blocks, pixels; it must be large against the reach of the correlation.

    Returns:
        The standard deviation, and how many pixels make one independent point.

    Raises:
        ValueError: Shapes disagree, or `block` is less than 2.
        DataError: Fewer than 100 pixels, or fewer than 4 blocks of which half is seen.
    """
    checks.integer(block, "block", at_least=2)
    values = np.asarray(checks.real(disparity_px, "disparity_px"), float)
    if values.ndim != 2:
        raise ValueError(f"disparity_px must have shape (H, W), got {values.shape}")
    mask = _mask(mask, values.shape, "mask") & np.isfinite(values)
    if truth_px is not None and np.shape(truth_px) != values.shape:
        raise ValueError(f"truth_px must have the shape of disparity_px, {values.shape}, got {np.shape(truth_px)}")
    if mask.sum() < 100:
        raise DataError(f"mask must hold at least 100 pixels with a disparity, got {int(mask.sum())}")
    rows, columns = np.nonzero(mask)
    if truth_px is None:
        design = np.column_stack([columns - columns.mean(), rows - rows.mean(), np.ones(len(rows))])
        weight = np.ones(len(rows))
        # Geman and McClure's weights, their scale from the median: a third of wrong pixels is no harm.
        for _ in range(MOST_SWEEPS):
            root = np.sqrt(weight)[:, None]
            plane = np.linalg.lstsq(design * root, values[mask] * root[:, 0], rcond=None)[0]
            error = values[mask] - design @ plane
            scale = 3 * TO_STD * np.median(np.abs(error)) + 1e-9
            weight = 1 / (1 + (error / scale) ** 2) ** 2
    else:
        error = values[mask] - np.asarray(truth_px, float)[mask]
    error = error - np.median(error)
    std = TO_STD * float(np.median(np.abs(error)))
    good = np.abs(error) <= 4 * std
    number = (rows // block) * (values.shape[1] // block + 1) + columns // block
    held = np.bincount(number[good])
    sums = np.bincount(number[good], error[good])
    full = held >= block**2 / 2
    if full.sum() < 4:
        raise DataError(f"mask must cover at least half of 4 blocks of {block} pixels, got {int(full.sum())}")
    means = sums[full] / held[full]
    spread, of_one = np.sum(held[full] * means**2) / full.sum(), np.mean(error[good] ** 2)
    return Noise(std, max(1.0, float(spread / of_one)) if of_one > 0 else 1.0)


def _cloud(depth: np.ndarray, valid: np.ndarray, rig: Rig, image: Any, std: np.ndarray | None) -> Cloud:
    rows, columns = np.nonzero(valid)
    if not len(rows):
        raise DataError(
            "no pixel is left: none is valid, finite and in front of the camera (some makers count disparities negative)"
        )
    dtype = depth.dtype
    points = np.empty((len(rows), 3), dtype)
    points[:, 2] = depth[valid]
    for axis, places in enumerate((columns, rows)):
        points[:, axis] = (places.astype(dtype) - rig.center_px[axis]) / rig.focal_px[axis] * points[:, 2]
    return Cloud(
        points=as_float(points),
        colors=None if image is None else _colors(image, valid),
        depth_std=None if std is None else as_float(std[valid].astype(dtype)),
        pixels_px=as_float(np.stack([columns.astype(dtype), rows.astype(dtype)], axis=1)),
    )


def _colors(image: Any, valid: np.ndarray) -> Array:
    image, shape = np.asarray(image), valid.shape
    if image.dtype != np.uint8 or image.shape not in (shape, (*shape, 3)):
        raise ValueError(f"image must be uint8 of shape {shape} or {(*shape, 3)}, got {image.dtype} {image.shape}")
    colors = image[valid]
    colors = np.repeat(colors[:, None], 3, axis=1) if colors.ndim == 1 else colors[:, ::-1]
    return on_device(colors.astype(np.float32) / 255)


def _map(value: np.ndarray, name: str, rig: Rig) -> np.ndarray:
    if value.ndim != 2 or value.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be real numbers of shape (H, W), got {value.dtype} {value.shape}")
    if rig.image_size is not None and value.shape != rig.image_size[::-1]:
        raise ValueError(
            f"{name} must have the rig's size, {rig.image_size[1]} rows and {rig.image_size[0]} columns, got"
            f" {value.shape[0]} and {value.shape[1]}; rig.scaled((width, height)) makes the rig of a resized image"
        )
    if not rig.rectified:
        raise ValueError(
            f"rig must be rectified, since {name} is that of rectified images: see rectify, or where the rig's file describes raw"
            " cameras too, load_rig(..., rectified=True), --rectified"
        )
    if rig.image_size is None and not all(
        0 <= c <= size for c, size in zip(rig.center_px, value.shape[::-1], strict=True)
    ):
        warnings.warn(
            f"the rig's center, {rig.center_px}, lies outside the {value.shape[1]} x {value.shape[0]} pixels of {name}: if the"
            " images were resized since, rig.scaled(factor) makes the rig of them",
            stacklevel=3,
        )
    return value.astype(np.float64 if value.dtype == np.float64 else np.float32)


def _mask(value: Any, shape: tuple[int, ...], name: str = "valid") -> np.ndarray:
    mask = np.asarray(value)
    if mask.shape != shape or mask.dtype not in (np.bool_, np.uint8):
        raise ValueError(f"{name} must be booleans of shape {shape}, got {mask.dtype} {mask.shape}")
    return mask.astype(bool)


def _std(value: Any, like: np.ndarray, valid: np.ndarray, name: str = "disparity_std_px") -> np.ndarray:
    std = np.asarray(checks.real(value, name), like.dtype)
    if std.shape == ():
        checks.number(value, name, above=0.0)
    elif std.shape != like.shape:
        raise ValueError(f"{name} must be one number or of shape {like.shape}, got {std.shape}")
    elif not np.all((std[valid] > 0) & np.isfinite(std[valid])):
        raise ValueError(f"{name} must be finite and above 0 at every valid pixel")
    return std
