"""Calibration: a rendered rig of known numbers, real photographs, and every way a pair of photographs can be bad."""

import dataclasses

import cv2
import numpy as np
import pytest

from jaxfuzzy.calibrate import calibrate
from jaxfuzzy.checks import DataError
from jaxfuzzy.rig import load_rig, save_rig
from jaxfuzzy.stereo import rectify

SIZE = (640, 480)
LEFT = np.array([[560.0, 0, 325.0], [0, 560.0, 236.0], [0, 0, 1]])
RIGHT = np.array([[570.0, 0, 314.0], [0, 570.0, 245.0], [0, 0, 1]])
ROTATION = cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))[0]
TRANSLATION = np.array([-0.1, 0.002, 0.001])
SQUARE = 0.03
TURNS = ((0.4, 0.0, 0.1), (-0.4, 0.2, 0.0), (0.1, 0.5, -0.3), (0.0, -0.5, 0.2), (0.3, 0.3, 0.5), (-0.3, -0.3, -0.1))
PLACES = (
    (-0.05, 0.0, 0.6),
    (0.06, 0.03, 0.7),
    (0.1, -0.05, 0.65),
    (-0.1, 0.05, 0.7),
    (0.0, 0.08, 0.6),
    (0.05, -0.08, 0.75),
)


def photograph(picture, squares, camera, turn, shift):
    """A flat board in perspective, twice as fine and averaged; `picture` has 40 px a square and a margin of one square."""
    half = np.array([squares[0] / 2, squares[1] / 2]) * SQUARE
    to_metres = np.array([[SQUARE / 40, 0, -SQUARE - half[0]], [0, SQUARE / 40, -SQUARE - half[1]], [0, 0, 1]])
    plane = camera @ np.column_stack([turn[:, 0], turn[:, 1], shift]) @ to_metres
    finer = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1.0]])
    big = cv2.warpPerspective(picture, finer @ plane, (2 * SIZE[0], 2 * SIZE[1]), borderValue=200, flags=cv2.INTER_AREA)
    noise = np.random.default_rng(0).normal(0, 2, SIZE[::-1])
    return np.clip(cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA) + noise, 0, 255).astype(np.uint8)


def pairs(picture, squares, count=6):
    lefts, rights = [], []
    for angles, place in list(zip(TURNS, PLACES, strict=True))[:count]:
        turn, shift = cv2.Rodrigues(np.array(angles))[0], np.array(place)
        lefts.append(photograph(picture, squares, LEFT, turn, shift))
        rights.append(photograph(picture, squares, RIGHT, ROTATION @ turn, ROTATION @ shift + TRANSLATION))
    return lefts, rights


def chessboard(squares):
    board = np.kron(np.indices(squares[::-1]).sum(0) % 2, np.ones((40, 40))) * 210 + 20
    return np.pad(board, 40, constant_values=230).astype(np.uint8)


@pytest.fixture(scope="module")
def odd_board():
    """7 x 5 corners: the same upside down."""
    return pairs(chessboard((8, 6)), (8, 6))


def assert_known(rig, *, pixels, share):
    np.testing.assert_allclose([*rig.focal_px, *rig.right_focal_px], [560, 560, 570, 570], atol=3 * pixels)
    np.testing.assert_allclose(rig.center_px, (325, 236), atol=3 * pixels)
    assert rig.baseline_m == pytest.approx(np.linalg.norm(TRANSLATION), rel=share)
    # A principal point off by so many pixels is a camera turned by so much.
    np.testing.assert_allclose(rig.rotation, ROTATION, atol=3 * pixels / 560)
    np.testing.assert_allclose(rig.translation, TRANSLATION, atol=0.001 * pixels)


def test_a_known_rig_is_found(odd_board):
    rig = calibrate(*odd_board, board=(7, 5), square_m=SQUARE)
    assert rig.calibration.pairs == (0, 1, 2, 3, 4, 5)
    assert rig.calibration.left_out == ()
    # Corners of a rendered board with noise are good to about 0.05 px; six pairs leave the center open by a pixel or two.
    assert rig.calibration.rms_px < 0.1
    assert_known(rig, pixels=1.5, share=0.005)
    assert not rig.rectified


def test_a_board_counted_from_its_other_end_is_mended(odd_board, monkeypatch):
    """Trap 16: 7 x 5 corners look the same upside down; one such pair takes OpenCV's error from 0.4 to 45.8 px."""
    plain = calibrate(*odd_board, board=(7, 5), square_m=SQUARE)
    original, calls = cv2.findChessboardCorners, []

    def sometimes_reversed(image, *args, **kwargs):
        seen, corners = original(image, *args, **kwargs)
        calls.append(1)
        return seen, corners[::-1] if len(calls) in (4, 7) else corners

    monkeypatch.setattr(cv2, "findChessboardCorners", sometimes_reversed)
    mended = calibrate(*odd_board, board=(7, 5), square_m=SQUARE)
    assert mended.calibration.left_out == ()
    assert mended.calibration.rms_px == pytest.approx(plain.calibration.rms_px, rel=0.05)


def test_charuco_seen_in_part():
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    pattern = cv2.aruco.CharucoBoard((8, 6), SQUARE, 0.022, dictionary)
    picture = np.pad(pattern.generateImage((320, 240)), 40, constant_values=255)
    lefts, rights = pairs(picture, (8, 6))
    lefts[1][:, :260] = 200  # something stands before a part of the board
    options = {"board": (7, 5), "square_m": SQUARE, "marker_m": 0.022, "dictionary": "DICT_5X5_100"}
    rig = calibrate(lefts, rights, **options)
    assert len(rig.calibration.pairs) == 6
    assert rig.calibration.rms_px < 0.15
    assert_known(rig, pixels=2, share=0.01)
    with pytest.raises(ValueError, match="dictionary must be one of OpenCV's names"):
        calibrate(lefts, rights, **options | {"dictionary": "5X5"})
    with pytest.raises(ValueError, match=r"marker_m must be below square_m, 0\.03"):
        calibrate(lefts, rights, **options | {"marker_m": 0.03})
    with pytest.raises(
        ValueError, match="dictionary must have the 60 markers of the board, got 'DICT_4X4_50', which has 50"
    ):
        calibrate(lefts, rights, **options | {"board": (11, 9), "dictionary": "DICT_4X4_50"})
    # A pair of which one row of corners is seen holds no plane.
    picture[122:] = 255
    strip = [images[3] for images in pairs(picture, (8, 6))]
    found = calibrate([*lefts, strip[0]], [*rights, strip[1]], **options).calibration
    assert found.left_out == ((6, "all corners seen by both cameras lie on one line"),)


def test_bad_pairs_are_named_and_left_out(odd_board):
    lefts, rights = ([*images] for images in odd_board)
    blank = np.full(SIZE[::-1], 128, np.uint8)
    lefts += [blank, lefts[0], lefts[0][:400], lefts[0]]
    rights += [rights[0], blank, rights[0], np.roll(rights[0], (60, 90), axis=(0, 1))]
    found = calibrate(lefts, rights, board=(7, 5), square_m=SQUARE).calibration
    assert found.pairs == (0, 1, 2, 3, 4, 5)
    reasons = dict(found.left_out)
    assert set(reasons) == {6, 7, 8, 9}
    assert reasons[6] == "board not found in the left image"
    assert reasons[7] == "board not found in the right image"
    assert reasons[8] == "not 640 x 480 as most images"
    assert "otherwise" in reasons[9] or "reprojection" in reasons[9]
    assert found.rms_px < 0.1


def test_the_first_photograph_may_be_the_bad_one(odd_board):
    lefts, rights = odd_board
    found = calibrate([lefts[0][:400], *lefts], [rights[0][:400], *rights], board=(7, 5), square_m=SQUARE).calibration
    assert found.left_out == ((0, "not 640 x 480 as most images"),)
    assert len(found.pairs) == 6


def test_lists_out_of_step_are_no_pairs(odd_board):
    """One dropped photograph, and every pair is of two moments: no rig explains them, whatever the error of each."""
    lefts, rights = odd_board
    with pytest.raises(
        DataError, match=r"no two cameras explain these pairs: the corners are off by \d+ px; .*same order"
    ):
        calibrate(lefts, [*rights[1:], rights[0]], board=(7, 5), square_m=SQUARE)


def test_one_camera_twice_and_one_pose_are_refused(odd_board):
    lefts, rights = odd_board
    with pytest.raises(ValueError, match=r"left_images\[0\] and right_images\[0\] are the same picture"):
        calibrate(lefts, lefts, board=(7, 5), square_m=SQUARE)
    with pytest.raises(DataError, match="the board faces the same way in every pair"):
        calibrate(lefts[:1] * 4, rights[:1] * 4, board=(7, 5), square_m=SQUARE)
    with pytest.raises(DataError, match=r"found in 1 of 1 pairs, 3 are needed$"):
        calibrate(lefts[:1], rights[:1], board=(7, 5), square_m=SQUARE)


def test_squares_in_millimetres_are_warned_of(odd_board):
    with pytest.warns(UserWarning, match=r"baseline of 100\.\d+ m: square_m is the side of a square in metres"):
        calibrate(*odd_board, board=(7, 5), square_m=1000 * SQUARE)


def test_a_blunder_of_the_detector_is_left_out(odd_board, monkeypatch):
    """Corners of one image off by some pixels, too few to upset the pose: the reprojection error tells."""
    original, calls = cv2.cornerSubPix, []

    def sometimes_shaken(image, *args, **kwargs):
        corners = original(image, *args, **kwargs)
        calls.append(1)
        noise = np.random.default_rng(0).normal(0, 2, corners.shape).astype(np.float32)
        return corners + noise if len(calls) == 5 else corners

    monkeypatch.setattr(cv2, "cornerSubPix", sometimes_shaken)
    found = calibrate(*odd_board, board=(7, 5), square_m=SQUARE).calibration
    assert dict(found.left_out).keys() == {2}
    assert found.rms_px < 0.1


def test_wrong_use(odd_board):
    lefts, rights = odd_board
    with pytest.raises(ValueError, match="got 6 and 5"):
        calibrate(lefts, rights[:5], square_m=SQUARE)
    with pytest.raises(TypeError, match="square_m"):
        calibrate(lefts, rights)
    with pytest.raises(ValueError, match="square_m must be a finite number above 0"):
        calibrate(lefts, rights, square_m=0.0)
    for name, wrong in (("left_images", "left.png"), ("right_images", 3)):
        with pytest.raises(TypeError, match=f"{name} must be several paths or arrays"):
            calibrate(**{"left_images": lefts, "right_images": rights} | {name: wrong}, square_m=SQUARE)
    with pytest.raises(ValueError, match="board must be two numbers"):
        calibrate(lefts, rights, board=9, square_m=SQUARE)
    with pytest.raises(ValueError, match="dictionary must be one of OpenCV's names"):
        calibrate(lefts, rights, square_m=SQUARE, marker_m=SQUARE / 2, dictionary=5)
    with pytest.raises(DataError, match="found in 0 of 2 pairs"):
        calibrate(iter(lefts[:2]), map(np.array, rights[:2]), board=(4, 9), square_m=SQUARE)
    with pytest.raises(ValueError, match="board must be at least 3"):
        calibrate(lefts, rights, board=(7, 1), square_m=SQUARE)
    with pytest.raises(DataError, match=r"found in 0 of 2 pairs, 3 are needed \(board not found"):
        calibrate(lefts[:2], rights[:2], board=(4, 9), square_m=SQUARE)
    with pytest.raises(DataError, match="found in 0 of 0 pairs"):
        calibrate([], [], square_m=SQUARE)
    with pytest.raises(DataError, match="swap the two lists"):
        calibrate(rights, lefts, board=(7, 5), square_m=SQUARE)
    with pytest.raises(FileNotFoundError, match=r"left_images\[0\] image not found"):
        calibrate(["none.png"], ["none.png"], square_m=SQUARE)


def test_real_photographs(shared_data, tmp_path):
    """OpenCV's own sample: 13 of 13 boards, at most the 0.447 px that its settings give."""
    folder = shared_data / "opencv_chessboard"
    lefts = sorted(folder.glob("left[0-9]*.jpg"))
    rights = [path.with_name(path.name.replace("left", "right")) for path in lefts]
    rig = calibrate(lefts, rights, square_m=1.0)
    assert len(rig.calibration.pairs) == 13
    assert rig.calibration.rms_px < 0.447
    assert max(rig.calibration.mono_rms_px) < 0.46
    # The sample's: f 536 / 542 px, T (-3.344, 0.042, 0.053) squares; windows that reach the next corner cost it a per cent.
    np.testing.assert_allclose([rig.focal_px[0], rig.right_focal_px[0]], [536, 542], rtol=0.01)
    np.testing.assert_allclose(rig.translation, [-3.344, 0.042, 0.053], atol=0.06)
    save_rig(tmp_path / "rig.json", rig)
    assert load_rig(tmp_path / "rig.json") == rig
    # Rectified, corners of both images of a pair not used in any way share their rows.
    straight_left, straight_right, straight = rectify(lefts[0], rights[0], rig)
    rows = []
    for image in (straight_left, straight_right):
        seen, corners = cv2.findChessboardCorners(image, (9, 6))
        assert seen
        rows.append(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), (3, 40, 1e-4)).reshape(-1, 2))
    assert np.sqrt(np.mean((rows[0][:, 1] - rows[1][:, 1]) ** 2)) < 0.4
    depth = straight.focal_px[0] * straight.baseline_m / (rows[0][:, 0] - rows[1][:, 0] + straight.doffs_px)
    places = np.column_stack(
        [(rows[0] - straight.center_px) / straight.focal_px * depth[:, None], depth],
    ).reshape(6, 9, 3)
    sides = np.linalg.norm(np.diff(places, axis=1), axis=-1)
    assert np.median(sides) == pytest.approx(1.0, rel=0.01), "a square does not measure a square"
    assert dataclasses.asdict(straight)["calibration"]["rms_px"] == rig.calibration.rms_px
