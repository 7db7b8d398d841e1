"""How many objects: simulated scenes of known number, beside the paper's rule, HDBSCAN and DBSCAN.

    python benchmarks/groups.py [--each N] [--tuning] [--only ROW ...]

Scenes are what a stereo camera sees (`jaxfuzzy.simulate`) of 1 to 5 primitives standing on a table that is not among the points,
150 to 1,800 points each, with the occlusions between them, depth noise and uniform outliers. Ours is told the vertical, the
camera and the depth noise. The peers cluster the same points in the plane perpendicular to the vertical; their settings are the
best of a grid on the scenes of `--tuning` (see `PEERS`), ours were frozen on those too, and what is reported comes from other
seeds. Touching pairs, which places cannot tell apart, are given to `model_cloud` as well. The adjusted Rand index is over the
points that are an object's, a refusal being a label of its own. Prints a table and writes benchmarks/results/groups.json.
"""

import argparse
import json
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import provenance, table, write
from sklearn.cluster import DBSCAN, HDBSCAN
from sklearn.metrics import adjusted_rand_score

from jaxfuzzy.cloud import Cloud
from jaxfuzzy.objects import DEVIATIONS
from jaxfuzzy.scene import model_cloud
from jaxfuzzy.segment import segment
from jaxfuzzy.simulate import Simulated, simulate_scene

UP = (0.0, 1.0, 0.0)
# Seeds of the scenes that settings were frozen on, and of those that are reported.
TUNING, REPORTED = 0, 100_000
ROWS: dict[str, dict[str, Any]] = {
    "1-5 objects, 0-25 % outliers": {"asked": 99.5, "numbers": (1, 2, 3, 4, 5), "outliers": (0.0, 0.1, 0.25), "share": 2},
    "the same, 40 % outliers": {"asked": 98, "numbers": (1, 2, 3, 4, 5), "outliers": (0.4,)},
    "22 cm apart": {"asked": 95, "numbers": (2, 3, 4, 5), "made": {"spacing": 0.22}},
    "30 % missing in stripes": {"asked": 95, "numbers": (1, 2, 3, 4, 5), "made": {"stripes": 0.3}},
    "touching pairs": {"asked": 80, "numbers": (2,), "made": {"touching": True}},
}  # fmt: skip


def scenes(row: dict[str, Any], each: int, seed: int) -> list[Simulated]:
    """The scenes of a row: numbers of objects, outliers and seeds running on."""
    numbers, outliers = row["numbers"], row.get("outliers", (0.1,))
    return [
        simulate_scene(numbers[i % len(numbers)], seed + i, outliers=outliers[i % len(outliers)], **row.get("made", {}))
        for i in range(each * row.get("share", 1))
    ]


def _ours(scene: Simulated, rule: Any) -> np.ndarray:
    # Padded by points of weight 0, which change nothing: the paper's rule would compile for every number of points anew.
    count = len(scene.points)
    rows = np.minimum(np.arange(1 << (count - 1).bit_length()), count - 1)
    found = segment(
        scene.points[rows],
        up=UP,
        camera=scene.camera,
        noise_distance=DEVIATIONS * scene.depth_std[rows],
        rule=rule,
        weights=(np.arange(len(rows)) < count).astype(scene.points.dtype),
    )
    return np.asarray(found.labels)[:count]


def _by_shapes(scene: Simulated) -> np.ndarray:
    cloud = Cloud(jnp.asarray(scene.points, jnp.float32), depth_std=jnp.asarray(scene.depth_std, jnp.float32))
    return np.asarray(model_cloud(cloud, up=UP, ground=None, camera=scene.camera).segmentation.labels)


def _plan(scene: Simulated) -> np.ndarray:
    return scene.points[:, [0, 2]]


def _hdbscan(scene: Simulated, size: int = 150, samples: int = 40, single: bool = False) -> np.ndarray:
    fit = HDBSCAN(min_cluster_size=size, min_samples=samples, allow_single_cluster=single, copy=True)
    return fit.fit_predict(_plan(scene))


def _dbscan(scene: Simulated, radius: float = 0.03, samples: int = 60) -> np.ndarray:
    return DBSCAN(eps=radius, min_samples=samples).fit_predict(_plan(scene))


METHODS: dict[str, Callable[[Simulated], np.ndarray]] = {
    "segment": lambda scene: _ours(scene, "robust"),
    "paper's rule": lambda scene: _ours(scene, "paper"),
    "HDBSCAN": _hdbscan,
    "HDBSCAN, one allowed": lambda scene: _hdbscan(scene, single=True),
    "DBSCAN": _dbscan,
}


def judged(scene: Simulated, labels: np.ndarray) -> tuple[bool, float]:
    """Whether the number is right, and the adjusted Rand index over the points of objects."""
    own = scene.labels >= 0
    return int(labels.max()) + 1 == len(scene.truths), float(adjusted_rand_score(scene.labels[own], labels[own]))


def counted(given: list[Simulated], method: Callable[[Simulated], np.ndarray]) -> dict[str, Any]:
    """One method on the scenes of a row: share right, mean index, and by the true number what was found instead."""
    found = [method(scene) for scene in given]
    results = [judged(scene, labels) for scene, labels in zip(given, found, strict=True)]
    mistakes: dict[str, int] = {}
    for scene, labels, (good, _) in zip(given, found, results, strict=True):
        if not good:
            told = f"{len(scene.truths)} > {int(labels.max()) + 1}"
            mistakes[told] = mistakes.get(told, 0) + 1
    return {
        "scenes": len(given),
        "right": 100 * float(np.mean([good for good, _ in results])),
        "rand": float(np.mean([index for _, index in results])),
        "mistakes": mistakes,
        "wrong": [i for i, (good, _) in enumerate(results) if not good],
    }


def grid(given: list[Simulated]) -> None:
    """How the settings of the peers were found: the best share right over all rows of the tuning scenes."""
    rows = []
    for size in (60, 100, 150):
        for samples in (10, 20, 40):
            for single in (False, True):
                fit = counted(given, partial(_hdbscan, size=size, samples=samples, single=single))
                rows.append(
                    (f"HDBSCAN, size {size}, samples {samples}, one allowed {single}", fit["right"], fit["rand"])
                )
    for radius in (0.02, 0.03, 0.04, 0.05):
        for samples in (15, 25, 40, 60):
            fit = counted(given, partial(_dbscan, radius=radius, samples=samples))
            rows.append((f"DBSCAN, radius {radius} m, samples {samples}", fit["right"], fit["rand"]))
    table("Settings of the peers, tuning scenes", ("settings", "number right %", "Rand index"), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--each", type=int, default=40, help="scenes a row, twice as many in the first")
    parser.add_argument("--tuning", action="store_true", help="the scenes that settings were frozen on; writes nothing")
    parser.add_argument(
        "--grid", action="store_true", help="settings of the peers on the scenes of --tuning, nothing else"
    )
    parser.add_argument("--only", nargs="*", choices=ROWS, default=list(ROWS))
    args = parser.parse_args()
    print(provenance())
    seed = TUNING if args.tuning or args.grid else REPORTED
    made = {name: scenes(ROWS[name], args.each, seed) for name in args.only}
    if args.grid:
        grid([scene for name, given in made.items() if "touching" not in name for scene in given])
        return
    results: dict[str, Any] = {}
    for name, given in made.items():
        methods = METHODS | ({"model_cloud": _by_shapes} if "touching" in name else {})
        results[name] = {"asked": ROWS[name]["asked"]} | {m: counted(given, of) for m, of in methods.items()}
        print(name, {m: f["right"] for m, f in results[name].items() if m != "asked"}, flush=True)
        # Compiled programs hold memory maps, of which Linux grants a process 65,530; XLA crashes beyond them.
        jax.clear_caches()
    table(
        "Number of objects right, per cent, and adjusted Rand index",
        ("scenes", "number", "asked", "method", "right", "Rand index", "mistakes"),
        [
            (name, fit["scenes"], row["asked"], method, fit["right"], fit["rand"], json.dumps(fit["mistakes"]))
            for name, row in results.items()
            for method, fit in row.items()
            if method != "asked"
        ],
    )
    if set(args.only) == set(ROWS) and not args.tuning:
        write("groups", {"each": args.each} | results)


if __name__ == "__main__":
    main()
