"""Calibration of a stereo rig from photographs of a chessboard or a ChArUco board."""

import dataclasses
import itertools
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np

from jaxfuzzy import checks
from jaxfuzzy.checks import DataError
from jaxfuzzy.photos import Image, read_grey
from jaxfuzzy.rig import Calibration, Rig, warn_of_unit
from jaxfuzzy.rigfiles import side_by_side

FEWEST_PAIRS = 3
# A pair is left out when its error is so many times the median and more than a pixel, or when the pose of its two
# cameras to each other is so far from the median of all pairs (radians, and share of the baseline).
WORST_ERROR, WORST_ERROR_PX, WORST_TURN, WORST_SHIFT = 3.0, 1.0, 0.1, 0.25
# No cameras are found where all pairs together err by more: photographs of one moment have 0.1 to 1 px, of two moments 50.
HOPELESS_PX = 5.0
# A board tells nothing of the lenses unless it is tilted, in some pair, by so many radians against the mean of all.
LEAST_TILT = 0.07
# Corners lie on one line where they spread so little across it, as a share of their spread along it.
LINE = 0.05


@dataclasses.dataclass
class _View:
    """What both cameras saw of the board in one pair."""

    pair: int
    board: np.ndarray  # (P, 3), metres
    left: np.ndarray  # (P, 2), pixels
    right: np.ndarray


def calibrate(
    left_images: Iterable[Any],
    right_images: Iterable[Any],
    *,
    board: tuple[int, int] = (9, 6),
    square_m: float,
    marker_m: float | None = None,
    dictionary: str = "DICT_4X4_50",
) -> Rig:
    """Finds lenses, focal lengths and the pose of two cameras from pairs of photographs of a flat board.

    Each camera is calibrated alone, then both together with the lenses held, which is the way of OpenCV's own sample.
    Ten pairs or more, the board tilted differently in each and near the corners of the picture in some, make a good rig;
    `rig.calibration` tells how good. Units are those of `square_m`: without the true size of a square nothing is metric.

    Args:
        left_images: Photographs by the left camera: paths or arrays.
        right_images: The same moments by the right camera, in the same order.
        board: Inner corners of the board, along and across: one less than its squares.
        square_m: Side of a square, metres.
        marker_m: Side of a marker, metres, where the board is a ChArUco board; such a board may be seen in part.
        dictionary: The markers of a ChArUco board, as OpenCV names them.

    Returns:
        A rig that is not yet rectified; `calibration` holds the errors of every pair and what was left out and why.

    Raises:
        FileNotFoundError: An image does not exist.
        TypeError: An argument is of another kind.
        ValueError: The lists differ in length or hold the same picture, an image or the board cannot be used.
        DataError: The board was found in fewer than 3 pairs or always in the same pose, the lists are swapped, or their pairs are
            not of the same moments.
    """
    left_images, right_images = (
        _several(images, name) for images, name in ((left_images, "left_images"), (right_images, "right_images"))
    )
    if len(left_images) != len(right_images):
        raise ValueError(f"left_images and right_images must be pairs, got {len(left_images)} and {len(right_images)}")
    if checks.real(board, "board").shape != (2,):
        raise ValueError(f"board must be two numbers of inner corners, got {board}")
    for side in board:
        checks.integer(side, "board", at_least=3)
    checks.number(square_m, "square_m", above=0.0)
    find = _chessboard(board, square_m) if marker_m is None else _charuco(board, square_m, marker_m, dictionary)
    views, left_out, size = _views(left_images, right_images, find)
    if len(views) < FEWEST_PAIRS:
        reasons = "; ".join(sorted({reason for _, reason in left_out}))
        raise DataError(
            f"the board of {board[0]} x {board[1]} inner corners was found in {len(views)} of {len(left_images)} pairs,"
            f" {FEWEST_PAIRS} are needed{f' ({reasons})' if reasons else ''}"
        )
    views, strange = _consistent(views, size)
    left_out += strange
    while True:
        rms, mono, left, right, rotation, translation, errors = _solve(views, size)
        worst = int(errors.argmax())
        if errors[worst] <= max(WORST_ERROR * np.median(errors), WORST_ERROR_PX) or len(views) <= FEWEST_PAIRS:
            break
        left_out.append((views[worst].pair, f"reprojection error of {errors[worst]:.1f} px"))
        del views[worst]
    shift = np.ravel(translation)
    if not rms < HOPELESS_PX:
        raise DataError(
            f"no two cameras explain these pairs: the corners are off by {rms:.0f} px; are both lists in the same order, and"
            " is each pair of one moment?"
        )
    if not side_by_side(shift):
        raise DataError("one camera seems to stand above or before the other; only side by side is supported")
    if shift[0] > 0:
        raise DataError("left_images seem to be those of the right camera: swap the two lists")
    found = Calibration(
        rms_px=float(rms),
        mono_rms_px=mono,
        pairs=tuple(view.pair for view in views),
        pair_rms_px=tuple(errors.tolist()),
        left_out=tuple(sorted(left_out)),
    )
    rig = Rig(
        focal_px=(left[0][0, 0], left[0][1, 1]),
        center_px=(left[0][0, 2], left[0][1, 2]),
        baseline_m=float(np.linalg.norm(shift)),
        image_size=size,
        right_focal_px=(right[0][0, 0], right[0][1, 1]),
        right_center_px=(right[0][0, 2], right[0][1, 2]),
        distortion=(tuple(np.ravel(left[1]).tolist()), tuple(np.ravel(right[1]).tolist())),
        rotation=tuple(tuple(row) for row in rotation.tolist()),
        translation=(float(shift[0]), float(shift[1]), float(shift[2])),
        calibration=found,
    )
    warn_of_unit(rig, "the rig found", "square_m is the side of a square in metres, 0.025 for one of 25 mm")
    return rig


def _chessboard(board: tuple[int, int], square_m: float) -> Any:
    places = np.zeros((board[0] * board[1], 3), np.float32)
    places[:, :2] = np.mgrid[: board[0], : board[1]].T.reshape(-1, 2) * square_m

    def find(image: Image) -> tuple[np.ndarray, np.ndarray] | None:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        seen, corners = cv2.findChessboardCorners(image, board, flags=flags)
        if not seen:
            return None
        return _sharpened(image, corners.reshape(-1, 2), np.arange(len(places)), board[0], 0.3), np.arange(len(places))

    find.places = places  # type: ignore[attr-defined]
    return find


def _sharpened(image: Image, corners: np.ndarray, numbers: np.ndarray, across: int, share: float) -> np.ndarray:
    """Corners to a fraction of a pixel, by a window of a share of the least distance between neighbors in a row.

    A window that reaches the next corner pulls towards it: on squares of 20 px the usual 11 px double the error.
    """
    order = np.argsort(numbers)
    beside = (np.diff(numbers[order]) == 1) & (numbers[order][1:] % across > 0)
    gaps = np.linalg.norm(np.diff(corners[order], axis=0), axis=1)[beside]
    half = int(np.clip(share * gaps.min(), 2, 11)) if gaps.size else 2
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)
    start = corners.astype(np.float32).reshape(-1, 1, 2)
    return cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop).reshape(-1, 2)


def _charuco(board: tuple[int, int], square_m: float, marker_m: float, dictionary: str) -> Any:
    known = isinstance(dictionary, str) and dictionary.startswith("DICT_") and hasattr(cv2.aruco, dictionary)
    if not known:
        raise ValueError(f"dictionary must be one of OpenCV's names such as 'DICT_4X4_50', got {dictionary!r}")
    checks.number(marker_m, "marker_m", above=0.0)
    if marker_m >= square_m:
        raise ValueError(f"marker_m must be below square_m, {square_m}, got {marker_m}")
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    needed, there = (board[0] + 1) * (board[1] + 1) // 2, len(markers.bytesList)
    if needed > there:
        raise ValueError(
            f"dictionary must have the {needed} markers of the board, got {dictionary!r}, which has {there}"
        )
    pattern = cv2.aruco.CharucoBoard((board[0] + 1, board[1] + 1), square_m, marker_m, markers)
    detector = cv2.aruco.CharucoDetector(pattern)

    def find(image: Image) -> tuple[np.ndarray, np.ndarray] | None:
        corners, numbers = detector.detectBoard(image)[:2]
        if corners is None or numbers is None:
            return None
        # The window must not reach the markers in the white squares either.
        numbers = np.ravel(numbers)
        return _sharpened(image, corners.reshape(-1, 2), numbers, board[0], 0.5 * (1 - marker_m / square_m)), numbers

    find.places = np.asarray(pattern.getChessboardCorners(), np.float32)  # type: ignore[attr-defined]
    return find


def _several(images: Any, name: str) -> Sequence[Any]:
    """Several photographs, in order."""
    if isinstance(images, str | os.PathLike) or not isinstance(images, Iterable):
        raise TypeError(f"{name} must be several paths or arrays, got {images!r}")
    return list(images)


def _views(
    left_images: Sequence[Any], right_images: Sequence[Any], find: Any
) -> tuple[list[_View], list[tuple[int, str]], tuple[int, int]]:
    """The board in every pair in which both cameras see enough of it, and why in the others not."""
    views: list[_View] = []
    left_out: list[tuple[int, str]] = []
    sizes: dict[int, tuple[tuple[int, int], ...]] = {}
    for pair, (left_image, right_image) in enumerate(zip(left_images, right_images, strict=True)):
        images = [read_grey(left_image, f"left_images[{pair}]"), read_grey(right_image, f"right_images[{pair}]")]
        if np.array_equal(images[0], images[1]) and np.ptp(images[0]):
            raise ValueError(f"left_images[{pair}] and right_images[{pair}] are the same picture: give both cameras'")
        sizes[pair] = tuple((image.shape[1], image.shape[0]) for image in images)
        found = [find(image) for image in images]
        missing = [name for name, corners in zip(("left", "right"), found, strict=True) if corners is None]
        if missing:
            left_out.append((pair, f"board not found in the {' and the '.join(missing)} image"))
            continue
        (left, left_numbers), (right, right_numbers) = found
        both, at_left, at_right = np.intersect1d(left_numbers, right_numbers, return_indices=True)
        if len(both) < 6:
            left_out.append((pair, "fewer than 6 corners seen by both cameras"))
            continue
        if _on_a_line(find.places[both]):
            left_out.append((pair, "all corners seen by both cameras lie on one line"))
            continue
        left, right = left[at_left], right[at_right]
        # A board whose corners look the same upside down may be counted from either end. Cameras side by side are not
        # turned against each other by more than a quarter, so the longest line must point the same way in both.
        if len(both) == len(find.places) and (left[-1] - left[0]) @ (right[-1] - right[0]) < 0:
            right = right[::-1]
        views.append(_View(pair, find.places[both], np.ascontiguousarray(left), np.ascontiguousarray(right)))
    # One photograph of another size must not rule out all the others, be it the first.
    size = Counter(itertools.chain.from_iterable(sizes.values())).most_common(1)[0][0] if sizes else (0, 0)
    other = {pair for pair, of in sizes.items() if set(of) != {size}}
    left_out = [(pair, why) for pair, why in left_out if pair not in other]
    left_out += [(pair, f"not {size[0]} x {size[1]} as most images") for pair in sorted(other)]
    return [view for view in views if view.pair not in other], left_out, size


def _on_a_line(places: np.ndarray) -> bool:
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= LINE * spread[0])


def _consistent(views: list[_View], size: tuple[int, int]) -> tuple[list[_View], list[tuple[int, str]]]:
    """Leaves out pairs whose cameras stand to each other otherwise than in most pairs: photographs of two moments."""
    boards = [view.board for view in views]
    poses = []
    for corners in ([view.left for view in views], [view.right for view in views]):
        vectors, places = cv2.calibrateCamera(boards, corners, size, None, None)[3:]
        poses.append([(cv2.Rodrigues(vector)[0], place) for vector, place in zip(vectors, places, strict=True)])
    facing = np.stack([turn[:, 2] for turn, _ in poses[0]])
    if np.linalg.norm(facing - facing.mean(axis=0), axis=1).max() < LEAST_TILT:
        raise DataError(
            "the board faces the same way in every pair, which tells nothing of the lenses: tilt it differently"
        )
    turns = np.stack([after @ before.T for (before, _), (after, _) in zip(*poses, strict=True)])
    shifts = np.stack([np.ravel(b - turn @ a) for turn, (_, a), (_, b) in zip(turns, *poses, strict=True)])
    axes = np.stack([np.ravel(cv2.Rodrigues(turn)[0]) for turn in turns])
    middle = np.median(shifts, axis=0)
    strange = np.linalg.norm(shifts - middle, axis=1) > WORST_SHIFT * np.linalg.norm(middle)
    strange |= np.linalg.norm(axes - np.median(axes, axis=0), axis=1) > WORST_TURN
    if (~strange).sum() < FEWEST_PAIRS:
        return views, []
    reason = "the cameras stand to each other otherwise than in the other pairs"
    kept = [view for view, odd in zip(views, strange, strict=True) if not odd]
    return kept, [(view.pair, reason) for view, odd in zip(views, strange, strict=True) if odd]


def _solve(views: list[_View], size: tuple[int, int]) -> tuple[Any, ...]:
    """Errors (both cameras, each alone, every pair), both cameras' matrices and lenses, and the pose between them."""
    boards, lefts, rights = ([getattr(view, name) for view in views] for name in ("board", "left", "right"))
    cameras, mono = [], []
    for corners in (lefts, rights):
        error, matrix, lens, _, _ = cv2.calibrateCamera(boards, corners, size, None, None)
        cameras.append((matrix, lens))
        mono.append(float(error))
    (left, left_lens), (right, right_lens) = cameras
    result: Any = cv2.stereoCalibrateExtended(  # type: ignore[call-overload]
        boards, lefts, rights, left, left_lens, right, right_lens, size, None, None, flags=cv2.CALIB_FIX_INTRINSIC
    )
    rotation, translation, per_view = result[5], result[6], np.asarray(result[-1])
    errors = np.sqrt((per_view**2).mean(axis=1))
    return result[0], (mono[0], mono[1]), cameras[0], cameras[1], rotation, translation, errors
