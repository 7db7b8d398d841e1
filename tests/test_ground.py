"""The supporting plane, the upright frame and the foreground, on scenes cast ray by ray and on real ones."""

import dataclasses

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfuzzy.cloud import Cloud
from jaxfuzzy.ground import find_ground, fit_ground, foreground, upright
from jaxfuzzy.planes import GRID, PAIRS, _Patches, _smallest_directions, _weighted_median, _within
from jaxfuzzy.rig import load_rig
from jaxfuzzy.simulate import simulate_scene
from jaxfuzzy.status import Status
from jaxfuzzy.stereo import example_pair, reconstruct

NOISE = 0.002  # deviation of the depth at one metre, in metres
TABLE, BALL, WALL = 0, 1, 2


def scene(
    tilt, *, seed=0, balls=((-0.15, 0.0, 0.06), (0.05, 0.12, 0.08), (0.2, -0.05, 0.05)), wall=None, table=True, roll=0.0
):
    """Points (N, 3) in a camera's frame (y down), what each belongs to, deviations along the rays, plane normal and offset.

    The table is seen at `tilt`; balls (right, away, radius) stand on it; the wall stands at so many metres behind its middle.
    """
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(-0.3, 0.3, 120), np.linspace(-0.25, 0.25, 100))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    up = np.array([np.sin(roll), -np.cos(tilt) * np.cos(roll), -np.sin(tilt)])
    up = up / np.linalg.norm(up)
    ahead = np.array([0, 0, 1.0]) - up[2] * up
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    middle = np.array([0, 0.12, 1.2])
    depth, what = np.full(len(rays), np.inf), np.full(len(rays), -1)

    def nearer(t, label):
        hit = (t > 0.3) & (t < np.minimum(depth, 3.0))
        depth[hit], what[hit] = t[hit], label

    with np.errstate(divide="ignore", invalid="ignore"):
        if table:
            nearer((middle @ up) / (rays @ up), TABLE)
        if wall is not None:
            nearer(((middle + wall * ahead) @ ahead) / (rays @ ahead), WALL)
        for x, z, radius in balls:
            center = middle + x * right + z * ahead + radius * up
            b, c, a = rays @ center, center @ center - radius**2, (rays**2).sum(axis=1)
            nearer((b - np.sqrt(b**2 - a * c)) / a, BALL)
    seen = np.isfinite(depth)
    depth, rays, what = depth[seen], rays[seen], what[seen]
    std = NOISE * depth**2
    points = rays * (depth + std * rng.standard_normal(len(depth)))[:, None]
    return points, what, std * np.linalg.norm(rays, axis=1), up, middle @ up


def angle(a, b):
    return np.degrees(np.arccos(np.clip(np.abs(np.asarray(a) @ b), 0, 1)))


@pytest.mark.parametrize("tilt", [8, 20, 45])
@pytest.mark.parametrize("known", [True, False])
def test_plane_of_a_table(tilt, known):
    points, what, std, up, offset = scene(np.radians(tilt), roll=0.1)
    ground = fit_ground(points, depth_std=std if known else None)
    # Some 5000 points with 2 mm of noise over 0.5 m: the plane is known to 0.1 degrees and a millimetre; the table's rim
    # under the balls is seen too.
    assert angle(ground.plane.normal, up) < 0.25
    assert np.asarray(ground.plane.normal) @ up > 0
    np.testing.assert_allclose(np.asarray(ground.plane.point) @ up, offset, atol=1.5e-3)
    on = np.asarray(ground.inliers)
    assert on[what == TABLE].mean() > 0.95
    assert on[what == BALL].mean() < 0.25
    assert int(ground.status) == 0
    # A robust deviation of thousands of points. At 8 degrees the sideways deviation that planes are granted, a tenth of that along
    # the ray, is half of what the ray gives, and takes its share.
    np.testing.assert_allclose(np.median(np.asarray(ground.depth_std) / std), 1, atol=0.15)


def test_the_sign_of_up_does_not_matter():
    points, _, std, _, _ = scene(0.3)
    one, other = (find_ground(points, up=(0, sign, 0), depth_std=std) for sign in (1, -1))
    np.testing.assert_allclose(one.normal, other.normal, atol=1e-6)
    np.testing.assert_allclose(one.point, other.point, atol=1e-6)


def test_unit_and_weights():
    points, _, std, _, _ = scene(0.3)
    plane = find_ground(points, depth_std=std)
    large = find_ground(1000 * points, depth_std=1000 * std)
    np.testing.assert_allclose(large.normal, plane.normal, atol=1e-9)
    np.testing.assert_allclose(large.corners, 1000 * np.asarray(plane.corners), rtol=1e-7)
    # Points of weight 0 are absent, wherever they are: 200 of them on another plane change nothing.
    more = np.concatenate([points[:3000], points[:200] + [0, -0.05, 0]])
    weighted = find_ground(
        more, depth_std=np.concatenate([std[:3000], std[:200]]), weights=np.repeat([1.0, 0.0], [3000, 200])
    )
    alone = find_ground(points[:3000], depth_std=std[:3000])
    np.testing.assert_allclose(weighted.normal, alone.normal, atol=1e-9)


def test_a_table_of_which_little_is_seen_beats_a_slab_through_clutter():
    """Thirty-six balls, and of the table only a strip in front of them: a leaning slab through the balls holds more points."""
    rng = np.random.default_rng(1)
    places = [(x, z) for x in np.linspace(-0.35, 0.35, 6) for z in np.linspace(-0.2, 0.6, 6)]
    balls = tuple((x + rng.uniform(-0.01, 0.01), z, rng.uniform(0.07, 0.08)) for x, z in places)
    points, what, std, up, offset = scene(0.3, balls=balls)
    strip = (what != TABLE) | (points[:, 2] < np.quantile(points[what == TABLE, 2], 0.15))
    points, what, std = points[strip], what[strip], std[strip]

    def held(normal, offset):
        return (np.abs(points @ normal - offset) < 2.5 * std * np.abs(normal[2])).sum()

    slabs = [np.array([0.0, -np.cos(lean), -np.sin(lean)]) for lean in np.radians([30, 35, 40, 45])]
    decoy = max(held(n, o) for n in slabs for o in np.quantile(points @ n, np.linspace(0.05, 0.95, 40)))
    assert decoy > held(up, offset)
    plane = find_ground(points, depth_std=std)
    assert angle(plane.normal, up) < 0.5
    np.testing.assert_allclose(np.asarray(plane.point) @ up, offset, atol=2e-3)


def test_no_plane_is_an_answer():
    points, _, std, _, _ = scene(0.3, table=False, balls=((0.0, 0.0, 0.15), (0.25, 0.1, 0.1)))
    ground = fit_ground(points, depth_std=std)
    assert ground.plane is None
    assert int(ground.status) == Status.NO_GROUND
    assert not np.asarray(ground.inliers).any()
    assert find_ground(points) is None


def test_a_slab_through_boards_behind_each_other_is_no_ground():
    """Where no table is seen: its residual follows the place in every patch, as those of tables and walls do not."""
    rng = np.random.default_rng(0)
    u, v = (c.ravel() for c in np.meshgrid(np.linspace(-0.3, 0.3, 150), np.linspace(-0.25, 0.25, 125)))
    # Six boards upright in the camera's frame, each of which shows a strip above the one before it.
    depth = 1.6 - 0.13 * np.floor((v + 0.25) / 0.5 * 5.999)
    std = 0.01 * depth**2
    points = np.stack([u, v, np.ones_like(u)], axis=1) * (depth + 0.2 * std * rng.standard_normal(len(u)))[:, None]
    ground = fit_ground(points, depth_std=std)
    assert ground.plane is None
    assert int(ground.status) & Status.NO_GROUND
    # The same without the strips is a plane that leans as the slab did.
    depth = 1.6 - 0.13 * ((v + 0.25) / 0.5 * 5.999 - 0.5)
    points = np.stack([u, v, np.ones_like(u)], axis=1) * (depth + 0.2 * std * rng.standard_normal(len(u)))[:, None]
    assert fit_ground(points, depth_std=std).plane is not None


@pytest.mark.parametrize("mirrored", [False, True])
def test_books_on_no_table_have_no_ground(shared_data, mirrored):
    """A slab through their spines held a seventh of the points, and cut all that stood in it."""
    folder = shared_data / "middlebury2005_books"
    rig = load_rig(folder / "calib.txt")
    left, right = (cv2.imread(str(folder / name)) for name in ("view1.png", "view5.png"))
    if mirrored:
        left, right = right[:, ::-1], left[:, ::-1]
        rig = dataclasses.replace(
            rig, center_px=(left.shape[1] - 1 - rig.center_px[0] - rig.doffs_px, rig.center_px[1])
        )
    cloud = reconstruct(left, right, rig)
    assert fit_ground(cloud.points, up=(0, -1, 0), depth_std=cloud.depth_std).plane is None


def test_a_wavy_cloth_is_called_a_slab():
    points, _, std, up, _ = scene(0.3, balls=())
    flat = points @ np.stack([np.cross([0, 0, 1.0], up), np.cross(np.cross([0, 0, 1.0], up), up)], axis=1)
    wave = 0.004 * np.sin(flat[:, 0] / 0.008) * np.sin(flat[:, 1] / 0.008)
    ground = fit_ground(points + wave[:, None] * up, depth_std=std)
    assert int(ground.status) == Status.GROUND_SLAB
    assert float(ground.spread) > 1.3


@pytest.mark.parametrize("filled", [True, False])
def test_a_plane_of_which_little_is_seen_is_not_believed_to_tell_much_noise(filled):
    """A table with four times the noise told tells it where it fills the view; of a small patch a bend may tell as much."""
    points, what, std, up, _ = scene(0.5, balls=(), wall=0.6)
    rng = np.random.default_rng(1)
    on_table = np.flatnonzero(what == TABLE)
    if not filled:
        # All of it but a small patch is seen as a wall does that stands behind.
        middle = points[on_table].mean(axis=0)
        off = points[on_table] - middle
        points = np.delete(points, on_table[np.abs(off[:, 0]) + np.abs(off[:, 2]) > 0.09], axis=0)
        std = np.delete(std, on_table[np.abs(off[:, 0]) + np.abs(off[:, 2]) > 0.09])
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    noisy = points + 4 * (std * rng.standard_normal(len(points)))[:, None] * ray
    ground = fit_ground(noisy, up=up, depth_std=std)
    assert ground.plane is not None
    assert angle(ground.plane.normal, up) < 10
    assert float(ground.spread) == pytest.approx(4.0, rel=0.15)
    assert (float(ground.support) > 0.03) == filled
    told = np.asarray(ground.depth_std) / std
    np.testing.assert_allclose(told, float(ground.spread) if filled else 2.0, rtol=1e-3)


def test_gravity_rules_out_what_leans():
    points, _, std, up, _ = scene(np.radians(25))
    assert find_ground(points, depth_std=std, max_tilt=np.radians(10)) is None
    plane = find_ground(points, up=-up, depth_std=std, max_tilt=np.radians(10))
    assert angle(plane.normal, up) < 0.25


def test_without_a_camera_up_is_where_more_is():
    points, _, _, up, offset = scene(0.3)
    for sign in (1, -1):
        plane = find_ground(sign * points, up=up, camera=None, noise_distance=0.008)
        assert angle(plane.normal, up) < 0.3
        assert sign * np.asarray(plane.normal) @ up > 0
        np.testing.assert_allclose(np.abs(np.asarray(plane.point) @ up), abs(offset), atol=2e-3)


def test_upright_frame():
    points, what, std, up, offset = scene(0.4, roll=0.2)
    plane = find_ground(points, depth_std=std)
    turned, rotation, origin = (np.asarray(a) for a in upright(points, plane))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)
    np.testing.assert_allclose(rotation @ np.asarray(plane.normal), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turned @ rotation + origin, points, atol=1e-12)
    assert rotation[2, 2] > 0  # z still leads away from the camera
    assert np.median(turned[what == BALL, 1]) > 0.02
    assert abs(np.median(turned[what == TABLE, 1])) < 1e-3
    assert angle(np.asarray(plane.normal), up) < 0.3
    assert abs(offset - np.asarray(plane.point) @ up) < 2e-3


def test_a_camera_that_looks_straight_down_has_an_upright_frame():
    points = np.stack([*np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60)), np.full((60, 60), 2.0)], axis=-1)
    plane = find_ground(points.reshape(-1, 3), up=(0, 0, 1), noise_distance=0.01)
    _, rotation, _ = upright(points.reshape(-1, 3), plane)
    np.testing.assert_allclose(np.asarray(rotation) @ rotation.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.asarray(rotation) @ [0, 0, -1], [0, 1, 0], atol=1e-6)


def test_foreground_is_what_stands_on_the_table_before_the_wall():
    points, what, std, up, _ = scene(np.radians(20), wall=0.5)
    assert set(what) == {TABLE, BALL, WALL}
    ground = fit_ground(points, depth_std=std)
    front = foreground(points, ground)
    mask = np.asarray(front.mask)
    assert len(front.walls) == 1
    assert angle(front.walls[0].normal, up) > 85
    assert mask[what == TABLE].mean() < 0.02
    assert mask[what == WALL].mean() < 0.02
    # A ball is lost where it is lower than three deviations of its height.
    height = points @ up - np.asarray(ground.plane.point) @ up
    assert mask[(what == BALL) & (height > 2 * float(front.cut))].mean() > 0.99


def test_a_wall_that_fills_the_view_is_still_a_wall():
    """A small ball before it, three hundredths of what stands, is what the scene is about."""
    points, what, std, _, _ = scene(np.radians(10), wall=0.5, balls=((0.05, 0.0, 0.05),))
    standing = what != TABLE
    assert (what[standing] == BALL).mean() < 0.1
    front = foreground(points, fit_ground(points, depth_std=std))
    assert len(front.walls) == 1
    assert np.asarray(front.mask)[what == WALL].mean() < 0.02
    assert np.asarray(front.mask)[what == BALL].mean() > 0.8


def test_a_box_on_the_table_is_no_wall():
    """Its front face spans half the view and has nothing behind it, but there is table behind it."""
    points, _what, std, up, offset = scene(np.radians(35), balls=((0.0, -0.1, 0.03),))
    ahead = np.array([0, 0, 1.0]) - up[2] * up
    ahead /= np.linalg.norm(ahead)
    base = np.array([0, 0.12, 1.2]) + 0.02 * ahead
    reach = (base @ ahead) / (points @ ahead)
    at = reach[:, None] * points
    face = (reach > 0) & (reach < 1) & (at @ up > offset) & (at @ up < offset + 0.08) & (np.abs(at[:, 0]) < 0.16)
    assert face.sum() > 300
    points = np.where(
        face[:, None], at * (1 + std * np.random.default_rng(2).standard_normal(len(at)))[:, None], points
    )
    front = foreground(points, fit_ground(points, depth_std=std))
    assert front.walls == ()
    assert np.asarray(front.mask)[face].mean() > 0.85


def test_a_wall_is_found_where_no_camera_is_known():
    """From above all that stands follows its place; that makes no slab of it."""
    rng = np.random.default_rng(0)
    floor = np.stack([rng.uniform(-1, 1, 4000), np.zeros(4000), rng.uniform(0, 2, 4000)], axis=1)
    wall = np.stack([rng.uniform(-1, 1, 3000), rng.uniform(0, 1, 3000), np.full(3000, 2.0)], axis=1)
    ball = rng.standard_normal((800, 3))
    ball = 0.15 * ball / np.linalg.norm(ball, axis=1)[:, None] + [0, 0.15, 1.0]
    points = np.concatenate([floor, wall, ball]) + 0.003 * rng.standard_normal((7800, 3))
    ground = fit_ground(points, camera=None)
    front = foreground(points, ground, camera=None)
    assert len(front.walls) == 1
    mask = np.asarray(front.mask)
    assert mask[4000:7000].mean() < 0.02
    assert mask[7000:].mean() > 0.9


def test_what_is_seen_edge_on_ends_no_view():
    """The side of a shelf, nearly in line with the camera, is no wall, or all to the left of it would be background."""
    rng = np.random.default_rng(0)
    depth, height = rng.uniform(0.8, 2.0, 6000), rng.uniform(-0.25, 0.25, 6000)
    side = np.stack([np.full(6000, -0.06), height * depth, depth], axis=1)
    side += 0.0005 * rng.standard_normal(side.shape)
    around = rng.standard_normal((3000, 3))
    around /= np.linalg.norm(around, axis=1)[:, None]
    left, right = (
        middle + 0.1 * around[around @ middle < 0] for middle in (np.array([-0.4, 0, 1.4]), np.array([0.3, 0, 1.2]))
    )
    points = np.concatenate([side, left[:400], right])
    nothing = fit_ground(right, depth_std=0.0005 * right[:, 2] ** 2)
    assert nothing.plane is None
    ground = dataclasses.replace(nothing, inliers=np.zeros(len(points), bool), depth_std=0.0005 * points[:, 2] ** 2)
    front = foreground(points, ground, up=(0, 1, 0))
    assert front.walls == ()
    assert np.asarray(front.mask).all()


def test_without_a_plane_the_foreground_is_all_but_walls():
    points, what, std, _, _ = scene(0.1, table=False, wall=0.4, balls=((0.0, 0.0, 0.12), (0.2, 0.0, 0.1)))
    front = foreground(points, fit_ground(points, depth_std=std), up=(0, 1, 0))
    assert len(front.walls) == 1
    assert np.asarray(front.mask)[what == BALL].mean() > 0.95
    assert np.asarray(front.mask)[what == WALL].mean() < 0.02


def test_outline_is_full_inside_and_empty_far_outside():
    members = np.zeros((GRID, GRID))
    members[8:16, 8:16] = 1.0
    inside = np.asarray(_within(members.ravel()[None])).reshape(GRID, GRID)
    assert inside[11, 11] > 0.98
    assert inside[0, 0] < 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((5, 2))}, r"points must have shape \(N, 3\)"),
        ({"up": (0, 0, 0)}, "up must be finite and not of length zero"),
        ({"noise_distance": -1.0}, "noise_distance must be finite and above 0"),
        ({"noise_distance": "much"}, "noise_distance must be one of 'auto'"),
        ({"depth_std": np.ones(3)}, "depth_std must have shape"),
        ({"weights": np.ones(3)}, "weights must have shape"),
        ({"max_tilt": 0.0}, "max_tilt must be a finite number above"),
        ({"camera": (0, 0)}, r"camera must have shape \(3,\)"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    arguments = {"points": np.random.default_rng(0).normal(size=(50, 3))} | change
    with pytest.raises(ValueError, match=message):
        find_ground(arguments.pop("points"), **arguments)


@pytest.mark.parametrize(
    "points", [np.ones((1, 3)), np.ones((40, 3)), np.outer(np.linspace(1, 2, 30), [0.1, 0.1, 1.0])]
)
def test_points_that_are_no_plane(points):
    ground = fit_ground(points)
    assert ground.plane is None or np.isfinite(np.asarray(ground.plane.normal)).all()
    assert np.isfinite(np.asarray(foreground(points, ground).cut))


# Real scenes


def test_board_of_the_bundled_pair():
    left, right, rig = example_pair()
    cloud: Cloud = reconstruct(cv2.imread(str(left)), cv2.imread(str(right)), rig)
    ground = fit_ground(cloud.points, depth_std=cloud.depth_std)
    # A plane fitted to the board by hand, in the ground-truth disparities, front part 3300 pixels; the far part of the board
    # stands 4 degrees steeper, so no plane is better than about 2 degrees.
    assert angle(ground.plane.normal, np.array([0.140, -0.916, -0.377])) < 2
    np.testing.assert_allclose(np.asarray(ground.plane.normal) @ ground.plane.point, -0.570, atol=0.025)
    front = foreground(cloud.points, ground)
    columns, rows = np.asarray(cloud.pixels_px).astype(int).T
    mask = np.asarray(front.mask)
    cone = (columns > 100) & (columns < 150) & (rows > 250) & (rows < 330)
    board = (columns > 60) & (columns < 200) & (rows > 358) & (rows < 373)
    lattice = (columns > 300) & (columns < 400) & (rows < 60)
    assert mask[cone].mean() > 0.95
    assert mask[board].mean() < 0.1
    assert mask[lattice].mean() < 0.2


def test_mug_on_its_table(shared_data):
    xyz = np.load(shared_data / "pcl_mug_stereo" / "table_scene_mug_stereo_textured.npz")["xyz"]
    plane = find_ground(xyz[np.isfinite(xyz).all(axis=-1)])
    # The reference of the data's own page: normal (-0.016, 0.838, 0.546), offset -0.529, pointing down there.
    assert angle(plane.normal, np.array([-0.016, 0.838, 0.546])) < 0.3
    np.testing.assert_allclose(np.asarray(plane.normal) @ plane.point, -0.529, atol=2e-3)


@pytest.mark.parametrize("name", ["learn0", "learn33", "learn36", "learn44"])
def test_labelled_tables(shared_data, name):
    cloud = np.load(shared_data / "mosd" / f"{name}.npz")
    seen = np.isfinite(cloud["xyz"]).all(axis=-1)
    points, label = cloud["xyz"][seen], cloud["label"][seen]
    ground = fit_ground(points)
    front = foreground(points, ground)
    table, objects = (label >= 1) & (label < 10), label >= 20
    assert np.asarray(front.mask)[objects].mean() > 0.93
    assert np.asarray(front.mask)[table].mean() < 0.06
    assert front.walls == ()


@pytest.mark.parametrize("name", ["middlebury2006_bowling1_half", "middlebury2006_baby1_half"])
def test_scenes_without_a_plane(shared_data, name):
    """A ball on cloth, and a doll on a hat box whose top is not seen."""
    folder = shared_data / name
    images = [cv2.imread(str(folder / f"view{i}.png")) for i in (1, 5)]
    cloud = reconstruct(*images, load_rig(folder / "calib.txt"))
    assert find_ground(cloud.points, depth_std=cloud.depth_std) is None


def test_a_plane_through_three_points_is_no_ground_and_an_exact_one_has_a_noise():
    cloud = simulate_scene(2, 0, points=(150, 500))
    ground = fit_ground(np.asarray(cloud.points, np.float32))
    assert ground.plane is None
    assert int(ground.status) & Status.NO_GROUND
    a, b = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(1, 2, 40))
    exact = fit_ground(np.stack([a, np.full_like(a, 0.5), b], -1).reshape(-1, 3))
    assert exact.plane is not None
    assert (np.asarray(exact.depth_std) > 0).all()


def test_planes_through_patches_are_those_of_eigenvectors():
    """Two sets of weights: patches along a thin plane, and patches of which no direction is much the smallest."""
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(50, 3)) * [1.0, 0.7, 0.6]
    mean[:25, 2] *= 0.01
    spread = rng.normal(size=(50, 3, 3)) * 0.05
    scatter = spread @ spread.transpose(0, 2, 1)
    weights = np.stack([np.arange(50) < 25, np.arange(50) >= 25]) * rng.uniform(0.5, 1, (2, 50))
    toward = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    patches = _Patches(*map(jnp.asarray, (mean, *[scatter[:, PAIRS[0], PAIRS[1]]] * 2, np.ones(50), mean, np.ones(50))))
    normals, offsets = _smallest_directions(jnp.asarray(weights), patches, jnp.asarray(toward))
    for weight, normal, offset, side in zip(weights, normals, offsets, toward, strict=True):
        share = weight / weight.sum()
        center = share @ mean
        moments = ((mean - center) * share[:, None]).T @ (mean - center) + np.einsum("p,pij->ij", share, scatter)
        values, vectors = np.linalg.eigh(moments)
        expected = vectors[:, 0] * np.sign(vectors[:, 0] @ side)
        # Nine squarings leave the ratio of the two smallest eigenvalues to the power 512; moments lose half their digits at most.
        assert (values[0] / values[1]) ** 512 < 1e-12
        np.testing.assert_allclose(normal, expected, atol=1e-8)
        np.testing.assert_allclose(offset, expected @ center, atol=1e-8)


def test_weighted_median_halves_the_weight():
    rng = np.random.default_rng(1)
    values, weights = rng.exponential(size=501), rng.uniform(0, 1, 501)
    weights[::4] = 0
    order = np.argsort(values)
    expected = values[order][np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)]
    np.testing.assert_allclose(_weighted_median(jnp.asarray(values), jnp.asarray(weights)), expected, rtol=1e-12)
    assert float(_weighted_median(jnp.zeros(5), jnp.ones(5))) == 0
