"""How well the stereo stage matches: real pairs with ground truth beside bare OpenCV, rendered pairs, a calibration.

    python benchmarks/stereo.py [--data FOLDER] [--out FILE]

Prints a table a question and writes every figure as JSON. A pixel is answered where a disparity is given; cover is the
share of pixels with known truth that are answered, bad-2 the share of those that are wrong by more than 2 px, deviation
the robust standard deviation of the error. Times are of this run on this machine; only their ratios mean something.
"""

import argparse
import contextlib
import json
import platform
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jaxfuzzy.calibrate import calibrate
from jaxfuzzy.checks import DataError
from jaxfuzzy.matcher import Matcher
from jaxfuzzy.photos import read_disparity, read_pair
from jaxfuzzy.render import render_pair, table_scene
from jaxfuzzy.reproject import measure_noise
from jaxfuzzy.rig import Rig, load_rig
from jaxfuzzy.stereo import disparity, reconstruct

ROOT = Path(__file__).parents[1]
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
    "aloe": ("opencv_aloe", "aloeL.jpg", "aloeR.jpg", "aloeGT.png", 1, 224),
}
SETTINGS: dict[str, Matcher | None] = {
    "bare OpenCV": None,
    "unchecked": Matcher(left_right_px=None, edge_px=0),
    "default": Matcher(),
    "unrefined": Matcher(refine=False),
    "hh": Matcher(method="hh"),
    "bm": Matcher(method="bm"),
}


def best_of(call: Callable[[], Any], repeats: int = 3) -> tuple[Any, float]:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - start)
    return result, min(times)


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
        figures["pixels_per_point"] = measure_noise(values, answered, truth_px=truth).pixels_per_point
    return {name: round(float(value), 4) for name, value in figures.items()}


def rig_of(folder: Path, left: np.ndarray) -> Rig:
    size = (left.shape[1], left.shape[0])
    # Three sets have no calibration; matching needs none beyond the size.
    return load_rig(folder / "calib.txt") if (folder / "calib.txt").exists() else Rig((1000, 1000), (0, 0), 0.1, size)


def real_pairs(data: Path) -> dict[str, Any]:
    print(f"{'scene':12}{'setting':14}{'cover':>7}{'bad-2':>8}{'bad-1':>8}{'median':>8}{'dev.':>7}{'px/pt':>7}{'s':>7}")
    results: dict[str, Any] = {}
    for scene, (name, left_name, right_name, truth_name, scale, count) in SCENES.items():
        folder = data / name
        truth = read_disparity(folder / truth_name, scale=scale)
        left, right = (cv2.imread(str(folder / image)) for image in (left_name, right_name))
        rig = rig_of(folder, left)
        results[scene] = {}
        for setting, matcher in SETTINGS.items():
            if matcher is None:
                (values, valid), seconds = best_of(lambda l=left, r=right, n=count: bare(l, r, n))
            else:
                (values, valid), seconds = best_of(
                    lambda l=left, r=right, g=rig, m=matcher: disparity(l, r, g, matcher=m)
                )
            row = judged(values, valid, truth) | {"seconds": round(seconds, 3)}
            results[scene][setting] = row
            print(
                f"{scene:12}{setting:14}{row['cover']:7.3f}{row['bad2']:8.4f}{row['bad1']:8.4f}{row['median_px']:8.3f}"
                f"{row['deviation_px']:7.3f}{row.get('pixels_per_point', np.nan):7.1f}{row['seconds']:7.3f}"
            )
    print(f"\n{'mean of all':12}")
    for setting in SETTINGS:
        means = {
            name: float(np.mean([results[scene][setting][name] for scene in results]))
            for name in ("cover", "bad2", "bad1", "median_px", "deviation_px")
        }
        print(f"{'':12}{setting:14}" + "  ".join(f"{name} {value:.4f}" for name, value in means.items()))
    return results


def full_size(data: Path) -> dict[str, Any]:
    """The full-size cones, whose truth is four times that of the quarter-size pair, enlarged."""
    folder = data / "middlebury2003_cones_full"
    rig = load_rig(folder / "calib.txt")
    left, right = read_pair(folder / "im2.png", folder / "im6.png", rig)
    small = read_disparity(data / "middlebury2003_cones" / "disp2.png", scale=4)
    truth = 4 * cv2.resize(small, (1800, 1500), interpolation=cv2.INTER_NEAREST)
    # Enlarged truth is a staircase: only where its neighbors agree is it known to a pixel.
    flat = cv2.dilate(np.nan_to_num(truth), np.ones((9, 9))) - cv2.erode(np.nan_to_num(truth), np.ones((9, 9))) <= 2
    truth = np.where(flat, truth, np.float32(np.nan))
    results = {}
    for setting in ("default", "unrefined"):
        values, valid = disparity(left, right, rig, matcher=SETTINGS[setting])
        results[setting] = judged(values, valid, truth)
        print(f"cones_full  {setting:14}" + "  ".join(f"{name} {value}" for name, value in results[setting].items()))
    return results


def rendered(seeds: int = 20) -> dict[str, Any]:
    """Random tables, camera tilted by 0 to 35 degrees: exact truth."""
    rows, objects, started, rendering = [], [], time.perf_counter(), 0.0
    for seed in range(seeds):
        start = time.perf_counter()
        picture = render_pair(table_scene(seed, tilt=np.deg2rad(35 * seed / max(seeds - 1, 1))), seed=seed)
        rendering += time.perf_counter() - start
        values, valid = map(np.asarray, disparity(picture.left, picture.right, picture.rig))
        truth = np.where(picture.visible, picture.disparity_px, np.nan)
        rows.append(judged(values, valid, truth))
        objects.append(judged(values, valid, np.where(picture.labels >= 0, truth, np.nan)))
    out: dict[str, Any] = {
        "pairs": seeds,
        "seconds_rendering_a_pair": round(rendering / seeds, 3),
        "seconds": round(time.perf_counter() - started, 1),
    }
    for name, table in (("everything", rows), ("objects", objects)):
        out[name] = {key: round(float(np.mean([row[key] for row in table])), 4) for key in rows[0] if key in table[0]}
        print(f"rendered    {name:14}" + "  ".join(f"{key} {value}" for key, value in out[name].items()))
    print(f"rendered    {seeds} pairs, {out['seconds_rendering_a_pair']} s to render one")
    return out


def timing(data: Path) -> dict[str, Any]:
    """Images to points, in units of one run of bare SGBM with its disparities given (3 ways, blocks of 5)."""
    out = {}
    for scene, name, count in (("cones", "middlebury2003_cones", 64), ("cones_full", "middlebury2003_cones_full", 240)):
        rig = load_rig(data / name / "calib.txt")
        left, right = read_pair(data / name / "im2.png", data / name / "im6.png", rig)
        single = cv2.StereoSGBM.create(
            minDisparity=0, numDisparities=count, blockSize=5, P1=600, P2=2400, mode=cv2.StereoSGBM_MODE_SGBM_3WAY
        )
        _, one = best_of(lambda s=single, l=left, r=right: s.compute(l, r), 5)
        _, whole = best_of(lambda l=left, r=right, g=rig: reconstruct(l, r, g), 5)
        out[scene] = {"sgbm_s": round(one, 3), "reconstruct_s": round(whole, 3), "ratio": round(whole / one, 2)}
        print(f"time        {scene:12} one SGBM {one:.3f} s, images to points {whole:.3f} s: {whole / one:.1f} times")
    return out


def calibration(data: Path) -> dict[str, Any]:
    folder = data / "opencv_chessboard"
    lefts = sorted(folder.glob("left[0-9]*.jpg"))
    rights = [path.with_name(path.name.replace("left", "right")) for path in lefts]
    found = calibrate(lefts, rights, square_m=1.0).calibration
    assert found is not None
    print(
        f"calibration {len(found.pairs)} of {len(lefts)} pairs, stereo rms {found.rms_px:.3f} px (OpenCV's sample 0.447)"
    )
    return {"pairs": len(found.pairs), "of": len(lefts), "rms_px": found.rms_px, "pair_rms_px": found.pair_rms_px}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of the stereo pairs")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "stereo.json")
    options = parser.parse_args()
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    results = {
        "machine": f"{platform.machine()}, {platform.processor() or platform.system()}, {cv2.getNumThreads()} threads",
        "opencv": cv2.__version__,
        "commit": commit.stdout.strip(),
        "real": real_pairs(options.data),
        "full_size": full_size(options.data),
        "rendered": rendered(),
        "time": timing(options.data),
        "calibration": calibration(options.data),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(results, indent=1) + "\n")
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
