"""One function a figure: Matplotlib axes in and out, colors that everyone can tell apart.

Every function draws into the axes it is given, or into new ones, and gives them back. `figures` draws all of a scene,
named as in `FIGURES`; the numbers of the paper's figures stand there. Matplotlib (extra `view`) is imported on use.
"""

import dataclasses
import io
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxfuzzy import drawing
from jaxfuzzy.arrays import ArrayLike, Float, Int
from jaxfuzzy.fcm import Partition, fcm
from jaxfuzzy.rig import Rig
from jaxfuzzy.seeding import Seeds, histogram_seeds, principal_axes
from jaxfuzzy.shapes import Shape
from jaxfuzzy.validity import ClusterCount, choose_k

if TYPE_CHECKING:
    from jaxfuzzy.scene import Scene

# Name of each figure of `figures`, and what it shows; numbers are those of the paper's figures.
FIGURES = {
    "pair": "The stereo pair (paper's figure 3)",
    "cloud": "The points (figure 4)",
    "pca": "The objects from above with their principal axes (figure 5)",
    "histogram": "Histogram along the first principal axis, and the seeds it gives (figure 6)",
    "vrc": "Variance ratio over the number of clusters, and the paper's choice (figure 7)",
    "fcm_sizes": "Fuzzy c-means with sizes for that number (figure 8)",
    "nfcv": "Points on each surface, and noise (figure 9)",
    "models": "The shapes found (figure 10)",
    "overlay": "Outlines of the shapes over the photograph",
    "memberships": "How surely each point belongs to its object",
    "scores": "Score of every kind for every object; lower is better, the best is marked",
}
# More points than this only make a figure slow; which share is drawn is written beside them.
DRAWN = 20_000
# The candidates of the paper's section IV.
PAPER_KS = (2, 3, 4, 5)


class PaperStages(NamedTuple):
    """The paper's own way from points to objects, whatever rule a scene was made with."""

    plan: np.ndarray
    seeds: Seeds
    choice: ClusterCount
    partition: Partition


def pair(left: ArrayLike, right: ArrayLike, ax: Any = None) -> Any:
    """The two photographs (H, W) or (H, W, 3) side by side."""
    ax = _axes(ax, (9, 4))
    left, right = np.asarray(left), np.asarray(right)
    gap = np.full((left.shape[0], max(left.shape[1] // 40, 4), *left.shape[2:]), 255, left.dtype)
    ax.imshow(np.concatenate([left, gap, right], axis=1), cmap="gray")
    for x, text in ((0.25, "left"), (0.75, "right")):
        ax.text(x, -0.02, text, transform=ax.transAxes, ha="center", va="top")
    ax.set_axis_off()
    return ax


def cloud(
    points: Float[ArrayLike, "N 3"],
    ax: Any = None,
    *,
    colors: Float[ArrayLike, "N 3"] | None = None,
    up: Float[ArrayLike, "3"] = (0.0, -1.0, 0.0),
) -> Any:
    """A cloud in 3D, seen from the camera's side and a little above; `colors` are red, green, blue in 0..1."""
    ax = _axes(ax, (7, 6), projection="3d")
    points = np.asarray(points, float)
    kept = _thinned(ax, len(points))
    places = points[kept] @ drawing.upright_frame(up).T
    tones: Any = drawing.color(0) if colors is None else np.clip(np.asarray(colors, float)[kept], 0, 1)
    ax.scatter(*places.T, c=tones, s=1.5, depthshade=False, linewidths=0)
    _view(ax, places)
    return ax


def pca(points: Float[ArrayLike, "N 2"], ax: Any = None) -> Any:
    """Points from above with their two principal axes, each as long as two standard deviations."""
    ax = _axes(ax, (6, 5))
    points = np.asarray(points, float)
    ax.scatter(*points[_thinned(ax, len(points))].T, s=2, color=drawing.NOISE_COLOR, linewidths=0)
    middle, axes, variances = principal_axes(points)
    for rank, name in enumerate(("first axis", "second axis")):
        tip = middle + 2 * np.sqrt(max(variances[rank], 0.0)) * axes[rank]
        ax.annotate("", tip, middle, arrowprops={"arrowstyle": "-|>", "color": drawing.color(3 * rank), "lw": 2})
        ax.plot(*tip, alpha=0)  # an arrow alone does not widen the axes
        ax.annotate(name, tip, fontsize=9, ha="center", va="bottom", bbox=_LABEL)
    return _plan_view(ax)


def histogram(seeds: Seeds, ax: Any = None) -> Any:
    """The histogram along the first principal axis: its agglomerates' tops, and where the seeds stand."""
    ax = _axes(ax, (6, 4))
    edges, counts, peaks = np.asarray(seeds.edges), np.asarray(seeds.counts), np.asarray(seeds.peaks)
    ax.bar(edges[:-1], counts, np.diff(edges), align="edge", color=drawing.color(5), edgecolor="white", lw=0.5)
    middles = (edges[:-1] + edges[1:]) / 2
    peaks = peaks[(peaks >= 0) & (peaks < len(counts))]
    top = drawing.color(3)
    ax.plot(middles[peaks], counts[peaks], "v", color=top, markersize=8, label="top of an agglomerate", zorder=3)
    for i, place in enumerate((np.asarray(seeds.centers) - np.asarray(seeds.mean)) @ np.asarray(seeds.axis)):
        ax.axvline(place, color="black", ls="--", lw=1.2, label=None if i else "seed")
    ax.set(xlabel="along the first principal axis (m)", ylabel="points")
    ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    return _bare(ax)


def index_over_k(count: ClusterCount, ax: Any = None, *, index: str = "variance ratio") -> Any:
    """The validity index of every candidate, the chosen number marked."""
    ax = _axes(ax, (6, 4))
    ks, scores, chosen = np.asarray(count.ks), np.asarray(count.scores, float), int(count.k)
    known = np.isfinite(scores)
    tones = [drawing.color(3) if k == chosen else drawing.color(5) for k in ks[known]]
    bars = ax.bar(ks[known], scores[known], 0.6, color=tones)
    for bar, k, score in zip(bars, ks[known], scores[known], strict=True):
        ax.annotate(
            f"{score:.4g}" + ("\nchosen" if k == chosen else ""), (k, bar.get_height()), ha="center", va="bottom"
        )
    ax.set(xlabel="number of clusters k", ylabel=index, xticks=ks)
    ax.margins(y=0.18)
    return _bare(ax)


def clusters(points: Float[ArrayLike, "N 2"], partition: Partition, ax: Any = None) -> Any:
    """Points from above, each in the color of its largest membership; centers with their sizes alpha."""
    ax = _axes(ax, (6, 5))
    points, labels = np.asarray(points, float), np.asarray(partition.labels)
    kept = _thinned(ax, len(points))
    ax.scatter(*points[kept].T, s=3, c=[drawing.rgb(i) for i in labels[kept]], linewidths=0)
    for i, (center, size) in enumerate(zip(np.asarray(partition.centers), np.asarray(partition.sizes), strict=True)):
        ax.plot(*center, "o", color="white", markeredgecolor="black", markersize=9)
        ax.annotate(f"α{_subscript(i + 1)} = {size:.4f}", center, (8, 8), textcoords="offset points", bbox=_LABEL)
    return _plan_view(ax)


def inliers(
    points: Float[ArrayLike, "N 3"],
    labels: Int[ArrayLike, " N"],
    shapes: tuple[Shape, ...],
    ax: Any = None,
    *,
    up: Float[ArrayLike, "3"] = (0.0, -1.0, 0.0),
) -> Any:
    """The objects in 3D: points on their surface in the object's color, noise as crosses; shares of points on the surface."""
    ax = _axes(ax, (7, 6), projection="3d")
    places, owner = np.asarray(points, float) @ drawing.upright_frame(up).T, np.asarray(labels)
    inside = np.zeros(len(places), bool)
    for i, shape in enumerate(shapes):
        inside[owner == i] = np.asarray(shape.inliers)
    own = np.flatnonzero(owner >= 0)
    drawn = own[_thinned(ax, len(own))]
    good, bad = drawn[inside[drawn]], drawn[~inside[drawn]]
    tones = [drawing.rgb(i) for i in owner[good]]
    ax.scatter(*places[good].T, c=tones, s=3, depthshade=False, linewidths=0)
    label = f"noise: {len(own) - int(inside.sum())} of {len(own)} points"
    ax.scatter(*places[bad].T, c="black", s=4, marker="x", linewidths=0.3, depthshade=False, label=label)
    for i, shape in enumerate(shapes):
        body = places[owner == i]
        if len(body):
            share = 100 * np.mean(np.asarray(shape.inliers))
            ax.text(*body.mean(0)[:2], body[:, 2].max(), f"{i}: {share:.0f} %", fontsize=8, bbox=_LABEL, zorder=10)
    ax.legend(frameon=False, loc="upper left")
    _view(ax, places[drawn])
    return ax


def models(
    shapes: tuple[Shape, ...],
    ax: Any = None,
    *,
    points: Float[ArrayLike, "N 3"] | None = None,
    up: Float[ArrayLike, "3"] = (0.0, -1.0, 0.0),
) -> Any:
    """The shapes in 3D, with the points they were found in where given."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    ax = _axes(ax, (7, 6), projection="3d")
    turn = drawing.upright_frame(up).T
    places = [np.zeros((0, 3))]
    if points is not None:
        seen = np.asarray(points, float) @ turn
        places.append(seen)
        kept = _thinned(ax, len(seen), 4)
        ax.scatter(*seen[kept].T, c=drawing.NOISE_COLOR, s=1, depthshade=False, linewidths=0, alpha=0.5)
    for i, shape in enumerate(shapes):
        vertices, faces = drawing.mesh(shape.primitive)
        if len(faces) == 0:
            continue
        vertices = vertices @ turn
        places.append(vertices)
        tone = drawing.rgb(i)
        ax.add_collection3d(Poly3DCollection(vertices[faces], facecolors=tone, shade=True, alpha=0.6, linewidths=0))
        top = vertices[vertices[:, 2].argmax()]
        ax.text(*top, drawing.name(i, shape), fontsize=8, ha="center", va="bottom", bbox=_LABEL, zorder=10)
    _view(ax, np.concatenate(places))
    return ax


def overlay(image: ArrayLike, shapes: tuple[Shape, ...], rig: Rig, ax: Any = None) -> Any:
    """The left photograph with the outlines of the shapes over it."""
    from matplotlib.collections import LineCollection

    image = np.asarray(image)
    ax = _axes(ax, (8, 8 * image.shape[0] / image.shape[1]))
    ax.imshow(image, cmap="gray")
    for i, shape in enumerate(shapes):
        segments = drawing.outline(shape.primitive, rig)
        if len(segments) == 0:
            continue
        # A dark line under the colored one: visible on light and dark ground alike.
        for tone, width in (("black", 3.0), (drawing.color(i), 1.6)):
            ax.add_collection(LineCollection(list(segments), colors=tone, linewidths=width, capstyle="round"))
        top = segments.reshape(-1, 2)[segments.reshape(-1, 2)[:, 1].argmin()]
        ax.text(*top, drawing.name(i, shape), fontsize=8, ha="center", va="bottom", bbox=_LABEL, clip_on=True)
    ax.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    ax.set_axis_off()
    return ax


def memberships(points: Float[ArrayLike, "N 2"], partition: Partition, ax: Any = None) -> Any:
    """Points from above, colored by their largest membership: dark is sure, light is shared between objects."""
    ax = _axes(ax, (6.5, 5))
    points = np.asarray(points, float)
    kept = _thinned(ax, len(points))
    degrees = np.asarray(partition.memberships, float)
    drawn = ax.scatter(*points[kept].T, s=3, c=degrees[kept].max(1), cmap="cividis_r", vmin=0, vmax=1, linewidths=0)
    ax.figure.colorbar(drawn, ax=ax, label="largest membership")
    weights = degrees**2
    for i, center in enumerate((weights.T @ points) / np.maximum(weights.sum(0)[:, None], 1e-300)):
        ax.annotate(str(i), center, ha="center", va="center", fontsize=8, bbox=_LABEL)
    return _plan_view(ax)


def influence(
    points: Float[ArrayLike, "N 3"],
    by_weight: Float[ArrayLike, " N"],
    ax: Any = None,
    *,
    up: Float[ArrayLike, "3"] = (0.0, -1.0, 0.0),
    label: str = "change of the radius if left out (mm)",
    factor: float = 1e3,
) -> Any:
    """Which points decide a number: each colored by what leaving it out would change, to first order, the strongest large.

    `by_weight` is the derivative by the points' weights, as `jaxfuzzy.influence` gives it in `hyper.weights`.
    """
    ax = _axes(ax, (7, 6), projection="3d")
    points, change = np.asarray(points, float), -factor * np.asarray(by_weight, float)
    kept = _thinned(ax, len(points))
    kept = kept[np.argsort(np.abs(change[kept]))]
    places = points[kept] @ drawing.upright_frame(up).T
    # The strongest points of a hundred all get the full color, or one alone would decide the picture.
    limit = max(float(np.quantile(np.abs(change), 0.99)), 1e-300)
    strength = np.minimum(np.abs(change[kept]) / limit, 1)
    drawn = ax.scatter(
        *places.T,
        c=change[kept],
        s=3 + 45 * strength,
        cmap="PuOr",
        vmin=-limit,
        vmax=limit,
        depthshade=False,
        linewidths=0.2,
        edgecolors="dimgray",
    )
    ax.figure.colorbar(drawn, ax=ax, label=label, shrink=0.6, extend="both")
    _view(ax, places)
    return ax


def score_table(shapes: tuple[Shape, ...], ax: Any = None) -> Any:
    """The score of every kind for every object; lower is better, the kind that was chosen is marked."""
    kinds = list(dict.fromkeys(kind for shape in shapes for kind in shape.scores))
    ax = _axes(ax, (1.5 + 1.1 * len(kinds), 0.6 + 0.3 * len(shapes)))
    ax.set_axis_off()
    if not kinds:
        ax.text(0.5, 0.5, "no object was scored", ha="center", va="center", transform=ax.transAxes)
        return ax
    text = [[drawing.score_text(shape.scores.get(kind)) for kind in kinds] for shape in shapes]
    table = ax.table(text, rowLabels=[drawing.name(i, s) for i, s in enumerate(shapes)], colLabels=kinds, loc="center")
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    for i, shape in enumerate(shapes):
        if shape.kind in kinds:
            cell = table[i + 1, kinds.index(shape.kind)]
            cell.set_facecolor("#CFE8F6")
            cell.set_text_props(weight="bold")
    return ax


def figures(scene: "Scene") -> dict[str, Any]:
    """Every figure that a scene allows, by the names of `FIGURES`.

    Those of the photographs need a scene that has them; those of the paper's clustering need 6 points on objects.
    """
    from matplotlib.figure import Figure

    points, labels = np.asarray(scene.cloud.points, float), np.asarray(scene.segmentation.labels)
    drawn: dict[str, Any] = {}

    def axes(name: str, size: tuple[float, float], projection: str | None = None) -> Any:
        drawn[name] = Figure(figsize=size, layout="constrained")
        return drawn[name].add_subplot(projection=projection)

    if scene.image is not None and scene.image_right is not None:
        height, width = np.asarray(scene.image).shape[:2]
        pair(scene.image, scene.image_right, axes("pair", (9, 9 * height / (2 * width) + 0.4)))
    cloud(points, axes("cloud", (7, 6), "3d"), colors=scene.cloud.colors, up=scene.up)
    stages = paper_stages(scene)
    if stages is not None:
        pca(stages.plan, axes("pca", (6, 5)))
        histogram(stages.seeds, axes("histogram", (6, 4)))
        index_over_k(stages.choice, axes("vrc", (6, 4)))
        clusters(stages.plan, stages.partition, axes("fcm_sizes", (6, 5)))
    if scene.shapes:
        own = labels >= 0
        inliers(points, labels, scene.shapes, axes("nfcv", (7, 6), "3d"), up=scene.up)
        models(scene.shapes, axes("models", (7, 6), "3d"), points=points[own], up=scene.up)
        score_table(scene.shapes, axes("scores", (7, 0.7 + 0.28 * len(scene.shapes))))
        fuzzy = scene.segmentation.partition
        if np.asarray(fuzzy.memberships).shape[0] == len(points):
            shown = dataclasses.replace(fuzzy, memberships=fuzzy.memberships[own])
            memberships(plan(points[own], scene.up), shown, axes("memberships", (6.5, 5)))
    if scene.image is not None and scene.rig is not None:
        height, width = np.asarray(scene.image).shape[:2]
        overlay(scene.image, scene.shapes, scene.rig, axes("overlay", (8, 8 * height / width)))
    return {name: drawn[name] for name in FIGURES if name in drawn}


def paper_stages(scene: "Scene") -> PaperStages | None:
    """The paper's sections II-A to II-D on the points that lie on objects; None where there are fewer than 6.

    At most `DRAWN` points are used, every n-th, which the figures say too.
    """
    points = np.asarray(scene.cloud.points)[np.asarray(scene.segmentation.labels) >= 0]
    points = points[:: max(1, -(-len(points) // DRAWN))]
    if len(points) <= max(PAPER_KS):
        return None
    flat = plan(points, scene.up)
    count = choose_k(flat, PAPER_KS, index="vrc", rule="paper")
    seeds = histogram_seeds(flat, int(count.k))
    return PaperStages(flat, seeds, count, fcm(flat, count.partition.centers, sizes=True))


def plan(points: Float[ArrayLike, "N 3"], up: Float[ArrayLike, "3"]) -> np.ndarray:
    """Points from above (N, 2): to the right and away from the camera, the paper's x and z."""
    points = np.asarray(points)
    return points @ drawing.upright_frame(up)[:2].T.astype(points.dtype)


def png(figure: Any, dpi: int = 110) -> bytes:
    """A figure as PNG; the same figure gives the same bytes."""
    file = io.BytesIO()
    layout, before = figure.get_layout_engine(), figure.dpi
    try:
        # Laid out by us, a figure is drawn once; saving draws one that has its layout to find twice.
        if layout is not None:
            figure.set_dpi(dpi)
            layout.execute(figure)
            figure.set_layout_engine(None)
        # The default level of compression takes two thirds of the time of drawing, to save a tenth of the bytes.
        figure.savefig(file, format="png", dpi=dpi, metadata={"Software": None}, pil_kwargs={"compress_level": 3})
    finally:
        figure.set_dpi(before)
        figure.set_layout_engine(layout)
    return file.getvalue()


_LABEL = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}


def _axes(ax: Any, size: tuple[float, float], projection: str | None = None) -> Any:
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.figure(figsize=size, layout="constrained").add_subplot(projection=projection)


def _thinned(ax: Any, count: int, share: int = 1) -> np.ndarray:
    """Which points to draw: every n-th where there are more than `DRAWN / share`, and then a note in the axes' title."""
    step = max(1, -(-count * share // DRAWN))
    if step > 1:
        ax.set_title(f"one point in {step} drawn", fontsize=8, color="dimgray", loc="right")
    return np.arange(0, count, step)


def _view(ax: Any, places: np.ndarray) -> None:
    """Looks from the camera's side and a little above, at what lies in the middle 98 % of the points."""
    if len(places):
        low, high = np.percentile(places, [1, 99], axis=0)
        room = 0.05 * (high - low).max() + 1e-9
        low, high = low - room, high + room
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        ax.set_box_aspect(high - low, zoom=1.15)
    ax.view_init(elev=25, azim=-75)
    ax.set(xlabel="right (m)", ylabel="away (m)", zlabel="up (m)")
    ax.tick_params(labelsize=7)
    ax.locator_params(nbins=5)


def _plan_view(ax: Any) -> Any:
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x, to the right (m)", ylabel="z, away from the camera (m)")
    return _bare(ax)


def _bare(ax: Any) -> Any:
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def _subscript(number: int) -> str:
    return str(number).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))
