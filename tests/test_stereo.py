"""The stereo stage against rendered pairs with exact truth, and every trap that users of OpenCV's stereo fall into."""

import dataclasses
import hashlib
import struct
import warnings

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy import stereo
from jaxfuzzy.brightness import Line, evened, line_between
from jaxfuzzy.calibrate import calibrate
from jaxfuzzy.checks import DataError
from jaxfuzzy.matcher import Matcher
from jaxfuzzy.photos import alignment, read_depth, read_disparity, read_pair, rectify
from jaxfuzzy.primitives import Sphere
from jaxfuzzy.render import Setting, paper_scene, render_pair, table_scene
from jaxfuzzy.reproject import cloud_from_depth, cloud_from_disparity, measure_noise, usual_std_px
from jaxfuzzy.rig import Rig, load_rig
from jaxfuzzy.status import Status
from jaxfuzzy.stereo import disparity, example_pair, reconstruct, search_range

SMALL = Rig((350.0, 350.0), (159.5, 119.5), 0.08, (320, 240))
FLAT = Rig((100.0, 100.0), (1.0, 0.5), 0.1, (4, 2))


@pytest.fixture(scope="module")
def table():
    return render_pair(table_scene(3))


@pytest.fixture(scope="module")
def matched(table):
    return tuple(map(np.asarray, disparity(table.left, table.right, table.rig)))


def small(seed=3, tilt=0.31, **options):
    return render_pair(table_scene(seed, tilt=tilt, rig=SMALL), SMALL, **options)


# Points from disparities, by hand


def test_one_pixel_by_hand():
    values = np.full((2, 4), np.nan)
    values[1, 3] = 8.0
    rig = dataclasses.replace(FLAT, doffs_px=2.0)
    cloud = cloud_from_disparity(
        values, None, rig, image=np.full((2, 4, 3), (255, 51, 0), np.uint8), disparity_std_px=0.5
    )
    depth = 100 * 0.1 / (8 + 2)
    np.testing.assert_allclose(cloud.points, [[(3 - 1) * depth / 100, (1 - 0.5) * depth / 100, depth]], rtol=1e-15)
    np.testing.assert_allclose(cloud.depth_std, [depth**2 * 0.5 / (100 * 0.1)], rtol=1e-15)
    np.testing.assert_array_equal(cloud.pixels_px, [[3, 1]])
    np.testing.assert_allclose(cloud.colors, [[0, 0.2, 1]], rtol=1e-6)  # float32; BGR in, RGB out
    assert cloud.status == 0


@pytest.mark.filterwarnings("ignore:.*lies outside the 7 x 5 pixels")
def test_both_cameras_see_the_point_where_it_was():
    """Trap 4 (the sign of Q): projected into both cameras, a point returns to its pixel and to that less its disparity."""
    rig = Rig((700.0, 710.0), (300.0, 200.0), 0.12, None, doffs_px=31.0)
    values = np.random.default_rng(0).uniform(-20, 60, (5, 7))
    cloud = cloud_from_disparity(values, np.ones((5, 7), bool), rig)
    x, y, z = np.asarray(cloud.points).T
    columns, rows = np.asarray(cloud.pixels_px).T
    assert np.all(z > 0)
    np.testing.assert_allclose(rig.focal_px[0] * x / z + 300, columns, atol=1e-10)
    np.testing.assert_allclose(rig.focal_px[1] * y / z + 200, rows, atol=1e-10)
    right = rig.focal_px[0] * (x - rig.baseline_m) / z + 300 + rig.doffs_px
    np.testing.assert_allclose(right, columns - values.ravel(), atol=1e-10)


def test_the_error_of_depth_is_that_of_the_disparity():
    """First order: moving the disparity by its deviation moves the depth by its own, to (deviation / disparity)²."""
    values = np.full((2, 4), 20.0)
    cloud = cloud_from_disparity(values, None, FLAT, disparity_std_px=0.01)
    nearer = cloud_from_disparity(values + 0.01, None, FLAT)
    np.testing.assert_allclose(cloud.points[:, 2] - nearer.points[:, 2], cloud.depth_std, rtol=1e-3)


def test_fixed_point_disparities_are_refused():
    """Trap 1: OpenCV's matchers answer int16, sixteen times the disparity."""
    with pytest.raises(ValueError, match=r"int16.*divide by 16\.0"):
        cloud_from_disparity(np.full((2, 4), 320, np.int16), None, FLAT)


def test_unmatched_pixels_are_no_points():
    """Trap 2: unmatched, infinite and zero disparities are neither behind the camera nor at infinity."""
    values = np.array([[-1.0, 0.0, np.nan, np.inf], [5.0, -0.5, 10.0, 1e-9]])
    cloud = cloud_from_disparity(values, None, FLAT)
    np.testing.assert_allclose(cloud.points[:, 2], [2.0, 1.0, 1e10], rtol=1e-12)
    explicit = cloud_from_disparity(values, np.ones((2, 4), bool), dataclasses.replace(FLAT, doffs_px=1.0))
    # With an offset of 1 a disparity of -1 is at infinity, -0.5 and 0 are not.
    np.testing.assert_allclose(explicit.points[:, 2], 10 / (values.ravel()[[1, 4, 5, 6, 7]] + 1), rtol=1e-12)
    with pytest.raises(ValueError, match="no pixel is left"):
        cloud_from_disparity(np.full((2, 4), -1.0), None, FLAT)


def test_a_ready_depth_map():
    depth = np.array([[1.0, 0.0, np.nan, np.inf], [2.0, -1.0, 3.0, 1.0]], np.float32)
    cloud = cloud_from_depth(depth, None, FLAT)
    np.testing.assert_allclose(cloud.points[:, 2], [1, 2, 3, 1])
    np.testing.assert_allclose(cloud.depth_std, 0.2 * np.array([1, 4, 9, 1]) / 10, rtol=1e-6)
    assert cloud.points.dtype == jnp.float32
    given = cloud_from_depth(depth, depth > 1, FLAT, depth_std=0.01)
    np.testing.assert_allclose(given.depth_std, [0.01, 0.01], rtol=1e-6)
    same = cloud_from_disparity(np.array([[10, 0, 0, 0], [5, -10, 10 / 3, 10]], np.float32), None, FLAT)
    np.testing.assert_allclose(same.points, cloud.points, rtol=1e-6)


def test_arbitrary_units_are_said():
    rig = dataclasses.replace(FLAT, metric=False)
    assert cloud_from_disparity(np.ones((2, 4)), None, rig).status == Status.ARBITRARY_UNITS


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: cloud_from_disparity(np.ones((3, 4)), None, FLAT), r"2 rows and 4 columns, got 3 and 4; rig\.scaled"),
        (lambda: cloud_from_disparity(np.ones((2, 4, 1)), None, FLAT), r"shape \(H, W\)"),
        (lambda: cloud_from_disparity(np.ones((2, 4)), np.ones((4, 2), bool), FLAT), "valid must be booleans"),
        (lambda: cloud_from_disparity(np.ones((2, 4)), np.ones((2, 4)), FLAT), "valid must be booleans"),
        (lambda: cloud_from_disparity(np.ones((2, 4)), None, FLAT, image=np.ones((2, 4))), "image must be uint8"),
        (lambda: cloud_from_disparity(np.ones((2, 4)), None, FLAT, disparity_std_px=0.0), "disparity_std_px must be"),
        (
            lambda: cloud_from_disparity(np.ones((2, 4)), None, FLAT, disparity_std_px=np.ones(3)),
            "disparity_std_px must be",
        ),
    ],
)
def test_maps_that_do_not_fit(call, says):
    with pytest.raises(ValueError, match=says):
        call()


# Matching against exact truth


def test_disparities_of_a_rendered_pair(table, matched):
    """Bounds at twice what was measured (cover 0.99 of what both cameras see, 0.1 % wrong by 2 px, median 0.03 px)."""
    values, valid = matched
    assert values.dtype == np.float32
    assert valid.dtype == bool
    assert np.isnan(values[~valid]).all()
    error = np.abs(values - table.disparity_px)
    assert valid[table.visible].mean() > 0.98
    assert np.mean(error[valid] > 2) < 0.003
    assert np.mean(error[valid] > 1) < 0.006
    assert np.median(error[valid]) < 0.06
    objects = valid & (table.labels >= 0)
    assert objects.sum() > 0.95 * (table.visible & (table.labels >= 0)).sum()
    assert np.median(error[objects]) < 0.1


def test_points_are_metric_and_axes_are_those_of_opencv(table):
    """Traps 3, 12, 13: metres; y down, z forward, so that the table's normal points up at negative y and z."""
    cloud = reconstruct(table.left, table.right, table.rig)
    columns, rows = np.asarray(cloud.pixels_px, int).T
    on_table = (table.labels[rows, columns] < 0) & (table.depth_m[rows, columns] < 1.79)
    points = np.asarray(cloud.points, float)[on_table]
    normal = np.asarray(table.ground.normal)
    assert normal[1] < 0
    assert normal[2] < 0
    # The table is 1 m away, where 0.2 px is 4 mm of depth and 1.3 mm across this table.
    assert np.median(np.abs((points - np.asarray(table.ground.point)) @ normal)) < 0.0013
    truth = table.depth_m[rows, columns]
    pull = (np.asarray(cloud.points)[:, 2] - truth) / np.asarray(cloud.depth_std)
    # Rendered pairs match better than photographs (0.07 px on objects), so the told deviation is on the safe side.
    assert 0.1 < 1.4826 * np.median(np.abs(pull)) < 1.0
    assert cloud.status == 0


def test_an_offset_left_out_bends_spheres():
    """Trap 5: with doffs the sphere has its radius; taken for 0 it does not."""
    rig = dataclasses.replace(SMALL, doffs_px=20.0)
    ball = Sphere(center=np.array([0.0, 0.0, 0.8]), radius=np.array(0.12))
    picture = render_pair(Setting((ball,), paper_scene(0.0).ground), rig)
    on_ball = picture.labels == 0
    radius = {}
    for offset in (20.0, 0.0):
        seen = dataclasses.replace(rig, doffs_px=offset)
        points = np.asarray(cloud_from_disparity(picture.disparity_px, on_ball, seen).points, float)
        columns = np.c_[2 * points, np.ones(len(points))]
        solution = np.linalg.lstsq(columns, (points**2).sum(1), rcond=None)[0]
        radius[offset] = np.sqrt(solution[3] + solution[:3] @ solution[:3])
    assert radius[20.0] == pytest.approx(0.12, rel=1e-4)  # float32 disparities
    assert not 0.1 < radius[0.0] < 0.14


def test_resized_images_need_a_resized_rig(table):
    """Trap 6."""
    halves = [cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA) for image in (table.left, table.right)]
    with pytest.raises(ValueError, match=r"640 x 480, got 320 x 240; rig\.scaled\(\(320, 240\)\)"):
        disparity(*halves, table.rig)
    cloud = reconstruct(*halves, table.rig.scaled((320, 240)))
    columns, rows = np.asarray(cloud.pixels_px, int).T
    truth = cv2.resize(table.depth_m, (320, 240), interpolation=cv2.INTER_AREA)[rows, columns]
    assert np.median(np.abs(cloud.points[:, 2] / truth - 1)) < 0.005


def test_the_left_strip_is_answered(table, matched):
    """Trap 7: bare OpenCV answers nothing left of its largest disparity."""
    values, valid = matched
    low, count = search_range(*read_pair(table.left, table.right, table.rig), table.rig, Matcher())
    bare = cv2.StereoSGBM_create(low, count, 3).compute(table.left, table.right)
    assert not (bare[:, : low + count - 1] >= 16 * low).any()
    # Half a block and a pixel at the right image's side are left out, see the next test.
    whole = np.arange(640) - table.disparity_px >= 3
    strip = (table.visible & whole)[:, : low + count]
    assert strip.any()
    assert valid[:, : low + count][strip].mean() > 0.95
    error = np.abs(values - table.disparity_px)[:, : low + count]
    assert np.nanmedian(error) < 0.1


def test_blocks_that_hang_over_a_side_are_not_answered(table, matched):
    """Of 3 pixels, with one more for the slopes: two columns of either image; refinement moves a match by up to one."""
    values, valid = matched
    columns = np.broadcast_to(np.arange(640), values.shape)
    for at in (columns, columns - values):
        assert at[valid].min() >= 1
        assert at[valid].max() <= 638
    error = np.abs(values - table.disparity_px)
    # Refinement looks further than a block: a little worse is allowed, three times is what hanging blocks gave.
    assert np.nanquantile(error[columns - values < 5], 0.9) < 2 * np.nanquantile(error, 0.9)


def test_narrow_images_are_refused_and_answers_repeat():
    """Trap 8: on images hardly wider than block and range OpenCV's answers change from run to run."""
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (40, 60), np.uint8)
    rig = Rig((100, 100), (30, 20), 0.1, (60, 40))
    moved = np.roll(picture, -4, axis=1)
    with pytest.raises(ValueError, match="60 pixels wide and 40 high, too small for 80 disparities"):
        disparity(picture, moved, rig, matcher=Matcher(disparities=80, min_disparity=0))
    with pytest.raises(ValueError, match="blocks of 41"):
        disparity(picture, moved, rig, matcher=Matcher(method="bm", block=41))
    with pytest.raises(ValueError, match="at least 32 pixels wide and high, got 5 x 40"):
        disparity(picture[:, :5], picture[:, :5], dataclasses.replace(rig, image_size=None))
    first, *others = [disparity(picture, moved, rig) for _ in range(3)]
    for other in others:
        np.testing.assert_array_equal(first[0], other[0])
    np.testing.assert_allclose(np.median(first[0][first[1]]), 4, atol=0.05)


@pytest.mark.parametrize("width", [40, 48, 56, 64, 72])
def test_narrow_images_need_no_range(width):
    """The range that is looked for is never wider than the picture: a strip of 48 pixels was refused for 64 disparities."""
    left, right, rig = example_pair()
    left, right = (np.ascontiguousarray(cv2.imread(str(path))[:, :width]) for path in (left, right))
    narrow = dataclasses.replace(rig, image_size=(width, left.shape[0]))
    _, count = search_range(left, right, narrow, Matcher())
    assert count <= 16 * -(-width // 16)
    disparity(left, right, narrow)


def test_photographs_are_turned_as_their_files_say(tmp_path):
    """As `cv2.imread` does: a camera held upside down writes so into its JPEG files."""
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:10] = 255
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    # A TIFF directory of one entry: orientation 3.
    tag = b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<HHHIHHI", 1, 0x112, 3, 1, 3, 0, 0)
    path = tmp_path / "turned.jpg"
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(tag) + 2) + tag + data[2:])
    turned = cv2.imread(str(path))
    assert turned[-5:].min() > 200
    rig = Rig((100, 100), (30, 20), 0.1, (60, 40))
    np.testing.assert_array_equal(read_pair(path, turned, rig)[0], turned)


def test_fractions_are_neither_truncated_nor_on_a_grid(table, matched):
    """Trap 9: the matcher answers sixteenths, a wall at 31.11 px comes out at 31.06; refined it does not."""
    values, valid = matched
    rough = np.asarray(disparity(table.left, table.right, table.rig, matcher=Matcher(refine=False))[0])
    wall = valid & (table.depth_m == np.float32(1.8))
    assert np.all(rough[wall] * 16 % 1 == 0)
    assert abs(np.median(rough[wall]) - 31.1111) > 0.04
    assert abs(np.median(values[wall]) - 31.1111) < 0.015
    objects = valid & (table.labels >= 0)
    deviation = {
        name: np.median(np.abs(map_ - table.disparity_px)[objects])
        for name, map_ in (("rough", rough), ("fine", values))
    }
    # Measured 0.128 and 0.045.
    assert deviation["fine"] < 0.5 * deviation["rough"]


def test_the_left_right_check_checks(table):
    """Trap 10: OpenCV's own disp12MaxDiff cannot be switched off and is left alone; the library's check can."""
    picture = small(noise=8.0)
    hidden = ~picture.visible
    cover = {}
    for limit in (None, 1.0, 0.25):
        _, valid = disparity(
            picture.left, picture.right, SMALL, matcher=Matcher(left_right_px=limit, edge_px=0, speckle_px=0)
        )
        cover[limit] = np.asarray(valid)[hidden].mean()
    assert cover[None] > 1.5 * cover[1.0] > 1.5 * cover[0.25]


def test_edge_bleeding_is_eroded(table):
    """Trap 11: pixels just outside an object take its disparity; eroding removes more wrong pixels than it costs."""
    truth = table.disparity_px
    wrong, lost = {}, {}
    for radius in (0, 2):
        values, valid = map(np.asarray, disparity(table.left, table.right, table.rig, matcher=Matcher(edge_px=radius)))
        wrong[radius] = (np.abs(values - truth)[valid] > 1).mean()
        lost[radius] = 1 - valid[table.visible].mean()
    assert wrong[2] < 0.75 * wrong[0]  # measured 0.62
    assert lost[2] - lost[0] < 0.01


@pytest.mark.parametrize("method", ["hh", "bm"])
def test_other_methods(method):
    picture = small()
    values, valid = map(np.asarray, disparity(picture.left, picture.right, SMALL, matcher=Matcher(method=method)))
    assert valid[picture.visible].mean() > (0.95 if method == "hh" else 0.5)
    assert np.median(np.abs(values - picture.disparity_px)[valid]) < 0.1


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("gain", "offset"), [(0.6, 10.0), (1.4, -10.0)])
def test_brightness_of_one_camera_may_differ(channels, gain, offset):
    """Smooth surfaces have no match at other grey levels: at 0.6 times the light 0.63 of the pixels were answered, alike 0.97."""
    plain, other = (small(contrast=0.08, noise=1.0, **levels) for levels in ({}, {"gain": gain, "offset": offset}))
    found = []
    for picture in (plain, other):
        pair = [image if channels == 1 else cv2.merge([image] * 3) for image in (picture.left, picture.right)]
        values, valid = map(np.asarray, disparity(*pair, SMALL))
        found.append((valid[picture.visible].mean(), np.median(np.abs(values - picture.disparity_px)[valid])))
    assert found[1][0] > found[0][0] - 0.02
    # Of the darker image the noise is as large as of the other, and its texture less.
    assert found[1][1] < found[0][1] / min(gain, 1.0)


def test_the_usual_error_grows_with_rows_beyond_those_it_was_measured_at():
    for rows, expected in ((100, 0.2), (560, 0.2), (1500, 0.2 * 1500 / 560)):
        assert usual_std_px(rows) == pytest.approx(expected)
        values, rig = np.full((rows, 4), 8.0), dataclasses.replace(FLAT, image_size=None)
        cloud = cloud_from_disparity(values, None, rig)
        of_one_px = rig.focal_px[0] * rig.baseline_m / 8.0**2
        np.testing.assert_allclose(np.asarray(cloud.depth_std) / np.asarray(cloud.depth_std)[0], 1, rtol=0.1)
        middle = np.abs(np.asarray(cloud.pixels_px) - np.array(rig.center_px)).sum(axis=1).argmin()
        np.testing.assert_allclose(np.asarray(cloud.depth_std)[middle], expected * of_one_px, rtol=0.02)
        given = cloud_from_disparity(values, None, rig, disparity_std_px=Matcher(disparity_std_px=0.3).disparity_std_px)
        np.testing.assert_allclose(np.asarray(given.depth_std)[middle], 0.3 * of_one_px, rtol=0.02)


@pytest.mark.parametrize("spoilt", ["noise", "compressed", "clean"])
def test_disparities_that_noise_leaves_rough_are_smoothed_further(table, spoilt, monkeypatch):
    """Of the error that noise of 6 grey levels or JPEG of quality 50 leaves, 30 and 34 % go (measured), and more is answered."""
    random = np.random.default_rng(0)
    change = {
        "noise": lambda image: np.clip(np.rint(image + random.normal(0, 6, image.shape)), 0, 255).astype(np.uint8),
        "compressed": lambda image: cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 50])[1], 1),
        "clean": lambda image: image,
    }[spoilt]
    left, right = (change(image) for image in (table.left, table.right))
    deviation, answered = [], []
    for least in (stereo.ROUGH, np.inf):
        monkeypatch.setattr(stereo, "ROUGH", least)
        values, valid = map(np.asarray, disparity(left, right, table.rig))
        error = (values - table.disparity_px)[valid & table.visible]
        deviation.append(np.median(np.abs(error - np.median(error))))
        answered.append(valid.sum())
    if spoilt == "clean":
        assert deviation[0] == deviation[1]
    else:
        assert deviation[0] < 0.75 * deviation[1]
        assert answered[0] > answered[1]


def test_levels_of_matching_pixels_by_hand():
    levels = np.arange(0.0, 200.0)[:, None]
    line = line_between(levels, 0.8 * levels + 12)
    np.testing.assert_allclose(np.concatenate(line), [0.8, 12], rtol=1e-6)
    image = np.full((2, 2), 100, np.uint8)
    # The brighter one stays: 100 of the left is (100 - 12) / 0.8 of the right.
    left, right = evened(image, image, line)
    assert (left == 110).all()
    assert right is image
    left, right = evened(image, image, Line(1 / line.gain, -line.offset / line.gain))
    assert left is image
    assert (right == 110).all()


@pytest.mark.parametrize("other", [np.full((50, 1), 7.0), np.arange(50.0)[:, None] * 40])
def test_levels_that_say_nothing_change_nothing(other):
    """One grey, or forty times the contrast: no line leads from the one to the other."""
    for levels in ((other, np.arange(50.0)[:, None]), (np.arange(50.0)[:, None], other)):
        np.testing.assert_array_equal(np.concatenate(line_between(*levels)), [1, 0])


def test_color_is_matched_too(table):
    tinted = [cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in (table.left, table.right)]
    values, valid = map(np.asarray, disparity(*tinted, table.rig))
    assert valid[table.visible].mean() > 0.98
    assert np.median(np.abs(values - table.disparity_px)[valid]) < 0.06
    cloud = reconstruct(*tinted, table.rig)
    assert cloud.colors.shape == cloud.points.shape


# The noise of disparities


@pytest.mark.parametrize("reach", [1, 5, 9])
@pytest.mark.parametrize("known", [False, True])
def test_noise_of_a_plane_by_construction(reach, known):
    """White noise averaged over squares of n pixels is correlated over exactly n² of them; a fifth is wrong altogether."""
    rng = np.random.default_rng(reach)
    noise = cv2.blur(rng.normal(size=(480, 640)), (reach, reach)) * reach * 0.3
    columns, rows = np.meshgrid(np.arange(640), np.arange(480))
    truth = 30 + 0.02 * columns - 0.05 * rows
    values = truth + noise
    wrong = rng.uniform(size=values.shape) < 0.2
    values[wrong] += rng.uniform(-20, 20, wrong.sum())
    mask = columns > 100
    found = measure_noise(values, mask, truth_px=truth if known else None)
    # A fifth of wrong pixels widens the median deviation, and dilutes the correlation of what is left beside it.
    assert found.std_px == pytest.approx(0.3, rel=0.35)
    clean = measure_noise(truth + noise, mask, truth_px=truth if known else None)
    assert clean.std_px == pytest.approx(0.3, rel=0.03)
    # About 280 blocks: their variance is known to 8 %, and blocks of 32 lose a little of the longest reach at their rim.
    assert clean.pixels_per_point == pytest.approx(reach**2, rel=0.25)
    with pytest.raises(DataError, match="at least 100 pixels"):
        measure_noise(values, mask & (rows < 0))
    with pytest.raises(DataError, match="half of 4 blocks"):
        measure_noise(values, (rows < 32) & (columns < 64))
    for arguments, says in (
        ({"mask": mask[:3]}, "mask must be booleans"),
        ({"truth_px": truth[:3]}, "truth_px must have the shape of disparity_px"),
        ({"block": 1}, "block must be at least 2"),
    ):
        with pytest.raises(ValueError, match=says):
            measure_noise(values, **{"mask": mask} | arguments)
    exact = measure_noise(truth, mask, truth_px=truth)
    assert (exact.std_px, exact.pixels_per_point) == (0.0, 1.0)


def test_noise_of_a_rendered_table_is_that_against_its_truth(table, matched):
    values, valid = matched
    mask = valid & (table.labels < 0) & (table.depth_m < 1.79)
    plane, truth = measure_noise(values, mask), measure_noise(values, mask, truth_px=table.disparity_px)
    assert plane.std_px == pytest.approx(truth.std_px, rel=0.2)
    assert plane.pixels_per_point == pytest.approx(truth.pixels_per_point, rel=0.5)
    assert truth.pixels_per_point > 2, "disparities of neighbors are not independent"


# The range of disparities


def test_range_comes_from_the_scene():
    for tilt, seed in ((0.0, 1), (0.6, 2)):
        picture = small(seed, tilt=tilt)
        low, count = search_range(picture.left, picture.right, picture.rig, Matcher())
        seen = picture.disparity_px[picture.visible]
        # Two thousandths of the coarse matches may be left out at either end.
        assert low <= np.percentile(seen, 0.3)
        assert low + count > np.percentile(seen, 99.7)
        assert count <= 2 * (seen.max() - seen.min()) + 32
    assert search_range(picture.left, picture.right, picture.rig, Matcher(min_disparity=5, disparities=48)) == (5, 48)
    # Too small a range: what lies outside is matched wrongly, so it is told.
    with pytest.warns(
        UserWarning, match=r"disparities of 5 to 21 px are searched, but \d+ % of the picture has others, from"
    ):
        search_range(picture.left, picture.right, picture.rig, Matcher(min_disparity=5, disparities=16))
    with pytest.warns(UserWarning, match="disparities of 30 to"):
        search_range(picture.left, picture.right, picture.rig, Matcher(min_disparity=30))
    low, count = search_range(picture.left, picture.right, picture.rig, Matcher(min_disparity=5))
    assert low == 5
    assert low + count > np.percentile(seen, 99.7)


def test_an_offset_allows_negative_disparities():
    rig = dataclasses.replace(SMALL, doffs_px=30.0)  # the wall is then at -14.4 px
    picture = render_pair(table_scene(3, rig=SMALL), rig)
    assert picture.disparity_px.min() < -14
    values, valid = map(np.asarray, disparity(picture.left, picture.right, rig))
    assert valid[picture.visible].mean() > 0.9
    assert np.median(np.abs(values - picture.disparity_px)[valid]) < 0.1


def test_rigs_bound_is_kept():
    picture = small()
    bounded = dataclasses.replace(SMALL, max_disparity_px=25.0)
    low, count = search_range(picture.left, picture.right, bounded, Matcher())
    assert low + count < 25 + 16
    assert picture.disparity_px.max() > 35
    unbounded = search_range(picture.left, picture.right, SMALL, Matcher())
    assert sum(unbounded) > picture.disparity_px.max()


# Swapped, misaligned and empty pairs


def test_swapped_images_are_noticed(table):
    with pytest.raises(DataError, match=r"swapped.*min_disparity"):
        reconstruct(table.right, table.left, table.rig)
    left, right, rig = example_pair()
    for match in (reconstruct, disparity):
        with pytest.raises(DataError, match="swapped"):
            match(right, left, rig)
        with pytest.raises(DataError, match="the same picture"):
            match(left, left, rig)


@pytest.mark.parametrize(
    ("roll", "zoom", "told"), [(0.0, 1.0, False), (1.0, 1.0, True), (-2.0, 1.0, True), (0.0, 1.02, True)]
)
def test_rolled_or_zoomed_cameras_are_told(roll, zoom, told):
    """Rows then match in the middle of the picture and nowhere else: the mean of all says nothing."""
    left, right, rig = example_pair()
    left, right = cv2.imread(str(left)), cv2.imread(str(right))
    height, width = right.shape[:2]
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), roll, zoom)
    turned = cv2.warpAffine(right, turn, (width, height), borderMode=cv2.BORDER_REFLECT)
    found = alignment(left, turned)
    corner = abs(np.deg2rad(roll)) * width / 2 + (zoom - 1) * height / 2
    # What is surely so lies below it by two standard errors, about 0.4 px each.
    assert corner - 1.2 < found.corners_px < corner + 0.4
    assert bool(reconstruct(left, turned, rig).status & Status.MISALIGNED) == told


@pytest.mark.parametrize(("down", "told"), [(0.0, False), (0.3, False), (1.5, True), (-2.0, True)])
def test_rows_that_differ_are_measured_and_told(down, told):
    picture = small(vertical_px=down)
    found = alignment(picture.left, picture.right)
    assert found.rows_px == pytest.approx(down, abs=0.4)
    assert not found.swapped
    cloud = reconstruct(picture.left, picture.right, picture.rig)
    assert bool(cloud.status & Status.MISALIGNED) == told
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        disparity(picture.left, picture.right, picture.rig)
    assert any("Rows of the two images do not match" in str(one.message) for one in caught) == told


def test_nothing_is_said_about_rows_where_features_repeat(shared_data):
    """A chessboard's corners match each other anywhere; rectified photographs of one are not called misaligned for that."""
    folder = shared_data / "opencv_chessboard"
    lefts = sorted(folder.glob("left[0-9]*.jpg"))
    rights = [path.with_name(path.name.replace("left", "right")) for path in lefts]
    rig = calibrate(lefts, rights, square_m=0.025)
    for left, right in zip(lefts, rights, strict=True):
        found = alignment(*rectify(left, right, rig)[:2])
        assert abs(found.rows_px) < 0.5
        assert found.corners_px == 0
        assert not found.swapped


def test_rows_far_apart_are_named_as_the_reason():
    picture = small(vertical_px=-6.0)
    with pytest.raises(DataError, match=r"rectified \(rows differ by -[56]\.\d px\)"):
        reconstruct(picture.left, picture.right, SMALL)


def test_nothing_to_match_is_one_sentence():
    blank = np.full((240, 320), 90, np.uint8)
    for matcher in (Matcher(), Matcher(min_disparity=16, disparities=32), Matcher(left_right_px=None)):
        with pytest.raises(DataError, match="0 of 76800 pixels were matched, 50 are needed"):
            reconstruct(blank, blank, SMALL, matcher=matcher)
    noise = np.random.default_rng(0).integers(0, 255, (2, 240, 320), np.uint8)
    with pytest.raises(DataError, match="no common features"):
        reconstruct(*noise, SMALL)


def test_few_matches_are_told():
    picture = small()
    left = np.full_like(picture.left, 90)
    right = left.copy()
    left[100:150, 100:160] = picture.left[100:150, 100:160]
    right[100:150, 60:160] = picture.right[100:150, 60:160]
    assert reconstruct(left, right, SMALL).status & Status.FEW_MATCHES


# Raw pairs


def view(setting, rig, which):
    """A raw photograph by a turned camera with a lens, rendered ray by ray."""
    from jaxfuzzy.render import look

    focal, center = ((rig.focal_px, rig.center_px), (rig.right_focal_px, rig.right_center_px))[which]
    camera = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])
    width, height = rig.image_size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(np.float64)
    straight = cv2.undistortPoints(pixels, camera, np.array(rig.distortion[which])).reshape(height, width, 2)
    rays = np.concatenate([straight, np.ones((height, width, 1))], axis=-1)
    eye = np.zeros(3)
    if which:
        rotation, translation = np.array(rig.rotation), np.array(rig.translation)
        rays, eye = rays @ rotation, -rotation.T @ translation
    return look(setting, rays.astype(np.float32), eye, 1.0, 1.8, 0)


def test_raw_pairs_are_rectified():
    """Turned cameras with lenses: rows agree afterwards, and points lie on the table in the turned left camera's frame."""
    rotation = cv2.Rodrigues(np.array([0.01, -0.03, 0.02]))[0]
    translation = np.array([-0.08, 0.003, 0.002])
    raw = Rig(
        (350.0, 352.0), (157.0, 121.0), float(np.linalg.norm(translation)), (320, 240),
        right_focal_px=(348.0, 349.0), right_center_px=(162.0, 118.0), rotation=rotation, translation=translation,
        distortion=((-0.15, 0.03, 0.001, -0.001, 0.0), (-0.12, 0.02, 0.0, 0.001, 0.0)),
    )  # fmt: skip
    setting = table_scene(3, rig=SMALL)
    left, right = (np.clip(view(setting, raw, which)[2], 0, 255).astype(np.uint8) for which in (0, 1))
    with pytest.raises(ValueError, match="rig must be rectified for matching"):
        disparity(left, right, raw)
    straight_left, straight_right, straight = rectify(left, right, raw)
    assert straight.rectified
    assert straight.baseline_m == pytest.approx(raw.baseline_m, rel=1e-9)
    assert abs(alignment(straight_left, straight_right).rows_px) < 0.3
    cloud = reconstruct(left, right, raw)
    assert not cloud.status & Status.MISALIGNED
    # The rectified left frame is turned against the raw one; OpenCV's R1 says how.
    camera = [np.array([[f[0], 0, c[0]], [0, f[1], c[1]], [0, 0, 1]]) for f, c in (
        (raw.focal_px, raw.center_px), (raw.right_focal_px, raw.right_center_px))]  # fmt: skip
    lenses = [np.array(lens) for lens in raw.distortion]
    turn = cv2.stereoRectify(
        camera[0], lenses[0], camera[1], lenses[1], (320, 240), rotation, translation[:, None], alpha=0
    )[0]
    points = np.asarray(cloud.points, float) @ turn
    near = points[:, 2] < 1.7
    off = np.abs((points - np.asarray(setting.ground.point)) @ np.asarray(setting.ground.normal))[near]
    # At half the size 0.1 px is 4 mm of depth, and most of what is nearer than the wall is table.
    assert np.median(off) < 0.004
    with pytest.raises(ValueError, match="rectified already"):
        rectify(straight_left, straight_right, straight)


# Images of every kind


def test_sixteen_bits_floats_alpha_and_grey(table):
    left, right = table.left, table.right
    opaque = np.dstack([left, left, left, np.full_like(left, 255)])
    for pair in (
        (left.astype(np.uint16) * 16, right.astype(np.uint16) * 16),
        (left / 255, right / 255),
        (left.astype(np.float32), right.astype(np.float32)),
        (opaque, right),
        (left[:, :, None], jnp.asarray(right)),
    ):
        one, other = read_pair(*pair, table.rig)
        assert one.dtype == other.dtype == np.uint8
        assert one.ndim == other.ndim == 2
        gain = np.polyfit(left[::7, ::7].ravel().astype(float), one[::7, ::7].ravel().astype(float), 1)[0]
        other_gain = np.polyfit(right[::7, ::7].ravel().astype(float), other[::7, ::7].ravel().astype(float), 1)[0]
        assert gain == pytest.approx(other_gain, rel=1e-2), "the two images were scaled differently"
    one, other = read_pair(left.astype(np.uint16) * 16, right.astype(np.uint16) * 4, table.rig)
    assert other.mean() < 0.3 * one.mean(), "the darker image was brightened"
    hot = left.astype(np.uint16) * 4
    hot[3, 5] = 65535
    assert read_pair(hot, right.astype(np.uint16) * 4, table.rig)[0].mean() > 0.9 * left.mean(), (
        "one pixel made all dark"
    )


GREY = np.zeros((240, 320), np.uint8)


@pytest.mark.parametrize(
    ("left", "right", "error", "says"),
    [
        (GREY, GREY[:, :300], ValueError, "same size, got 320 x 240 and 300 x 240"),
        (GREY[:100], GREY[:100], ValueError, "320 x 240, got 320 x 100"),
        (GREY.astype(np.int32), GREY, ValueError, "left must be uint8, uint16 or floating point, got int32"),
        (GREY > 0, GREY, ValueError, "got bool"),
        (GREY, GREY.astype(np.uint16), ValueError, "same type, got uint8 and uint16"),
        (GREY, np.full(GREY.shape, np.nan), ValueError, "right must be finite"),
        (GREY - 1.0, GREY, ValueError, "left must be finite and not negative"),
        (np.zeros((240, 320, 2), np.uint8), GREY, ValueError, r"left must be grey .* got shape \(240, 320, 2\)"),
        (np.zeros((240, 320, 4), np.uint8), GREY, ValueError, "left has transparent pixels"),
        (np.zeros((0, 320), np.uint8), GREY, ValueError, r"got shape \(0, 320\)"),
        (None, GREY, TypeError, "left must be an image or a path, got None"),
        ("no/such.png", GREY, FileNotFoundError, "left image not found: no/such.png"),
        (__file__, GREY, ValueError, "left is not an image that can be read"),
    ],
)
def test_images_that_cannot_be_used(left, right, error, says):
    """Trap 17, before OpenCV's own assertions."""
    with pytest.raises(error, match=says) as caught:
        reconstruct(left, right, SMALL)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "error", "says"),
    [
        ({"disparities": 40}, ValueError, "multiple of 16, got 40"),
        ({"disparities": 0}, ValueError, "disparities must be at least 16"),
        ({"block": 4}, ValueError, "block must be odd, got 4"),
        ({"block": 13}, ValueError, "block with method='sgbm' must be at least 1 and at most 11"),
        ({"block": 53, "method": "bm"}, ValueError, "at most 51"),
        ({"smoothness": (5, 700)}, ValueError, "smoothness must be at most 607 with block=3"),
        ({"smoothness": (5, np.inf)}, ValueError, "smoothness must be at most"),
        ({"min_disparity": -4096}, ValueError, "min_disparity must be at least -2047"),
        ({"method": "fast"}, ValueError, "method must be one of 'sgbm', 'hh', 'bm', got 'fast'"),
        ({"smoothness": (8, 8)}, ValueError, "0 < first < second"),
        ({"smoothness": 5}, ValueError, "smoothness must be two prices"),
        ({"refine": "no"}, TypeError, "refine must be True or False"),
        ({"left_right_px": 0.0}, ValueError, "left_right_px must be a finite number above 0"),
        ({"min_disparity": 1.5}, TypeError, "min_disparity must be a whole number"),
        ({"disparity_std_px": -1}, ValueError, "disparity_std_px must be"),
        # OpenCV divides by what is left of a hundred.
        ({"uniqueness": 100}, ValueError, "uniqueness must be at least 0 and at most 99"),
    ],
)
def test_settings_that_cannot_be(settings, error, says):
    with pytest.raises(error, match=says):
        Matcher(**settings)


@pytest.mark.parametrize(
    "matcher", [Matcher(method="bm", smoothness=(5, 5000)), Matcher(block=1, smoothness=(5, 5000))]
)
def test_prices_of_other_blocks_do_not_reach_the_coarse_look(table, matcher):
    usual, own = (search_range(table.left, table.right, table.rig, m) for m in (Matcher(), matcher))
    assert own == usual
    disparity(table.left, table.right, table.rig, matcher=matcher)


def test_disparities_beyond_what_opencv_can_say_are_refused():
    picture = np.random.default_rng(0).integers(0, 255, (48, 4600), np.uint8)
    rig = Rig((4000, 4000), (2300, 24), 0.5, (4600, 48))
    with pytest.raises(ValueError, match="disparities of 2032 to 2096 pixels are beyond the 2047"):
        disparity(picture, np.roll(picture, -2040, 1), rig, matcher=Matcher(min_disparity=2032, disparities=64))


# Ready disparities


def test_multiples_of_pixels_are_told_and_millimetres_refused():
    values = np.full((2, 4), 8.0)
    for name, wrong in (("OpenCV", 16 * values), ("KITTI", (256 * values).astype(np.uint16))):
        with pytest.warns(UserWarning, match=f"disparities are mostly above the 4 px that the image is wide.*{name}"):
            cloud_from_disparity(wrong, None, FLAT)
    with pytest.raises(ValueError, match=r"depth_m must be in metres, got uint16.* multiply by 0\.001"):
        cloud_from_depth((1000 * values).astype(np.uint16), None, FLAT)


def test_a_center_outside_the_picture_is_told():
    """Of pictures a quarter as large as the rig's, where that does not know its size."""
    values = np.full((2, 4), 8.0)
    with pytest.warns(UserWarning, match=r"center, \(9\.0, 0\.5\), lies outside the 4 x 2 pixels.*scaled"):
        cloud_from_disparity(values, None, dataclasses.replace(FLAT, image_size=None, center_px=(9.0, 0.5)))


@pytest.mark.parametrize("wrong", [np.nan, 0.0, -0.2])
def test_maps_of_errors_are_checked_where_they_count(wrong):
    values, errors = np.full((2, 4), 3.0), np.full((2, 4), 0.2)
    errors[1, 2] = wrong
    with pytest.raises(ValueError, match="disparity_std_px must be finite and above 0"):
        cloud_from_disparity(values, None, FLAT, disparity_std_px=errors)
    with pytest.raises(ValueError, match="depth_std must be finite and above 0"):
        cloud_from_depth(values, None, FLAT, depth_std=errors)
    values[1, 2] = np.nan
    assert len(cloud_from_disparity(values, None, FLAT, disparity_std_px=errors).points) == 7


def test_encodings_of_ready_disparities(tmp_path):
    """Trap 14: scaled PNG with 0 unknown, PFM from the bottom with infinity unknown and a scale that is none, NPZ."""
    truth = np.array([[1.25, np.nan, 3.5], [4.0, 5.75, 6.0]], np.float32)
    cv2.imwrite(str(tmp_path / "a.png"), np.nan_to_num(truth * 4).astype(np.uint8))
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.png", scale=4), truth)
    cv2.imwrite(
        str(tmp_path / "color.png"), np.repeat(np.nan_to_num(truth * 8).astype(np.uint8)[:, :, None], 3, axis=2)
    )
    np.testing.assert_array_equal(read_disparity(tmp_path / "color.png", scale=8), truth)
    for head, order in (
        ("Pf\n3 2\n-0.003922\n", "<"),
        ("Pf\n3 2\n1.0\n", ">"),
        ("Pf\r\n3 2\r\n-1.0\r\n", "<"),
        ("Pf\n# by hand, 9 9\n3 2\n-1\n", "<"),
    ):
        body = np.where(np.isnan(truth), np.inf, truth)[::-1].astype(f"{order}f4").tobytes()
        (tmp_path / "a.pfm").write_bytes(head.encode() + body)
        np.testing.assert_array_equal(read_disparity(tmp_path / "a.pfm"), truth)
    np.savez(tmp_path / "a.npz", np.where(np.isnan(truth), np.inf, truth))
    np.testing.assert_array_equal(read_disparity(tmp_path / "a.npz"), truth)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"Pf\n300 200\n-1\n" + struct.pack("<f", 1.0), "cut short: 300 x 200"),
        (b"PF\n3 2\n-1\n" + bytes(72), "not a PFM file of one channel"),
        (b"Pf\n3 2\n-1\n" + bytes(25), "longer than it says: 3 x 2"),
        (b"Pf\n3 2\n0\n" + bytes(24), "not a PFM file of one channel"),
        (b"Pf\n3 2\n-e\n" + bytes(24), "not a PFM file of one channel"),
        (b"Pf" + b" " * 100_000 + b"x", "not a PFM file of one channel"),
        (b"hello", "no image, PFM, NPY or NPZ"),
        (b"PK\x03\x04", "disparity"),
    ],
)
def test_damaged_disparity_files(tmp_path, data, says):
    (tmp_path / "bad").write_bytes(data)
    with pytest.raises(ValueError, match=says):
        read_disparity(tmp_path / "bad")


def test_opencvs_fixed_point_needs_its_scale(tmp_path):
    np.save(tmp_path / "raw.npy", np.full((2, 3), 160, np.int16))
    with pytest.raises(ValueError, match="is OpenCV's fixed point: give scale=16"):
        read_disparity(tmp_path / "raw.npy")
    np.testing.assert_array_equal(read_disparity(tmp_path / "raw.npy", scale=16), np.full((2, 3), 10))


def test_depth_maps(tmp_path):
    cv2.imwrite(str(tmp_path / "depth.png"), np.array([[0, 1500], [250, 4000]], np.uint16))
    expected = np.array([[np.nan, 1.5], [0.25, 4.0]], np.float32)
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.png", scale=1000), expected)
    with pytest.raises(ValueError, match=r"holds uint16.*give scale=1000"):
        read_depth(tmp_path / "depth.png")
    np.save(tmp_path / "depth.npy", np.full((2, 3), 1500, np.int16))
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.npy", scale=1000), np.full((2, 3), 1.5))
    with pytest.raises(FileNotFoundError, match="depth not found"):
        read_depth(tmp_path / "none.png")


# Photographs


def test_the_bundled_pair_is_middleburys_and_comes_out_metric(shared_data):
    """Trap 15: other copies of this pair have other pixels."""
    left, right, rig = example_pair()
    original = shared_data / "middlebury2003_cones"
    for path in (left, right):
        assert (
            hashlib.sha256(path.read_bytes()).digest() == hashlib.sha256((original / path.name).read_bytes()).digest()
        )
    cloud = reconstruct(left, right, rig)
    assert cloud.status == 0
    # Disparities of 12 to 55 px, an offset of 52 px.
    near, far = np.percentile(np.asarray(cloud.points)[:, 2], [1, 99])
    assert 1.1 < near < far < 1.9


def test_a_ball_is_not_flattened(shared_data):
    """The price of a one-pixel step holds slanted sides flat: at 8 the radius comes out 3.1 % too large, at 5 1.3 %."""
    folder = shared_data / "middlebury2006_bowling1_half"
    rig, truth = load_rig(folder / "calib.txt"), read_disparity(folder / "disp1.png", scale=2)
    values, valid = map(np.asarray, disparity(folder / "view1.png", folder / "view5.png", rig))
    rows, columns = np.indices(truth.shape)
    ball = (np.hypot(columns - 270, rows - 225) < 140) & valid & (np.abs(values - truth) < 1.5)
    radii = []
    for seen in (values, truth):
        p = np.asarray(cloud_from_disparity(np.where(ball, seen, np.nan), ball, rig).points, float)
        solved = np.linalg.lstsq(np.column_stack([2 * p, np.ones(len(p))]), (p * p).sum(axis=1), rcond=None)[0]
        radii.append(np.sqrt(solved[3] + solved[:3] @ solved[:3]))
    assert ball.sum() > 55_000
    assert radii[0] / radii[1] == pytest.approx(1, abs=0.02)


def test_the_bundled_pair_against_ground_truth(shared_data):
    """At least 0.84 of the known pixels answered, at most 4.5 % of them wrong by 2 px; without the check 0.90 and 6 %."""
    left, right, rig = example_pair()
    truth = read_disparity(shared_data / "middlebury2003_cones" / "disp2.png", scale=4)
    for matcher, least, most in ((Matcher(), 0.84, 0.045), (Matcher(left_right_px=None, edge_px=0), 0.90, 0.06)):
        values, valid = map(np.asarray, disparity(left, right, rig, matcher=matcher))
        known = np.isfinite(truth)
        answered = known & valid
        assert answered.sum() / known.sum() > least
        assert np.mean(np.abs(values - truth)[answered] > 2) < most
