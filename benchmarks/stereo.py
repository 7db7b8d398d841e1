"""How well the stereo stage matches: real pairs with ground truth beside bare OpenCV, rendered pairs, a calibration.

    python benchmarks/stereo.py [--data FOLDER] [--only PART ...]

Prints a table a question and writes every figure to benchmarks/results/stereo.json. A pixel is answered where a disparity
is given; cover is the share of pixels with known truth that are answered, bad-2 the share of those that are wrong by more
than 2 px, deviation the robust standard deviation of the error, pixels a point how many neighboring pixels make one
independent measurement. Times are of this run on this machine; only their ratios mean something.
"""

import argparse
import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import provenance, table, timings, write
from spoilt import SPOILT

from jaxfuzzy.calibrate import calibrate
from jaxfuzzy.checks import DataError
from jaxfuzzy.matcher import Matcher
from jaxfuzzy.photos import read_disparity, read_pair
from jaxfuzzy.render import render_pair, table_scene
from jaxfuzzy.reproject import measure_noise
from jaxfuzzy.rig import Rig, load_rig
from jaxfuzzy.stereo import disparity, reconstruct

# folder, left, right, truth, what its numbers are divided by, disparities for bare OpenCV (which must be told)
SCENES = {
    "cones": ("middlebury2003_cones", "im2.png", "im6.png", "disp2.png", 4, 64),
    "bowling1": ("middlebury2006_bowling1_half", "view1.png", "view5.png", "disp1.png", 2, 128),
    "baby1": ("middlebury2006_baby1_half", "view1.png", "view5.png", "disp1.png", 2, 80),
    "lampshade1": ("middlebury2006_lampshade1_third", "view1.png", "view5.png", "disp1.png", 3, 80),
    "art": ("middlebury2005_art", "view1.png", "view5.png", "disp1.png", 3, 80),
    "books": ("middlebury2005_books", "view1.png", "view5.png", "disp1.png", 3, 80),
    "venus": ("middlebury2001_venus", "im2.png", "im6.png", "disp2.png", 8, 32),
    "poster": ("middlebury2001_poster", "im2.png", "im6.png", "disp2.png", 8, 32),
    "recycle": ("middlebury2014_recycle_quarter", "im0.png", "im1.png", "disp0GT.pfm", 1, 64),
    "jadeplant": ("middlebury2014_jadeplant_quarter", "im0.png", "im1.png", "disp0GT.pfm", 1, 160),
    "adirondack": ("middlebury2014_adirondack_quarter", "im0.png", "im1.png", "disp0GT.pfm", 1, 80),
    "motorcycle": ("skimage_motorcycle", "motorcycle_left.png", "motorcycle_right.png", "motorcycle_disp.npz", 1, 80),
    "aloe (truth in whole px)": ("opencv_aloe", "aloeL.jpg", "aloeR.jpg", "aloeGT.png", 1, 224),
}
SETTINGS: dict[str, Matcher | None] = {
    "bare OpenCV": None,
    "unchecked": Matcher(left_right_px=None, edge_px=0),
    "default": Matcher(),
    "unrefined": Matcher(refine=False),
    "hh": Matcher(method="hh"),
    "bm": Matcher(method="bm"),
}
# Gain and offset of the grey levels, and of which image.
LIGHT = {
    "as photographed": (1.0, 0.0, 1),
    "right × 0.9": (0.9, 0.0, 1),
    "right × 0.75 + 10": (0.75, 10.0, 1),
    "left × 0.6": (0.6, 0.0, 0),
}
FIGURES = ("cover", "bad2", "bad1", "median_px", "deviation_px", "bias_px", "pixels_a_point")


def bare(left: np.ndarray, right: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    values = cv2.StereoSGBM.create(minDisparity=0, numDisparities=count, blockSize=5).compute(left, right) / 16
    return values, values > -0.5


def judged(values: Any, valid: Any, truth: np.ndarray) -> dict[str, float]:
    values, valid = np.asarray(values), np.asarray(valid)
    known = np.isfinite(truth)
    answered = known & valid
    error = (values - truth)[answered]
    figures = {
        "cover": answered.sum() / known.sum(),
        "bad2": np.mean(np.abs(error) > 2),
        "bad1": np.mean(np.abs(error) > 1),
        "median_px": np.median(np.abs(error)),
        "deviation_px": 1.4826 * np.median(np.abs(error - np.median(error))),
        "bias_px": np.median(error),
    }
    with contextlib.suppress(DataError):  # too few pixels to tell
        figures["pixels_a_point"] = measure_noise(values, answered, truth_px=truth).pixels_per_point
    return {name: round(float(value), 4) for name, value in figures.items()}


def line(figures: dict[str, float]) -> list[float | str]:
    return [figures.get(name, "") for name in FIGURES]


def matching(data: Path) -> dict[str, Any]:
    results: dict[str, Any] = {}
    for scene, left, right, truth, rig, count in pairs(data):
        results[scene] = {
            setting: judged(
                *(bare(left, right, count) if matcher is None else disparity(left, right, rig, matcher=matcher)), truth
            )
            for setting, matcher in SETTINGS.items()
        }
        table(scene, ("setting", *FIGURES), [(setting, *line(row)) for setting, row in results[scene].items()])
    means = {
        setting: {name: float(np.mean([rows[setting][name] for rows in results.values()])) for name in FIGURES}
        for setting in SETTINGS
    }
    table("Mean of these scenes", ("setting", *FIGURES), [(setting, *line(row)) for setting, row in means.items()])
    for setting in ("unchecked", "default"):
        for figure, sign in (("cover", 1), ("bad2", -1)):
            worse = [
                s for s, rows in results.items() if sign * (rows[setting][figure] - rows["bare OpenCV"][figure]) < 0
            ]
            print(f"{setting}: {figure} worse than bare OpenCV's on {', '.join(worse) or 'no scene'}")
    return results | {"mean": means}


def pairs(data: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray, Rig, int]]:
    """Name, images, truth, rig and number of disparities of each real pair."""
    for scene, (name, left_name, right_name, truth_name, scale, count) in SCENES.items():
        folder = data / name
        truth = read_disparity(folder / truth_name, scale=scale)
        left, right = (cv2.imread(str(folder / image)) for image in (left_name, right_name))
        # Three sets have no calibration; matching needs none beyond the size.
        plain = Rig((1000, 1000), (0, 0), 0.1, (left.shape[1], left.shape[0]))
        rig = load_rig(folder / "calib.txt") if (folder / "calib.txt").exists() else plain
        yield scene, left, right, truth, rig, count


def brightness(data: Path) -> dict[str, Any]:
    """The same pairs with less light in one image: means over the scenes."""
    rows: dict[str, dict[str, list[dict[str, float]]]] = {}
    for _, left, right, truth, rig, count in pairs(data):
        for change, (gain, offset, which) in LIGHT.items():
            images = [left, right]
            images[which] = np.rint(images[which] * gain + offset).astype(np.uint8)
            found = rows.setdefault(change, {"bare OpenCV": [], "default": []})
            found["bare OpenCV"].append(judged(*bare(*images, count), truth))
            found["default"].append(judged(*disparity(*images, rig), truth))
    results = {
        change: {
            who: {name: float(np.mean([row[name] for row in each])) for name in ("cover", "bad2")}
            for who, each in of.items()
        }
        for change, of in rows.items()
    }
    table(
        f"Less light in one image, mean of {len(SCENES)} scenes",
        ("light", "cover", "bad2", "bare OpenCV's cover", "its bad2"),
        [
            (change, *(of[who][name] for who in ("default", "bare OpenCV") for name in ("cover", "bad2")))
            for change, of in results.items()
        ],
    )
    return results


def spoilt(data: Path) -> dict[str, Any]:
    """The same pairs noisy and compressed: means over the scenes."""
    ways: dict[str, Matcher | None] = {"bare OpenCV": None, "default": Matcher(), "unrefined": Matcher(refine=False)}
    rows: dict[str, dict[str, list[dict[str, float]]]] = {change: {who: [] for who in ways} for change in SPOILT}
    for _, left, right, truth, rig, count in pairs(data):
        for change, spoil in SPOILT.items():
            images = spoil(left, right)
            for who, matcher in ways.items():
                found = bare(*images, count) if matcher is None else disparity(*images, rig, matcher=matcher)
                rows[change][who].append(judged(*found, truth))
    results = {
        change: {
            who: {name: float(np.mean([row[name] for row in each])) for name in FIGURES[:-1]}
            for who, each in of.items()
        }
        for change, of in rows.items()
    }
    table(
        f"Noisy and compressed pictures, mean of {len(SCENES)} scenes",
        ("pictures", "matched by", *FIGURES[:-1]),
        [(change, who, *figures.values()) for change, of in results.items() for who, figures in of.items()],
    )
    return results


def full_size(data: Path) -> dict[str, Any]:
    """The full-size cones, whose truth is four times that of the quarter-size pair, enlarged."""
    folder = data / "middlebury2003_cones_full"
    rig = load_rig(folder / "calib.txt")
    left, right = read_pair(folder / "im2.png", folder / "im6.png", rig)
    small = read_disparity(data / "middlebury2003_cones" / "disp2.png", scale=4)
    truth = 4 * cv2.resize(small, (left.shape[1], left.shape[0]), interpolation=cv2.INTER_NEAREST)
    # Enlarged truth is a staircase: only where its neighbors agree is it known to a pixel.
    known, around = np.nan_to_num(truth), np.ones((9, 9), np.uint8)
    truth = np.where(cv2.dilate(known, around) - cv2.erode(known, around) <= 2, truth, np.float32(np.nan))
    results = {
        setting: judged(*disparity(left, right, rig, matcher=SETTINGS[setting]), truth)
        for setting in ("default", "unrefined")
    }
    table("cones, full size", ("setting", *FIGURES), [(setting, *line(row)) for setting, row in results.items()])
    return results


def rendered(_: Path, seeds: int = 20) -> dict[str, Any]:
    """Random tables, camera tilted by 0 to 35 degrees: exact truth."""
    whole, objects, seconds = [], [], []
    for seed in range(seeds):
        begin = time.perf_counter()
        picture = render_pair(table_scene(seed, tilt=np.deg2rad(35 * seed / (seeds - 1))), seed=seed)
        seconds.append(time.perf_counter() - begin)
        values, valid = map(np.asarray, disparity(picture.left, picture.right, picture.rig))
        truth = np.where(picture.visible, picture.disparity_px, np.nan)
        whole.append(judged(values, valid, truth))
        objects.append(judged(values, valid, np.where(picture.labels >= 0, truth, np.nan)))
    out: dict[str, Any] = {"pairs": seeds, "seconds_to_render_a_pair": round(float(np.median(seconds)), 3)}
    for name, rows in (("everything", whole), ("objects", objects)):
        out[name] = {key: float(np.mean([row[key] for row in rows if key in row])) for key in FIGURES}
    table(
        f"{seeds} rendered pairs, {out['seconds_to_render_a_pair']} s to render one",
        ("pixels", *FIGURES),
        [(name, *line(out[name])) for name in ("everything", "objects")],
    )
    return out


def duration(data: Path) -> dict[str, Any]:
    """Images to points, beside one run of SGBM that is told its disparities (three ways, blocks of 5)."""
    out = {}
    for scene, name, count in (("cones", "middlebury2003_cones", 64), ("cones_full", "middlebury2003_cones_full", 240)):
        rig = load_rig(data / name / "calib.txt")
        left, right = read_pair(data / name / "im2.png", data / name / "im6.png", rig)
        single = cv2.StereoSGBM.create(
            minDisparity=0, numDisparities=count, blockSize=5, P1=600, P2=2400, mode=cv2.StereoSGBM_MODE_SGBM_3WAY
        )
        one = timings(lambda s=single, l=left, r=right: s.compute(l, r), 5)
        whole = timings(lambda l=left, r=right, g=rig: reconstruct(l, r, g), 5)
        out[scene] = {"one_sgbm": one, "images_to_points": whole, "ratio": round(whole["min"] / one["min"], 2)}
    table(
        "Seconds, fastest of five",
        ("scene", "one SGBM", "images to points", "ratio"),
        [(scene, row["one_sgbm"]["min"], row["images_to_points"]["min"], row["ratio"]) for scene, row in out.items()],
    )
    return out


def calibration(data: Path) -> dict[str, Any]:
    folder = data / "opencv_chessboard"
    lefts = sorted(folder.glob("left[0-9]*.jpg"))
    rights = [path.with_name(path.name.replace("left", "right")) for path in lefts]
    found = calibrate(lefts, rights, square_m=1.0).calibration
    assert found is not None
    table(
        "Calibration from OpenCV's own photographs (its sample settings give 13 pairs, 0.447 px)",
        ("pairs", "of", "stereo rms px", "left rms px", "right rms px"),
        [(len(found.pairs), len(lefts), found.rms_px, *found.mono_rms_px)],
    )
    return {"pairs": len(found.pairs), "of": len(lefts), "rms_px": found.rms_px, "pair_rms_px": found.pair_rms_px}


PARTS = {
    "matching": matching, "brightness": brightness, "spoilt": spoilt, "full_size": full_size, "rendered": rendered,
    "duration": duration, "calibration": calibration,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=default, help="folder of the stereo pairs")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    args = parser.parse_args()
    print(provenance())
    results = {name: PARTS[name](args.data) for name in args.only}
    if set(args.only) == set(PARTS):
        write("stereo", results)


if __name__ == "__main__":
    main()
