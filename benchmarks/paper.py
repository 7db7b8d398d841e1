"""The paper's own scene, rendered: its figures beside ours.

    python benchmarks/paper.py

A cylinder and a small box on a table, photographed without tilt as in the paper's figure 2, matched with the default settings. The
stages are the paper's, in centimetres and the raw camera frame (the paper names no unit): the number of objects by the
variance ratio, fuzzy c-means with sizes, and fuzzy c-varieties with a noise cluster at delta = 0.5 with the algebraic distance.
"""

import jax
import numpy as np
from common import provenance, table, write

import jaxfuzzy as jf
from jaxfuzzy.render import paper_scene, render_pair


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    print(provenance())
    pair = render_pair(paper_scene())
    cloud = jf.reconstruct(pair.left, pair.right, pair.rig)
    columns, rows = np.round(np.asarray(cloud.pixels_px)).astype(int).T
    truth = pair.labels[rows, columns]
    objects = 100 * np.asarray(cloud.points, float)[truth >= 0]
    plane = objects[:, [0, 2]]
    count = jf.choose_k(plane, (2, 3, 4, 5))
    sized = jf.fcm(plane, count.partition.centers, sizes=True)
    sizes = np.sort(np.asarray(sized.sizes))[::-1]
    shares = np.sort(np.bincount(np.asarray(sized.labels)) / len(plane))[::-1]
    inliers, bodies = {}, {}
    for index, name in enumerate(("cylinder", "box")):
        body = objects[truth[truth >= 0] == index]
        bodies[name] = len(body)
        for embedding in ("3d", "4d", "6d"):
            fit = jf.nfcv(body, np.ones((len(body), 1)), embedding=embedding, distance="algebraic", noise_distance=0.5)
            inliers[name, embedding] = int(np.asarray(fit.inliers).sum())
    scene = jf.model_scene(pair.left, pair.right, pair.rig)
    found = [
        (shape.kind, None if shape.primitive is None else shape.primitive.to_dict().get("radius"))
        for shape in scene.shapes
    ]
    table(
        "The paper's figures beside ours on the same kind of scene",
        ("", "paper", "ours"),
        [
            ("objects, by the variance ratio", 2, int(count.k)),
            ("sizes", "0.7501 / 0.2499", " / ".join(f"{s:.4f}" for s in sizes)),
            ("shares of points", "not given", " / ".join(f"{s:.4f}" for s in shares)),
            ("cylinder, points in 4d at 0.5", "1121 of 1141", f"{inliers['cylinder', '4d']} of {bodies['cylinder']}"),
            *((f"{name}, points in {e} at 0.5", "", f"{n} of {bodies[name]}") for (name, e), n in inliers.items()),
            ("kinds, default rules", "cylinder, box", ", ".join(f"{k} {r or ''}".strip() for k, r in found)),
        ],
    )
    write(
        "paper",
        {
            "vrc": dict(zip(map(int, count.ks), map(float, count.scores), strict=True)),
            "k": int(count.k),
            "sizes": sizes.tolist(),
            "shares": shares.tolist(),
            "points": bodies,
            "inliers": {f"{name} {e}": n for (name, e), n in inliers.items()},
            "found": found,
        },
    )


if __name__ == "__main__":
    main()
