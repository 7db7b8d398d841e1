"""The renderer: depths by hand and by the primitives' own distance, disparities by the pictures themselves."""

import cv2
import numpy as np
import pytest

from jaxfuzzy.primitives import Box, Cone, Cylinder, Plane, Sphere
from jaxfuzzy.render import RIG, Setting, body_of, paper_scene, render_pair, table_scene
from jaxfuzzy.rig import Rig

SMALL = Rig((175.0, 180.0), (79.0, 61.0), 0.08, (160, 120), doffs_px=3.0)


def points_of(picture):
    height, width = picture.depth_m.shape
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    rig = picture.rig
    return np.stack(
        [
            (columns - rig.center_px[0]) / rig.focal_px[0] * picture.depth_m,
            (rows - rig.center_px[1]) / rig.focal_px[1] * picture.depth_m,
            picture.depth_m,
        ],
        axis=-1,
    )


def some(points):
    """A hundred of them, spread: the same number for each object, so that distances compile once a kind."""
    assert len(points) > 100
    return points[np.linspace(0, len(points) - 1, 100).astype(int)]


@pytest.fixture(scope="module")
def scene():
    return render_pair(table_scene(1, tilt=0.4, rig=SMALL), SMALL, noise=0.0)


def test_every_pixel_lies_on_the_surface_it_is_said_to_lie_on(scene):
    points = points_of(scene).astype(float)
    assert {type(primitive) for primitive in scene.objects} == {Box, Cylinder, Cone, Sphere}
    for index, primitive in enumerate(scene.objects):
        own = some(points[scene.labels == index])
        # Depths are float32 of about a metre.
        assert np.abs(primitive.distance(own)).max() < 2e-6, primitive
    rest = points[scene.labels < 0]
    table = np.abs((rest - np.asarray(scene.ground.point)) @ np.asarray(scene.ground.normal))
    wall = np.abs(rest[:, 2] - 1.8)
    assert np.minimum(table, wall).max() < 2e-6
    assert (table < 1e-5).any()
    assert (wall < 1e-5).any()


def test_objects_stand_on_the_table_and_the_nearest_surface_is_seen(scene):
    points = points_of(scene).astype(float)
    up, foot = np.asarray(scene.ground.normal), np.asarray(scene.ground.point)
    for index, primitive in enumerate(scene.objects):
        vertices = np.asarray(primitive.mesh()[0], float)
        heights = (vertices - foot) @ up
        assert heights.min() == pytest.approx(0, abs=2e-3), "a mesh of a sphere does not quite touch"
        # Before an object's own surface there is nothing: halfway to the camera every other body is outside the ray.
        own = some(points[scene.labels == index])
        for other in scene.objects:
            if other is not primitive:
                shorter = own[:, None] * np.linspace(0.5, 0.98, 12)[None, :, None]
                assert np.asarray(other.distance(shorter.reshape(-1, 3))).min() > 1e-4


def test_frusta_and_leaning_bodies(scene):
    """Any axis, a cone cut at both ends, a box with mirrored axes."""
    axis = np.array([0.6, -0.64, 0.48])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    bodies = (
        Cone(apex=np.array([-0.25, 0.0, 0.8]), axis=axis, half_angle=np.array(0.4), height=np.array([0.08, 0.2])),
        Cylinder(base=np.array([0.1, 0.1, 0.8]), axis=-axis, radius=np.array(0.05), height=np.array(0.2)),
        Box(center=np.array([0.15, -0.1, 0.9]), size=np.array([0.1, 0.15, 0.2]), axes=turn, seen=np.ones(3, bool)),
        Box(center=np.array([-0.1, -0.12, 0.9]), size=np.array([0.1, 0.15, 0.2]), axes=-turn, seen=np.ones(3, bool)),
    )
    picture = render_pair(Setting(bodies, scene.ground), SMALL, noise=0.0)
    points = points_of(picture).astype(float)
    for index, primitive in enumerate(bodies):
        assert np.abs(primitive.distance(some(points[picture.labels == index]))).max() < 2e-6, primitive


def test_a_ball_straight_ahead_by_hand():
    ball = Sphere(center=np.array([0.0, 0.0, 1.0]), radius=np.array(0.2))
    rig = Rig((100.0, 100.0), (50.0, 40.0), 0.1, (101, 81))
    picture = render_pair(Setting((ball,), paper_scene(0.0).ground), rig, noise=0.0)
    assert picture.depth_m[40, 50] == pytest.approx(0.8, abs=1e-6)
    assert picture.disparity_px[40, 50] == pytest.approx(100 * 0.1 / 0.8, rel=1e-6)
    # The silhouette: half-angle arcsin(0.2), at tan of it times the focal length.
    edge = 100 * np.tan(np.arcsin(0.2))
    on_row = np.flatnonzero(picture.labels[40] == 0)
    assert on_row[0] == np.ceil(50 - edge)
    assert on_row[-1] == np.floor(50 + edge)


def test_left_and_right_picture_show_the_same_texture_a_disparity_apart(scene):
    height, width = scene.left.shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    moved = cv2.remap(scene.right.astype(np.float32), columns - scene.disparity_px, rows, cv2.INTER_CUBIC)
    inside = cv2.erode(scene.visible.astype(np.uint8), np.ones((5, 5))) > 0
    difference = (moved - scene.left)[inside]
    # The finest grain is one pixel wide at this size, so interpolation leaves some; shifted by a pixel it is far more.
    assert np.median(np.abs(difference)) < 8
    wrong = cv2.remap(scene.right.astype(np.float32), columns - scene.disparity_px + 2, rows, cv2.INTER_CUBIC)
    assert np.median(np.abs((wrong - scene.left)[inside])) > 2.5 * np.median(np.abs(difference))


def test_what_one_camera_alone_sees_is_not_visible():
    """By hand: a ball before the wall hides a strip of it from the right camera, left of the ball."""
    ball = Sphere(center=np.array([0.0, -0.1, 0.9]), radius=np.array(0.1))
    rig = Rig((175.0, 175.0), (79.5, 59.5), 0.08, (160, 120))
    picture = render_pair(Setting((ball,), paper_scene(0.0).ground), rig, noise=0.0)
    row = int(59.5 - 0.1 / 0.9 * 175)
    ball_columns = np.flatnonzero(picture.labels[row] == 0)
    hidden = np.flatnonzero(~picture.visible[row] & (np.arange(160) > 20))
    expected = 175 * 0.08 * (1 / 0.9 - 1 / 1.8)  # how much further the ball moves than the wall
    strip = hidden[(hidden < ball_columns[0]) & (hidden > ball_columns[0] - 3 * expected)]
    assert len(strip) == pytest.approx(expected, abs=2)
    assert not picture.visible[row, :7].any(), "left of the right camera's picture"


def test_faults_of_the_right_camera():
    setting = table_scene(1, tilt=0.4, rig=SMALL)
    plain = render_pair(setting, SMALL, noise=0.0)
    fault = render_pair(setting, SMALL, noise=0.0, gain=0.5, offset=20.0, vertical_px=3.0)
    np.testing.assert_array_equal(fault.left, plain.left)
    np.testing.assert_array_equal(fault.depth_m, plain.depth_m)
    # Rows are an exact number of pixels further down; rounding and finite differences at borders leave a level or two.
    bright = (plain.right[:-3] < 255) & (plain.right[:-3] > 0)
    difference = fault.right[3:].astype(float) - (0.5 * plain.right[:-3].astype(float) + 20)
    assert np.percentile(np.abs(difference[bright]), 95) <= 2
    assert fault.visible.mean() == pytest.approx(plain.visible.mean(), abs=0.03)


def test_noise_and_contrast():
    setting = table_scene(1, tilt=0.4, rig=SMALL)
    plain, noisy = (render_pair(setting, SMALL, noise=level) for level in (0.0, 4.0))
    difference = noisy.left.astype(float) - plain.left
    assert difference[plain.left < 240].std() == pytest.approx(4.0, rel=0.05)
    flat = render_pair(setting, SMALL, noise=0.0, contrast=0.0)
    wall = flat.depth_m == np.float32(1.8)
    inside = cv2.erode(wall.astype(np.uint8), np.ones((5, 5))) > 0
    assert np.ptp(flat.left[inside]) <= 1
    assert plain.left[inside].std() > 10


def test_seeds():
    one, same, other = (render_pair(table_scene(seed, rig=SMALL), SMALL, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.left, same.left)
    np.testing.assert_array_equal(one.right, same.right)
    assert (one.left != other.left).mean() > 0.5


@pytest.mark.parametrize("tilt", [0.0, 0.31, 0.61])
def test_random_tables_are_seen_whole(tilt):
    for seed in range(5):
        setting = table_scene(seed, tilt=tilt)
        picture = render_pair(setting, RIG.scaled(0.25))
        border = np.ones(picture.labels.shape, bool)
        border[1:-1, 1:-1] = False
        assert (picture.labels[border] == -1).all()
        assert set(np.unique(picture.labels)) == {-1, 0, 1, 2, 3}
        seen = [picture.visible[picture.labels == index].mean() for index in range(4)]
        assert min(seen) > 0.5
        assert float(np.arccos(-np.asarray(setting.ground.normal)[1])) == pytest.approx(tilt, abs=1e-6)


def test_the_papers_scene():
    cylinder, box = paper_scene().objects
    assert isinstance(cylinder, Cylinder)
    assert isinstance(box, Box)
    np.testing.assert_allclose(cylinder.axis, [0, -1, 0], atol=1e-12)
    assert np.prod(box.size) < np.pi * cylinder.radius**2 * cylinder.height


def test_wrong_use():
    with pytest.raises(ValueError, match="rig must be rectified"):
        render_pair(
            paper_scene(), Rig((100, 100), (50, 40), 0.1, (100, 80), rotation=np.eye(3), translation=(-0.1, 0, 0))
        )
    with pytest.raises(ValueError, match="noise must be"):
        render_pair(paper_scene(), SMALL, noise=-1.0)
    with pytest.raises(ValueError, match="tilt must be within"):
        paper_scene(2.0)
    with pytest.raises(ValueError, match="no place found for count=40"):
        table_scene(0, count=40)
    with pytest.raises(ValueError, match="kinds must be of"):
        table_scene(0, kinds=("torus",))
    plane = Plane(point=np.zeros(3), normal=np.array([0.0, 0, 1]), corners=np.zeros((4, 3)))
    with pytest.raises(TypeError, match="got Plane"):
        body_of(plane)
