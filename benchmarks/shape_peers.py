"""What another library makes of clouds; run by shapes.py in a process of its own, since CGAL lives in an environment of its own.

    python shape_peers.py cgal|pyransac3d|scikit-spatial CLOUDS.npz

Prints one line of JSON: for every cloud the kind found (null where the library must be told the kind), a radius, milliseconds.
"""

import json
import random
import re
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

SIGMAS = 2.5


def cgal(points: np.ndarray, deviation: float) -> dict[str, Any]:
    """Efficient RANSAC; the kind is that of the shape with most points, two or more planes at right angles make a box."""
    from CGAL.CGAL_Kernel import Point_3
    from CGAL.CGAL_Point_set_3 import Point_set_3
    from CGAL.CGAL_Point_set_processing_3 import jet_estimate_normals
    from CGAL.CGAL_Shape_detection import efficient_RANSAC

    points_set = Point_set_3()
    points_set.add_normal_map()
    for p in points:
        points_set.insert(Point_3(*map(float, p)))
    begin = time.perf_counter()
    jet_estimate_normals(points_set, 24)
    shape_map = points_set.add_int_map("shape")
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    found = efficient_RANSAC(
        points_set,
        shape_map,
        min_points=max(20, len(points) // 20),
        epsilon=SIGMAS * deviation,
        cluster_epsilon=0.1 * extent,
        normal_threshold=0.8,
        probability=0.01,
        planes=True,
        cones=True,
        cylinders=True,
        spheres=True,
    )
    took = 1e3 * (time.perf_counter() - begin)
    shapes = []
    for text in found:
        kind = re.search(r"Type:\s*(\w+)", text)
        size = re.search(r"#Pts:\s*(\d+)", text)
        radius = re.search(r"radius:\s*([-\d.e]+)", text)
        normal = re.search(r"\(([-\d.e]+),?\s+([-\d.e]+),?\s+([-\d.e]+)\)", text)
        shapes.append(
            (
                int(size.group(1)) if size else 0,
                kind.group(1) if kind else "unknown",
                float(radius.group(1)) if radius else None,
                np.array([float(v) for v in normal.groups()]) if normal else None,
            )
        )
    if not shapes:
        return {"kind": "unknown", "radius": None, "ms": took}
    shapes.sort(key=lambda s: -s[0])
    count, kind, radius, first = shapes[0]
    if kind == "plane" and first is not None:
        square = [s for s in shapes[1:] if s[1] == "plane" and s[3] is not None and abs(s[3] @ first) < 0.2]
        kind = "box" if square and square[0][0] > 0.08 * (count + square[0][0]) else "plane"
    return {"kind": kind, "radius": radius, "ms": took}


def pyransac3d(points: np.ndarray, deviation: float) -> dict[str, Any]:
    """Plain RANSAC; the kind is the one with most inliers. Its cuboid is any three planes: boxes are not named, nor are cones."""
    import pyransac3d as p3

    random.seed(0)
    begin = time.perf_counter()
    threshold = SIGMAS * deviation
    _, plane = p3.Plane().fit(points, thresh=threshold, maxIteration=500)
    _, sphere_radius, sphere = p3.Sphere().fit(points, thresh=threshold, maxIteration=500)
    _, _, cylinder_radius, cylinder = p3.Cylinder().fit(points, thresh=threshold, maxIteration=500)
    took = 1e3 * (time.perf_counter() - begin)
    found = {
        "plane": (len(plane), None),
        "sphere": (len(sphere), sphere_radius),
        "cylinder": (len(cylinder), cylinder_radius),
    }
    kind = max(found, key=lambda k: found[k][0])
    radius = found[kind][1]
    return {"kind": kind, "radius": None if radius is None else float(radius), "ms": took}


def scikit_spatial(points: np.ndarray, deviation: float) -> dict[str, Any]:
    """Least squares without any robustness, of a sphere and a cylinder: whichever leaves less."""
    from skspatial.objects import Cylinder, Sphere

    # Its cylinder takes a grid search over all points; a tenth of them is what it manages in a second.
    some = points[:: max(len(points) // 150, 1)]
    begin = time.perf_counter()
    sphere = Sphere.best_fit(points)
    try:
        cylinder = Cylinder.best_fit(some)
    except Exception:  # it gives up on clouds whose normal matrix is singular
        cylinder = None
    took = 1e3 * (time.perf_counter() - begin)
    off = np.abs(np.linalg.norm(points - np.asarray(sphere.point), axis=1) - sphere.radius)
    best = {"kind": "sphere", "radius": float(sphere.radius), "ms": took}
    if cylinder is None:
        return best
    axis = np.asarray(cylinder.vector) / np.linalg.norm(cylinder.vector)
    across = points - np.asarray(cylinder.point)
    across = across - np.outer(across @ axis, axis)
    beside = np.abs(np.linalg.norm(across, axis=1) - cylinder.radius)
    return (
        best
        if np.median(off) < np.median(beside)
        else {"kind": "cylinder", "radius": float(cylinder.radius), "ms": took}
    )


LIBRARIES: dict[str, Callable[[np.ndarray, float], dict[str, Any]]] = {
    "cgal": cgal,
    "pyransac3d": pyransac3d,
    "scikit-spatial": scikit_spatial,
}


def main() -> None:
    fit, data = LIBRARIES[sys.argv[1]], np.load(sys.argv[2])
    deviations = data["deviation"]
    answers = [fit(data[f"p{i}"], float(deviations[i])) for i in range(len(deviations))]
    print(json.dumps(answers))


if __name__ == "__main__":
    main()
