import dataclasses
import io
import math

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

from jaxfuzzy import drawing, plot
from jaxfuzzy.fcm import Partition
from jaxfuzzy.primitives import Box, Plane, Quadric, Sphere
from jaxfuzzy.seeding import Seeds, principal_axes
from jaxfuzzy.validity import ClusterCount
from synthetic import RIG, bodies, empty_scene, make_scene, odd_scene

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.figure import Figure
from matplotlib.image import imread


@pytest.fixture(scope="module")
def scene():
    return make_scene()


@pytest.fixture(autouse=True)
def close_figures():
    yield
    pyplot.close("all")


def partition():
    u = jnp.array([[0.9, 0.1], [0.8, 0.2], [0.3, 0.7], [0.1, 0.9]])
    centers, sizes = jnp.array([[0.0, 0.0], [1.0, 1.0]]), jnp.array([0.7501, 0.2499])
    return Partition(centers, sizes, u, jnp.zeros(4), jnp.array([0, 0, 1, 1]), 1.0, 3, 0, 2.0, math.inf)


PLAN = np.array([[0.0, 0.0], [0.1, 0.0], [0.9, 1.0], [1.0, 1.1]])


def seeds():
    edges, counts = jnp.linspace(-2.0, 2.0, 5), jnp.array([3.0, 1.0, 0.0, 4.0])
    centers = jnp.array([[1.0, 5.0], [4.0, 5.0]])
    return Seeds(centers, jnp.array([1.0, 0.0]), jnp.array([2.5, 5.0]), edges, counts, jnp.array([3, 0]))


def counted():
    return ClusterCount(
        jnp.asarray(3), jnp.array([2, 3, 4]), jnp.array([10.0, 30.0, jnp.nan]), partition(), partition(), 0
    )


def drawers(scene):
    points, labels = scene.cloud.points, scene.segmentation.labels
    return {
        "pair": lambda ax: plot.pair(scene.image, scene.image_right, ax),
        "cloud": lambda ax: plot.cloud(points, ax, colors=scene.cloud.colors, up=scene.up),
        "pca": lambda ax: plot.pca(PLAN, ax),
        "histogram": lambda ax: plot.histogram(seeds(), ax),
        "vrc": lambda ax: plot.index_over_k(counted(), ax),
        "fcm_sizes": lambda ax: plot.clusters(PLAN, partition(), ax),
        "nfcv": lambda ax: plot.inliers(points, labels, scene.shapes, ax, up=scene.up),
        "models": lambda ax: plot.models(scene.shapes, ax, points=points, up=scene.up),
        "overlay": lambda ax: plot.overlay(scene.image, scene.shapes, RIG, ax),
        "memberships": lambda ax: plot.memberships(PLAN, partition(), ax),
        "scores": lambda ax: plot.score_table(scene.shapes, ax),
    }


@pytest.mark.parametrize("name", list(plot.FIGURES))
def test_axes_in_and_out(scene, name):
    draw = drawers(scene)[name]
    projection = "3d" if name in ("cloud", "nfcv", "models") else None
    mine = Figure().add_subplot(projection=projection)
    assert draw(mine) is mine
    assert not pyplot.get_fignums(), "axes were given: pyplot must stay out"
    new = draw(None)
    assert new.figure.number in pyplot.get_fignums()
    shown = imread(io.BytesIO(plot.png(mine.figure, dpi=50)))[..., :3]
    assert shown.std() > 0.02, "the figure is blank"


@pytest.mark.parametrize(
    ("make", "missing"),
    [
        (make_scene, set()),
        (odd_scene, {"pair", "overlay"}),
        (empty_scene, set(plot.FIGURES) - {"cloud"}),
    ],
)
def test_figures_of_a_scene(make, missing, monkeypatch):
    stages = plot.PaperStages(PLAN, seeds(), counted(), partition())
    found = plot.paper_stages
    # The clustering behind four figures has a test of its own.
    monkeypatch.setattr(plot, "paper_stages", lambda s: stages if s.shapes else found(s))
    drawn = plot.figures(make())
    assert list(drawn) == [name for name in plot.FIGURES if name not in missing]
    assert all(isinstance(figure, Figure) for figure in drawn.values())


def test_paper_stages(scene):
    stages = plot.paper_stages(scene)
    # The bodies stand well apart, so the variance ratio is largest at the true number, 5.
    assert int(stages.choice.k) == 5
    assert stages.partition.sizes.shape == (5,)
    assert stages.seeds.centers.shape == (5, 2)
    labels = np.asarray(scene.segmentation.labels)
    own = labels[labels >= 0]
    fuzzy = np.asarray(stages.partition.labels)
    largest = [np.bincount(fuzzy[own == i]).max() / np.sum(own == i) for i in range(5)]
    assert min(largest) > 0.95
    few = dataclasses.replace(scene.segmentation, labels=jnp.where(jnp.arange(len(labels)) < 5, 0, -1))
    assert plot.paper_stages(dataclasses.replace(scene, segmentation=few)) is None


def test_influence_marks_the_points_that_decide():
    places = np.random.default_rng(0).normal(size=(400, 3))
    by_weight = np.full(400, 1e-5)
    by_weight[:8], by_weight[7] = -1e-3, -2e-3
    mine = Figure().add_subplot(projection="3d")
    assert plot.influence(places, by_weight, mine, label="mm") is mine
    (drawn,) = mine.collections
    # Leaving out point 7 adds 2 mm; it is drawn last and largest, in the color of what adds.
    assert drawn.get_array()[-1] == pytest.approx(2.0)
    sizes = drawn.get_sizes()
    assert sizes[-1] == sizes.max() > 10 * np.median(sizes)
    new = plot.influence(places, by_weight)
    shown = imread(io.BytesIO(plot.png(new.figure, dpi=50)))[..., :3]
    assert shown.std() > 0.02, "the figure is blank"


def test_png_repeats_itself(scene):
    figure = Figure()
    plot.histogram(seeds(), figure.add_subplot())
    assert plot.png(figure) == plot.png(figure)


def test_histogram_shows_the_counts():
    ax = plot.histogram(seeds())
    assert [bar.get_height() for bar in ax.patches] == [3, 1, 0, 4]
    assert [bar.get_x() for bar in ax.patches] == [-2, -1, 0, 1]
    tops, *lines = ax.lines
    assert sorted(zip(*tops.get_data(), strict=True)) == [(-1.5, 3.0), (1.5, 4.0)]
    assert [line.get_xdata()[0] for line in lines] == [-1.5, 1.5]  # seeds minus mean, along the axis


def test_index_marks_the_chosen_k():
    ax = plot.index_over_k(counted())
    assert [bar.get_height() for bar in ax.patches] == [10, 30]  # what is not finite is not drawn
    assert [text.get_text() for text in ax.texts] == ["10", "30\nchosen"]
    assert ax.patches[0].get_facecolor() != ax.patches[1].get_facecolor()
    assert ax.get_ylabel() == "variance ratio"


def test_clusters_name_their_sizes():
    ax = plot.clusters(PLAN, partition())
    assert [text.get_text() for text in ax.texts] == ["α₁ = 0.7501", "α₂ = 0.2499"]
    assert ax.collections[0].get_facecolors()[:, :3].tolist() == [list(drawing.rgb(i)) for i in (0, 0, 1, 1)]


def test_pca_draws_the_principal_axes():
    points = np.random.default_rng(0).normal(size=(500, 2)) * [3.0, 1.0]
    ax = plot.pca(points)
    arrows = [text for text in ax.texts if text.arrow_patch is not None]
    mean, axes, variances = principal_axes(points)
    np.testing.assert_allclose(arrows[0].xy, mean + 2 * np.sqrt(variances[0]) * axes[0])
    (low, high), (below, above) = ax.get_xlim(), ax.get_ylim()
    assert all(low < arrow.xy[0] < high and below < arrow.xy[1] < above for arrow in arrows)


def test_inliers_and_noise_are_told_apart(scene):
    ax = plot.inliers(scene.cloud.points, scene.segmentation.labels, scene.shapes, up=scene.up)
    good, bad = (len(c._offsets3d[0]) for c in ax.collections)
    total = sum(len(np.asarray(shape.inliers)) for shape in scene.shapes)
    assert good == sum(int(np.sum(np.asarray(shape.inliers))) for shape in scene.shapes)
    assert good + bad == total
    assert ax.get_legend().get_texts()[0].get_text() == f"noise: {bad} of {total} points"
    assert ax.texts[0].get_text() == "0: 90 %"


def test_too_many_points_are_thinned_and_it_says_so(monkeypatch):
    monkeypatch.setattr(plot, "DRAWN", 100)
    ax = plot.clusters(np.repeat(PLAN, 60, axis=0), dataclasses.replace(partition(), labels=jnp.zeros(240, int)))
    assert len(ax.collections[0].get_offsets()) == 80
    assert ax.get_title(loc="right") == "one point in 3 drawn"
    assert plot.clusters(PLAN, partition()).get_title(loc="right") == ""


def test_overlay_draws_the_outlines(scene):
    ax = plot.overlay(scene.image, scene.shapes, RIG)
    drawn = [np.array(lines.get_segments()) for lines in ax.collections[1::2]]
    for shape, segments in zip(scene.shapes, drawn, strict=True):
        np.testing.assert_array_equal(segments, drawing.outline(shape.primitive, RIG))
    assert [text.get_text() for text in ax.texts] == ["0 cone", "1 box", "2 cylinder", "3 sphere", "4 cone"]


def test_score_table_marks_the_best(scene):
    ax = plot.score_table(scene.shapes)
    table = ax.tables[0]
    kinds = [table[0, i].get_text().get_text() for i in range(5)]
    assert kinds == ["plane", "box", "cylinder", "cone", "sphere"]
    assert [table[4, i].get_text().get_text() for i in range(5)] == ["12", "7", "5", "6.5", "1"]
    assert table[1, 4].get_text().get_text() == "–"
    for row, shape in enumerate(scene.shapes, start=1):
        marked = [i for i in range(5) if table[row, i].get_text().get_weight() == "bold"]
        assert marked == [kinds.index(shape.kind)]
    assert plot.score_table(()).texts[0].get_text() == "no object was scored"


def test_plan_is_seen_from_above():
    up = np.array([0.0, -1.0, 0.0])
    assert plot.plan(np.array([[1.0, 2.0, 3.0]]), up).tolist() == [[1.0, 3.0]]


@pytest.mark.parametrize("up", [(0, -1, 0), (0.1, -0.8, -0.5), (0, 0, -1), (0, 0, 1)])
def test_upright_frame_is_a_rotation(up):
    frame = drawing.upright_frame(up)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(frame) == pytest.approx(1)
    np.testing.assert_allclose(frame @ (np.asarray(up) / np.linalg.norm(up)), [0, 0, 1], atol=1e-15)


def test_outline_of_a_box_by_hand():
    # Straight ahead and turned by 45 degrees about the vertical, level with the camera: two faces are seen.
    h = math.sqrt(0.5)
    box = Box(np.array([0.0, 0.0, 2.0]), np.array([0.2, 0.4, 0.2]), np.array([[h, 0, h], [0, 1, 0], [-h, 0, h]]), None)
    segments = drawing.outline(box, RIG)
    assert len(segments) == 7  # three upright edges, four of the top and bottom seen from the front
    upright = segments[np.abs(segments[:, 0, 0] - segments[:, 1, 0]) < 1e-9]
    near, side = 2 - 0.1 * math.sqrt(2), 0.1 * math.sqrt(2)
    cx, cy = RIG.center_px
    expected = [cx - 180 * side / 2, cx, cx + 180 * side / 2]
    np.testing.assert_allclose(np.sort(upright[:, 0, 0]), expected)
    middle = upright[np.argsort(upright[:, 0, 0])[1]]
    np.testing.assert_allclose(np.sort(middle[:, 1]), [cy - 180 * 0.2 / near, cy + 180 * 0.2 / near])


def test_silhouette_of_a_sphere_is_its_cone_of_sight():
    ball = Sphere(np.array([0.0, 0.0, 2.0]), np.array(0.5))
    hull = drawing.silhouette(ball, RIG)
    radii = np.linalg.norm(hull - RIG.center_px, axis=1)
    # The line of sight touches at sin = r / z; a mesh of 48 sides stays within 1 % of the circle.
    expected = 180 * math.tan(math.asin(0.25))
    assert radii.max() <= expected * 1.001
    assert radii.min() >= expected * 0.99
    turns = [drawing._turn(*hull[[i, (i + 1) % len(hull), (i + 2) % len(hull)]]) for i in range(len(hull))]
    assert min(turns) > 0


def test_of_a_quadric_the_border_is_drawn():
    """A ball as a quadric: one closed line, its cone of sight. A pair of planes that fold within it adds nothing."""
    bounds = np.array([[-0.6, -0.6, 1.4], [0.6, 0.6, 2.6]])
    ball = Quadric(np.array([1.0, 1, 1, 0, 0, 0, 0, 0, -4, 4 - 0.25]), bounds)
    segments = drawing.outline(ball, RIG)
    np.testing.assert_array_equal(np.roll(segments[:, 0], -1, axis=0), segments[:, 1])
    radii = np.linalg.norm(segments[:, 0] - RIG.center_px, axis=1)
    # A mesh of 24 cells cuts corners by 1.5 %, a picture rounds by a pixel.
    assert np.abs(radii - 180 * math.tan(math.asin(0.25))).max() < 2.0
    # Two sheets one behind the other, x² = 0.01 seen along y: what is drawn is the border of both together.
    sheets = Quadric(np.array([1.0, 0, 0, 0, 0, 0, 0, 0, 0, -0.01]), bounds)
    segments = drawing.outline(sheets, RIG)
    inner = np.abs(segments.mean(1) - RIG.center_px).max(1) < 5
    assert not inner.any()
    behind = Quadric(np.array([1.0, 1, 1, 0, 0, 0, 0, 0, 4, 4 - 0.25]), bounds - [0, 0, 4])
    assert len(drawing.mesh(behind)[1]) > 0
    assert drawing.outline(behind, RIG).shape == (0, 2, 2)


def test_what_is_not_in_front_is_not_drawn():
    around = Sphere(np.zeros(3), np.array(0.5))
    segments = drawing.outline(around, RIG)
    assert np.isfinite(segments).all()
    assert drawing.silhouette(around, RIG).shape == (0, 2)
    behind = Box(np.array([0.0, 0.0, -2.0]), np.ones(3), np.eye(3), None)
    assert drawing.outline(behind, RIG).shape == (0, 2, 2)


def test_what_has_no_mesh_is_left_out():
    for body in (None, Quadric(np.arange(10.0))):
        assert drawing.mesh(body)[1].shape == (0, 3)
        assert drawing.outline(body, RIG).shape == (0, 2, 2)
        assert drawing.silhouette(body, RIG).shape == (0, 2)


def test_places_and_sizes_in_words(scene):
    places = [drawing.position(shape) for shape in scene.shapes]
    np.testing.assert_allclose(places[1], bodies()[1].center)
    np.testing.assert_allclose(places[3], bodies()[3].center)
    assert drawing.size_text(scene.shapes[2]) == "radius 50.0 ± 1.7 mm, height at least 150.0 mm"
    assert drawing.size_text(scene.shapes[4]) == (
        "half-angle (12.00 ± 0.13)°, smaller radius 34.0 mm, base radius 76.5 mm, height 200.0 mm"
    )
    corners = np.array([[0, 0, 1], [2, 0, 1], [2, 0.5, 1], [0, 0.5, 1]], float)
    sheet = dataclasses.replace(
        scene.shapes[0], primitive=Plane(corners[0], np.array([0.0, 0, -1]), corners), kind="plane"
    )
    assert drawing.size_text(sheet) == "length 2.000 m, width 500.0 mm"
    np.testing.assert_allclose(drawing.position(sheet), [1, 0.25, 1])
    assert drawing.score_text(10752.3) == "10,752"
    assert drawing.score_text(math.inf) == drawing.score_text(None) == "–"


# Machado, Oliveira and Fernandes, IEEE TVCG 15(6), 2009: what a person without one kind of cone sees, on linear light.
SEEN_BY = {
    "all cones": np.eye(3),
    "no red cones": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]),
    "no green cones": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]),
    "no blue cones": np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]),
}  # fmt: skip


@pytest.mark.parametrize("eyes", SEEN_BY)
def test_colors_are_told_apart_by_everyone(eyes):
    tones = np.array([drawing.rgb(i) for i in range(-1, len(drawing.PALETTE))])
    linear = np.where(tones <= 0.04045, tones / 12.92, ((tones + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ SEEN_BY[eyes].T, 0, 1)
    xyz = seen @ np.array([[0.4124, 0.2126, 0.0193], [0.3576, 0.7152, 0.1192], [0.1805, 0.0722, 0.9505]])
    white = np.array([0.9505, 1.0, 1.089])
    f = np.where(xyz / white > 0.008856, np.cbrt(xyz / white), 7.787 * xyz / white + 16 / 116)
    lab = np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], 1)
    apart = np.linalg.norm(lab[:, None] - lab, axis=-1)[np.triu_indices(len(lab), 1)]
    # A difference of 2.3 in CIELAB is just noticeable (Mahy et al. 1994). Okabe and Ito's own colors come as near as 16;
    # the grey for noise must not come nearer.
    assert apart.min() > 16
