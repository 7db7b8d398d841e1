"""From images to objects: rendered tables with exact truth, and what real photographs are taken for.

    python benchmarks/scenes.py [--data FOLDER] [--only PART ...]

Prints a table a question, writes every figure to benchmarks/results/scenes.json and the photographs, with what was found drawn
over them, to benchmarks/results/scenes.jpg. Kinds and sizes of rendered tables are compared with the truth of the object that
most of the points belong to. What a person sees at a place of a photograph stands in PLACES; nothing of it is told to the library.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from common import RESULTS, provenance, table, timings, write
from spoilt import SPOILT

import jaxfuzzy as jf
from jaxfuzzy.photos import read_pair
from jaxfuzzy.render import Rendered, render_pair, table_scene

# folder, left, right; of lampshade1 the offset is not known, so that its lengths are in no unit and its shapes are bent
PHOTOGRAPHS = {
    "cones": ("middlebury2003_cones", "im2.png", "im6.png"),
    "cones, full size": ("middlebury2003_cones_full", "im2.png", "im6.png"),
    "bowling1": ("middlebury2006_bowling1_half", "view1.png", "view5.png"),
    "art": ("middlebury2005_art", "view1.png", "view5.png"),
    "lampshade1": ("middlebury2006_lampshade1_third", "view1.png", "view5.png"),
    "baby1": ("middlebury2006_baby1_half", "view1.png", "view5.png"),
    "books": ("middlebury2005_books", "view1.png", "view5.png"),
    "recycle": ("middlebury2014_recycle_quarter", "im0.png", "im1.png"),
    "jadeplant": ("middlebury2014_jadeplant_quarter", "im0.png", "im1.png"),
    "adirondack": ("middlebury2014_adirondack_quarter", "im0.png", "im1.png"),
}
# photograph, what a person sees there, column and row, the kinds that would be right ("unknown": it is no primitive)
PLACES = (
    ("cones", "mask", 330, 150, ("unknown", "quadric")),
    ("cones", "mug", 395, 320, ("cylinder",)),
    ("cones", "green cone in front", 237, 320, ("cone",)),
    ("cones", "green cone at the left", 120, 320, ("cone",)),
    ("cones", "red cone at the left", 78, 260, ("cone",)),
    ("cones", "white cone behind", 235, 120, ("cone",)),
    ("cones", "box of matches", 340, 340, ("box", "plane")),
    ("bowling1", "ball", 250, 250, ("sphere",)),
    ("bowling1", "pins with cloth", 70, 250, ("unknown", "quadric")),
    ("art", "bust", 150, 110, ("unknown", "quadric")),
    # Of the jug the right camera sees the handle and the edge alone: the true disparity left of column 63 leads out of its image.
    ("art", "jug", 72, 270, ("unknown", "quadric")),
    ("art", "cone", 230, 240, ("cone",)),
    ("art", "lying crayon", 213, 328, ("cylinder",)),
    ("art", "cup", 385, 310, ("cylinder", "cone")),
    ("lampshade1", "panel", 242, 110, ("box", "plane")),
    ("lampshade1", "carton", 360, 293, ("box", "plane")),
    ("lampshade1", "notched block", 367, 147, ("box", "plane")),
    ("lampshade1", "hat box", 44, 293, ("cylinder",)),
    ("lampshade1", "cylinder on the hat box", 40, 176, ("cylinder",)),
    ("lampshade1", "crumpled lampshade", 220, 293, ("unknown", "quadric", "cone")),
    ("baby1", "hat box", 300, 440, ("cylinder",)),
    ("baby1", "doll", 300, 240, ("unknown", "quadric")),
    ("recycle", "bin", 300, 300, ("box",)),
    ("jadeplant", "plant", 320, 120, ("unknown", "quadric")),
    ("jadeplant", "flower pot", 330, 350, ("cone",)),
    ("jadeplant", "carton at the left", 110, 340, ("box", "plane")),
    ("adirondack", "mug", 364, 155, ("cylinder",)),
    ("adirondack", "book at the left", 118, 254, ("box", "plane")),
)
# Settings of the matcher that the cones are looked at by.
SETTINGS: tuple[dict[str, Any], ...] = (
    {},
    {"smoothness": (3.0, 32.0)},
    {"smoothness": (8.0, 32.0)},
    {"block": 5},
    {"smoothness": (8.0, 32.0), "block": 5},
    {"method": "hh"},
    {"left_right_px": None},
    {"edge_px": 2},
    {"uniqueness": 5},
    {"refine": False},
)
# Of the other pictures that places are looked for in: size, light of the right one, how many draws of rounding and how large.
SMALLER, DARKER, DRAWS, LAST_DIGIT = 0.8, 0.75, 3, 3e-7
BALL_RADIUS_MM = 203.7  # of a sphere fitted to the true disparities; lengths of this pair are nominal
NEAR_PX = 6


def owner_at(scene: jf.Scene, column: float, row: float) -> int | None:
    """The object that most points around a place belong to."""
    pixels, labels = np.asarray(scene.cloud.pixels_px), np.asarray(scene.segmentation.labels)
    here = labels[(np.abs(pixels - [column, row]).max(axis=1) <= NEAR_PX) & (labels >= 0)]
    return int(np.bincount(here).argmax()) if len(here) else None


def kind_at(scene: jf.Scene, column: float, row: float) -> str:
    """What that object is named."""
    owner = owner_at(scene, column, row)
    return "nothing" if owner is None else scene.shapes[owner].kind


def rig_of(data: Path, folder: str) -> jf.Rig:
    """The cameras of a photograph; focal length and baseline alone, as its source tells them, where there is no file."""
    path = data / folder / "calib.txt"
    if path.exists():
        return jf.load_rig(path)
    return jf.Rig((3740 / 3, 3740 / 3), (216.0, 184.5), 0.16, (433, 370), max_disparity_px=80, metric=False)


def sizes_of(kind: str, primitive: Any) -> dict[str, float]:
    """The lengths (mm) and angles (degrees) that are compared."""
    if kind in ("sphere", "cylinder"):
        return {"radius": 1e3 * float(primitive.radius)}
    return {"half-angle": float(np.degrees(primitive.half_angle))} if kind == "cone" else {}


def rendered(_: Path, seeds: int = 20) -> dict[str, Any]:
    """Random tables of four objects, one of each kind, camera tilted by 0 to 35 degrees."""
    rows, right_kinds, right_counts = [], [], []
    errors: dict[str, list[float]] = {"radius": [], "half-angle": [], "in deviations": []}
    for seed in range(seeds):
        tilt = 35 * seed / (seeds - 1)
        picture = render_pair(table_scene(seed, tilt=np.deg2rad(tilt)), seed=seed)
        scene = jf.model_scene(picture.left, picture.right, picture.rig)
        found = compared(scene, picture, errors)
        right_counts.append(scene.segmentation.k == len(picture.objects))
        right_kinds += found.values()
        wrong = [name for name, good in found.items() if not good]
        rows.append((seed, tilt, scene.segmentation.k, sum(found.values()), ", ".join(wrong) or "none"))
    table("Rendered tables, four objects each", ("seed", "tilt", "k", "kinds right", "wrong"), rows)
    result = {
        "scenes": seeds,
        "count right": float(np.mean(right_counts)),
        "kinds right": float(np.mean(right_kinds)),
        "median error": {name: float(np.median(e)) for name, e in errors.items() if e},
    }
    print(result)
    return result | {"rows": rows}


def compared(scene: jf.Scene, picture: Rendered, errors: dict[str, list[float]]) -> dict[str, bool]:
    """Whether each true object was found alone and named rightly; sizes of the right ones are added to `errors`."""
    columns, lines = np.round(np.asarray(scene.cloud.pixels_px)).astype(int).T
    truth, labels = picture.labels[lines, columns], np.asarray(scene.segmentation.labels)
    owners = {i: int(np.bincount(truth[labels == i] + 1).argmax()) - 1 for i in range(scene.segmentation.k)}
    found = {}
    for index, primitive in enumerate(picture.objects):
        kind = type(primitive).__name__.lower()
        mine = [i for i, owner in owners.items() if owner == index]
        right = len(mine) == 1 and scene.shapes[mine[0]].kind == kind
        found[f"{kind} as {'+'.join(scene.shapes[i].kind for i in mine) or 'nothing'}"] = right
        if right:
            shape = scene.shapes[mine[0]]
            measured, deviation = sizes_of(kind, shape.primitive), np.sqrt(np.diag(np.asarray(shape.covariance)))
            for name, value in sizes_of(kind, primitive).items():
                errors[name].append(abs(measured[name] / value - 1))
                place = shape.primitive.parameter_names.index(name.replace("-", "_"))
                unit = 1e3 if name == "radius" else np.degrees(1)
                errors["in deviations"].append(abs(measured[name] - value) / (unit * deviation[place]))
    return found


def photographs(data: Path) -> dict[str, Any]:
    """What real photographs are taken for."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(4, 3, figsize=(13, 14.5), layout="constrained")
    for ax in axes.flat[len(PHOTOGRAPHS) :]:
        ax.set_axis_off()
    scenes: dict[str, jf.Scene] = {}
    results: dict[str, Any] = {}
    for (name, (folder, left, right)), ax in zip(PHOTOGRAPHS.items(), axes.flat, strict=False):
        rig = rig_of(data, folder)
        scene = scenes[name] = jf.model_scene(data / folder / left, data / folder / right, rig)
        jf.plot.overlay(scene.image, scene.shapes, scene.rig, ax=ax)
        ax.set_title(name)
        results[name] = [
            {
                "kind": shape.kind,
                **{k: round(v, 2) for k, v in sizes_of(shape.kind, shape.primitive).items()},
                "points": int(size),
            }
            for shape, size in zip(
                scene.shapes, np.bincount(np.asarray(scene.segmentation.labels) + 1)[1:], strict=True
            )
        ]
    RESULTS.mkdir(exist_ok=True)
    figure.savefig(RESULTS / "scenes.jpg", dpi=90, pil_kwargs={"quality": 80})
    rows = []
    for name, seen, column, row, kinds in PLACES:
        kind = kind_at(scenes[name], column, row)
        rows.append((name, seen, kind, "yes" if kind in kinds else "no"))
    table("What a person sees and what it is named", ("photograph", "seen", "named", "right"), rows)
    full = [shape for shape in scenes["cones, full size"].shapes if shape.kind == "cone"]
    angles = sorted(round(float(np.degrees(shape.primitive.half_angle)), 1) for shape in full)
    print(
        f"cones, full size: {len(full)} cones, half-angles {angles}, {sum(16 <= a <= 24 for a in angles)} within 16-24"
    )
    ball = owner_at(scenes["bowling1"], 250, 250)
    shape = None if ball is None else scenes["bowling1"].shapes[ball]
    radius = sizes_of("sphere", shape.primitive)["radius"] if shape and shape.kind == "sphere" else None
    print(f"bowling1: radius {radius} mm, by the true disparities {BALL_RADIUS_MM} mm")
    return {
        "named": [dict(zip(("photograph", "seen", "named", "right"), row, strict=True)) for row in rows],
        "objects": results,
        "half-angles, full size": angles,
        "ball radius mm": radius,
    }


def variants(data: Path) -> dict[str, Any]:
    """Places named rightly in the photographs mirrored, smaller, darker on one side, noisy, compressed, with other last digits."""
    rows = []
    for name, (folder, *images) in PHOTOGRAPHS.items():
        places = [place[1:] for place in PLACES if place[0] == name]
        if not places:
            continue
        rig = rig_of(data, folder)
        left, right = read_pair(*(data / folder / image for image in images), rig)
        plain = jf.model_scene(left, right, rig)
        pixels, depth = np.asarray(plain.cloud.pixels_px), np.asarray(plain.cloud.points)[:, 2]
        disparity = rig.focal_px[0] * rig.baseline_m / depth - rig.doffs_px
        width, height = left.shape[1], left.shape[0]
        size = (round(SMALLER * width), round(SMALLER * height))
        small = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
        turned = dataclasses.replace(rig, center_px=(width - 1 - rig.center_px[0] - rig.doffs_px, rig.center_px[1]))
        dark = np.rint(DARKER * right).astype(np.uint8)
        at = {"as photographed": (plain, lambda x, y, _: (x, y))}
        at["mirrored"] = (
            jf.model_scene(right[:, ::-1], left[:, ::-1], turned),
            lambda x, y, d, width=width: (width - 1 - x + d, y),
        )
        at["smaller"] = (jf.model_scene(*small, rig.scaled(size)), lambda x, y, _: (SMALLER * x, SMALLER * y))
        at["right image darker"] = (jf.model_scene(left, dark, rig), lambda x, y, _: (x, y))
        for change, spoil in SPOILT.items():
            at[change] = (jf.model_scene(*spoil(left, right), rig), lambda x, y, _: (x, y))
        for draw in range(DRAWS):
            noise = np.random.default_rng(draw).standard_normal(plain.cloud.points.shape)
            points = (np.asarray(plain.cloud.points) * (1 + LAST_DIGIT * noise)).astype(np.float32)
            cloud = dataclasses.replace(plain.cloud, points=jax.numpy.asarray(points))
            at[f"other last digits, {draw + 1}"] = (jf.model_cloud(cloud), lambda x, y, _: (x, y))
        for variant, (scene, moved) in at.items():
            for seen, column, row, kinds in places:
                near = np.abs(pixels - [column, row]).max(axis=1) <= NEAR_PX
                shift = float(np.median(disparity[near])) if near.any() else 0.0
                kind = kind_at(scene, *moved(column, row, shift))
                rows.append((variant, name, seen, kind, "yes" if kind in kinds else "no"))
    told: dict[str, list[bool]] = {}
    for variant, *_, right in rows:
        told.setdefault(variant, []).append(right == "yes")
    table(
        f"The {len(PLACES)} places in other pictures of them",
        ("pictures", "right"),
        [(variant, sum(good)) for variant, good in told.items()],
    )
    return {"right": {variant: sum(good) for variant, good in told.items()}, "rows": rows}


def duration(data: Path) -> dict[str, Any]:
    """Images to models, warm, beside one run of bare SGBM."""
    rows, result = [], {}
    for name, disparities in (("cones", 64), ("cones, full size", 240)):
        folder, left, right = PHOTOGRAPHS[name]
        rig = jf.load_rig(data / folder / "calib.txt")
        pair = [cv2.imread(str(data / folder / image)) for image in (left, right)]
        whole = timings(lambda pair=pair, rig=rig: jf.model_scene(*pair, rig), 3)
        matcher = cv2.StereoSGBM.create(minDisparity=0, numDisparities=disparities, blockSize=5)
        bare = timings(lambda pair=pair, matcher=matcher: matcher.compute(*pair), 5)
        result[name] = {"seconds": whole["median"], "sgbm": bare["median"], "ratio": whole["median"] / bare["median"]}
        rows.append((name, whole["median"], bare["median"], whole["median"] / bare["median"]))
    table("Images to models, warm, beside one run of SGBM", ("", "seconds", "SGBM", "ratio"), rows)
    return result


def settings(data: Path) -> dict[str, Any]:
    """What the cones are taken for by other settings of the matcher: how many of their places are named rightly."""
    folder, left, right = PHOTOGRAPHS["cones"]
    rig = rig_of(data, folder)
    places = [place[1:] for place in PLACES if place[0] == "cones"]
    rows = []
    for options in SETTINGS:
        scene = jf.model_scene(data / folder / left, data / folder / right, rig, matcher=jf.Matcher(**options))
        wrong = []
        for seen, column, row, kinds in places:
            kind = kind_at(scene, column, row)
            wrong += [] if kind in kinds else [f"{seen} as {kind}"]
        cones = sum(shape.kind == "cone" for shape in scene.shapes)
        told = ", ".join(f"{name}={value}" for name, value in options.items()) or "default"
        rows.append((told, len(places) - len(wrong), cones, ", ".join(wrong) or "none"))
    table(f"Cones by other settings, {len(places)} places", ("matcher", "right", "cones named", "wrong"), rows)
    return {"rows": rows}


PARTS = {
    "rendered": rendered, "photographs": photographs, "settings": settings, "variants": variants, "duration": duration
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(__file__).parents[2] / "shared" / "data"
    parser.add_argument(
        "--data", type=Path, default=data, help="folder of real pairs; without it those parts are left out"
    )
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    args = parser.parse_args()
    print(provenance(), jax.default_backend())
    results = {}
    for name in args.only:
        if name != "rendered" and not args.data.is_dir():
            print(f"{name} is left out: no data at {args.data}")
            continue
        results[name] = PARTS[name](args.data)
    if set(results) == set(PARTS):
        write("scenes", results)


if __name__ == "__main__":
    main()
