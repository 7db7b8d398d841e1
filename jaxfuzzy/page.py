"""The report: one HTML page that works offline, with the photograph, a 3D view, every object's numbers and the figures.

The page's form is `data/report.html`, the 3D view's behavior `data/viewer.js`; K3D (extra `view`) draws it.
"""

import base64
import html as markup
import io
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfuzzy import drawing
from jaxfuzzy.drawing import Measure
from jaxfuzzy.plot import FIGURES

if TYPE_CHECKING:
    from jaxfuzzy.scene import Scene

DATA = Path(__file__).parent / "data"
# More points make the page large, a wider photograph too; the page says where it shows fewer.
POINTS_SHOWN = 60_000
PHOTOGRAPH_WIDTH = 1200
# The parameters that say where a shape is.
PLACES = ("point", "center", "base", "apex")
# The photograph with outlines and the score tables stand on the page already.
LEFT_OUT = ("overlay", "scores")


def html(scene: "Scene", tree: Mapping[str, Any], pictures: Mapping[str, bytes]) -> str:
    """The page as text.

    Args:
        scene: The scene.
        tree: The same as `report.to_dict` gives it.
        pictures: The figures as PNG, by file name.
    """
    metric = tree["units"]["length"] == "m"
    kept = slice(None, None, max(1, -(-tree["points"] // POINTS_SHOWN)))
    kinds = [shape.kind for shape in scene.shapes]
    counted = [f"{kinds.count(k)} × {k}" for k in dict.fromkeys(kinds)]
    summary = f"{tree['points']:,} points; {', '.join(counted) or 'no objects'}."
    if kept.step > 1:
        summary += f" The 3D view shows one point in {kept.step}."
    parts = {
        "title": f"{len(kinds)} object{'' if len(kinds) == 1 else 's'} found",
        "summary": _text(summary),
        "notes": "\n".join(f'<p class="note">{_text(reason)}</p>' for reason in tree["reasons"]),
        "photograph": _photograph(scene),
        "viewer": markup.escape(viewer(scene, kept)),
        "objects": _objects(tree["shapes"], metric),
        "details": "\n".join(_details(entry, metric) for entry in tree["shapes"]),
        "figures": "\n".join(_figures(pictures)),
        "facts": _facts(tree),
    }
    page = (DATA / "report.html").read_text(encoding="utf-8")
    for name, part in parts.items():
        page = page.replace("{{" + name + "}}", part)
    return page


def viewer(scene: "Scene", kept: slice) -> str:
    """The 3D view as a page of its own: points and shapes, x right, y away from the camera, z up."""
    import k3d

    turn = drawing.upright_frame(scene.up).T
    places = (np.asarray(scene.cloud.points, float) @ turn).astype(np.float32)[kept]
    plot = k3d.plot(
        menu_visibility=False,
        grid_visible=False,
        axes_helper=0,
        camera_auto_fit=False,
        camera_mode="orbit",
        camera_up_axis="z",
        camera_damping_factor=0.0,
        logarithmic_depth_buffer=False,
    )
    if scene.cloud.colors is None:
        tones = np.array([_hex(i) for i in range(-1, len(scene.shapes))])[
            np.asarray(scene.segmentation.labels)[kept] + 1
        ]
    else:
        tones = np.rint(np.clip(np.asarray(scene.cloud.colors, float)[kept], 0, 1) * 255).astype(int)
        tones = tones @ np.array([1 << 16, 1 << 8, 1])
    own = np.asarray(scene.segmentation.labels)[kept] >= 0
    # Looks at the objects where there are any, else at everything.
    low, high = np.percentile(places[own] if own.any() else places, [1, 99], axis=0)
    cloud = k3d.points(
        places,
        colors=tones.astype(np.uint32),
        point_size=0.8 * _spacing(scene) * math.sqrt(kept.step),
        shader="flat",
        name="points",
        compression_level=9,
    )
    plot += cloud
    models = {}
    for index, shape in enumerate(scene.shapes):
        vertices, faces = drawing.mesh(shape.primitive)
        if len(faces) == 0:
            continue
        mesh = k3d.mesh(
            (vertices @ turn).astype(np.float32),
            faces.astype(np.uint32),
            color=_hex(index),
            opacity=0.75,
            side="double",
            flat_shading=False,
            name=drawing.name(index, shape),
            click_callback=lambda *_: None,  # makes the shape clickable on the page; viewer.js hears the click
        )
        plot += mesh
        models[mesh.id] = index
        low, high = np.minimum(low, (vertices @ turn).min(0)), np.maximum(high, (vertices @ turn).max(0))
    focus, reach = (low + high) / 2, float(np.linalg.norm(high - low))
    focus = focus - [0.0, 0.0, 0.08 * reach]  # what is near looks larger, so the middle of the picture lies lower
    views = {
        "front": [*(focus + reach * np.array([0.0, -0.7, 0.4])), *focus, 0, 0, 1],
        "above": [*(focus + reach * np.array([0.0, -0.01, 0.8])), *focus, 0, 0, 1],
    }
    meta = {"models": models, "clouds": [cloud.id]} | {name: [float(v) for v in view] for name, view in views.items()}
    plot.camera = meta["front"]
    script = f"const META = {json.dumps(meta)};\n" + (DATA / "viewer.js").read_text(encoding="utf-8")
    return str(plot.get_snapshot(additional_js_code=script))


def _photograph(scene: "Scene") -> str:
    if scene.image is None or scene.rig is None:
        return ""
    from PIL import Image

    image = Image.fromarray(np.asarray(scene.image))
    width, height = image.size
    image.thumbnail((PHOTOGRAPH_WIDTH, PHOTOGRAPH_WIDTH))
    file = io.BytesIO()
    image.save(file, "JPEG", quality=88)
    groups = []
    depths = [math.inf if (p := drawing.position(s)) is None else float(p[2]) for s in scene.shapes]
    for index in np.argsort(depths)[::-1]:  # near ones last, so that they are clicked first
        shape = scene.shapes[index]
        segments = drawing.outline(shape.primitive, scene.rig)
        if len(segments) == 0:
            continue
        hull = " ".join(f"{x:.1f},{y:.1f}" for x, y in drawing.silhouette(shape.primitive, scene.rig))
        path = "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in segments)
        x, y = segments.reshape(-1, 2).mean(0)
        name = _text(f"object {drawing.name(int(index), shape)}")
        groups.append(
            f'<g class="shape" data-object="{index}" role="button" tabindex="0" aria-pressed="false" aria-label="{name}">'
            f'<title>{name}</title><polygon points="{hull}"/><path class="under" d="{path}"/>'
            f'<path class="line" stroke="{drawing.color(int(index))}" d="{path}"/>'
            f'<text x="{x:.1f}" y="{y:.1f}" font-size="{width / 32:.1f}" dy="0.35em">{index}</text></g>'
        )
    return (
        f'<div class="view" id="photograph"><svg viewBox="-0.5 -0.5 {width} {height}" role="group" '
        'aria-label="Left photograph with the outlines of the shapes">'
        f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="{_data(file.getvalue(), "jpeg")}"/>'
        f"{''.join(groups)}</svg></div>"
    )


def _objects(entries: Iterable[Mapping[str, Any]], metric: bool) -> str:
    rows = []
    for entry in entries:
        index = entry["object"]
        remarks = "".join(
            f'<span class="remark">{_text(r.split(":")[0].rstrip("."))}.</span>' for r in entry["reasons"]
        )
        cells = (("Sizes", _sizes(entry, metric) + remarks, ""), ("Points", f"{entry['points']:,}", "number"),
                 ("On the surface", _share(entry), "number"))  # fmt: skip
        rows.append(
            f'<tr data-object="{index}"><th scope="row"><button type="button" aria-pressed="false">'
            f'<span class="swatch" style="background:{drawing.color(index)}"></span>{index} {_text(entry["kind"])}'
            f"</button></th>{''.join(_cell(*cell) for cell in cells)}</tr>"
        )
    return (
        '<table id="objects"><thead><tr><th scope="col">Object</th><th scope="col">Sizes</th><th scope="col" '
        'class="number">Points</th><th scope="col" class="number">On the surface</th></tr>'
        f"</thead><tbody>{''.join(rows)}</tbody></table>"
    )


def _details(entry: Mapping[str, Any], metric: bool) -> str:
    index = entry["object"]
    facts = [(m.name, drawing.measure_text(m, metric=metric)) for m in _measures(entry)]
    facts += [("points", f"{entry['points']:,}"), ("on the surface", f"{entry['inliers']:,} ({_share(entry)})")]
    length = Measure("noise distance", entry["noise_distance"], None)
    facts.append((length.name, drawing.measure_text(length, metric=metric)))
    for name, value in (entry["parameters"] or {}).items():
        if name in PLACES:
            facts.append((name, _numbers(value) + (" m" if metric else "")))
        elif name in ("axis", "axes", "normal", "coefficients"):
            facts.append((name, _numbers(value)))
    notes = "".join(f'<p class="note">{_text(reason)}</p>' for reason in entry["reasons"])
    ranked = sorted(entry["scores"].items(), key=lambda item: math.inf if item[1] is None else item[1])
    scores = "".join(
        f'<tr class="{"chosen" if kind == entry["kind"] else ""}"><th scope="row">{_text(kind)}</th>'
        f'<td class="number">{drawing.score_text(score)}</td></tr>'
        for kind, score in ranked
    )
    table = (
        "<table><caption>Scores, lower is better</caption><thead><tr><th scope='col'>Kind</th>"
        f"<th scope='col' class='number'>Score</th></tr></thead><tbody>{scores}</tbody></table>"
    )
    return (
        f'<section class="object" data-object="{index}" id="object-{index}"><h3><span class="swatch" '
        f'style="background:{drawing.color(index)}"></span>Object {index}: {_text(entry["kind"])}</h3>'
        f"{_list(facts)}{notes}{table if ranked else ''}</section>"
    )


def _figures(pictures: Mapping[str, bytes]) -> Iterable[str]:
    for file, picture in pictures.items():
        name = Path(file).stem
        if name not in LEFT_OUT:
            text = _text(FIGURES[name])
            yield (
                f'<figure id="figure-{name}"><img src="{_data(picture, "png")}" alt="{text}" loading="lazy">'
                f"<figcaption>{text}</figcaption></figure>"
            )


def _facts(tree: Mapping[str, Any]) -> str:
    timings = [(stage, f"{seconds:.2f} s") for stage, seconds in tree["timings"].items()]
    parts = {
        "Settings": [
            (name, value if isinstance(value, str) else json.dumps(value)) for name, value in tree["settings"].items()
        ],
        "Timings": [*timings, ("together", f"{sum(tree['timings'].values()):.2f} s")] if timings else [],
        "Versions": list(tree["made_with"].items()),
    }
    return "".join(f"<section><h3>{title}</h3>{_list(facts)}</section>" for title, facts in parts.items() if facts)


def _measures(entry: Mapping[str, Any]) -> list[Measure]:
    return [Measure(**measure) for measure in entry["sizes"]]


def _sizes(entry: Mapping[str, Any], metric: bool) -> str:
    texts = (f"{m.name} {drawing.measure_text(m, metric=metric)}" for m in _measures(entry))
    return " ".join(f'<span class="size">{_text(text)}</span>' for text in texts) or "–"


def _share(entry: Mapping[str, Any]) -> str:
    return f"{100 * entry['inliers'] / max(entry['points'], 1):.0f} %"


def _cell(label: str, text: str, kind: str) -> str:
    return f'<td class="{kind}" data-label="{label}">{text}</td>'


def _list(facts: Iterable[tuple[str, str]]) -> str:
    return "<dl>" + "".join(f"<dt>{_text(name)}</dt><dd>{_text(value)}</dd>" for name, value in facts) + "</dl>"


def _numbers(value: Any) -> str:
    return f"({', '.join(map(_numbers, value))})" if isinstance(value, list) else f"{value:.4g}"


def _spacing(scene: "Scene") -> float:
    """About the distance between neighbouring points: one pixel's width where there is a camera."""
    points = np.asarray(scene.cloud.points, float)
    if scene.rig is not None:
        return float(np.median(points[:, 2])) / scene.rig.focal_px[0]
    low, high = np.percentile(points, [1, 99], axis=0)
    return float(np.linalg.norm(high - low)) / math.sqrt(len(points))


def _hex(index: int) -> int:
    return int(drawing.color(index)[1:], 16)


def _data(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _text(value: str) -> str:
    return markup.escape(value)
