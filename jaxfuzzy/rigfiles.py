"""Calibration files of others, read into the fields of a `Rig`: Middlebury, KITTI, OpenCV FileStorage, ROS camera_info.

Every reader takes text and returns the keyword arguments of `Rig`, with lengths in the file's own unit; what the file
does not hold is None or absent, and `rig.load_rig` decides whether that is an error.
"""

import json
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from typing import Any

import numpy as np

Fields = dict[str, Any]

# Names that people give to the same matrix in OpenCV files, lower case without underscores.
ALIASES = {
    "m1": "m1 k1 cameramatrix cameramatrix1 cameramatrixleft leftcameramatrix mtx1 mtxl kl kleft leftk intrinsicsleft",
    "m2": "m2 k2 cameramatrix2 cameramatrixright rightcameramatrix mtx2 mtxr kr kright rightk intrinsicsright",
    "d1": "d1 distcoeffs1 distortioncoefficients1 distcoeffsleft leftdistcoeffs dist1 distl dleft distortionleft",
    "d2": "d2 distcoeffs2 distortioncoefficients2 distcoeffsright rightdistcoeffs dist2 distr dright distortionright",
    "r": "r rotation rot rotationmatrix",
    "t": "t translation trans tvec translationvector",
    "p1": "p1 projectionmatrix1 pl projectionleft",
    "p2": "p2 projectionmatrix2 pr projectionright",
    "q": "q disptodepthmatrix disparitytodepth reprojection",
}
# Numbers of one rig that should be the same differ by rounding at most.
ALIKE_PX = 0.5
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def parse(
    text: str, other: str | None, *, cameras: tuple[int, int] | None, rectified: bool, alone: bool = False
) -> Fields:
    """The fields of a rig in one of the known formats.

    Args:
        text: The text of the file.
        other: That of a second file of the same rig.
        cameras: Which two of KITTI's.
        rectified: Whether the images are rectified though the file describes the raw cameras too.
        alone: Whether one camera will do, without a baseline.

    Raises:
        ValueError: The text is in no known format, or what is there contradicts itself.
    """
    of_kitti = re.search(r"^P(0|2|_rect_00|_rect_02):\s+[-+.\d]", text, re.MULTILINE) is not None
    of_middlebury = re.search(r"^[ \t]*cam0[ \t]*=", text, re.MULTILINE) is not None
    if other is not None and (of_middlebury or of_kitti):
        raise ValueError(f"is a calib.txt of {'Middlebury' if of_middlebury else 'KITTI'}, which needs no second file")
    if cameras is not None and (of_middlebury or not of_kitti):
        raise ValueError("is no calib.txt of KITTI, and cameras are a choice among its four")
    if of_middlebury:
        return middlebury(text)
    if of_kitti:
        return kitti(text, cameras)
    if other is None and len(cameras_of := _documents(text)) == 2:
        text, other = cameras_of
    tree = storage(text)
    other_tree = None if other is None else storage(other)
    if other is None and isinstance(tree.get("left"), dict) and isinstance(tree.get("right"), dict):
        tree, other_tree = tree["left"], tree["right"]
    if _is_camera_info(tree):
        return ros(tree, other_tree, rectified=rectified, alone=alone)
    return opencv(tree | (other_tree or {}), rectified=rectified, alone=alone)


def middlebury(text: str) -> Fields:
    """Middlebury 2014 `calib.txt`: cam0, cam1, doffs, baseline in millimetres, width, height, ndisp."""
    entries = dict(re.findall(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*\S)", text, re.MULTILINE))
    left = _numbers(entries["cam0"])
    right = _numbers(entries["cam1"]) if "cam1" in entries else None
    if len(left) != 9 or (right is not None and len(right) != 9):
        raise ValueError("cam0 and cam1 must be 3 x 3 matrices")
    doffs = _entry(entries, "doffs")
    if right is not None:
        apart = right[2] - left[2]
        doffs = apart if doffs is None else doffs
        said = {"doffs": (doffs, apart), "focal length": (left[0], right[0]), "row of the center": (left[5], right[5])}
        for what, (one, other) in said.items():
            if abs(one - other) > ALIKE_PX:
                warnings.warn(
                    f"calib.txt contradicts itself: the {what} is {one:g} px by one entry and {other:g} by another, of a pair"
                    " that should be rectified; the first is used",
                    stacklevel=5,
                )
    width, height = _entry(entries, "width"), _entry(entries, "height")
    return {
        "focal_px": (left[0], left[4]),
        "center_px": (left[2], left[5]),
        "baseline_m": _entry(entries, "baseline"),
        "image_size": None if width is None or height is None else (int(width), int(height)),
        "doffs_px": doffs,
        "max_disparity_px": _entry(entries, "ndisp"),
        "unit_m": 1e-3,
    }


def kitti(text: str, cameras: tuple[int, int] | None) -> Fields:
    """KITTI `calib.txt` (P0 ... P3) or `calib_cam_to_cam.txt` (P_rect_00 ...): rectified pairs, metres."""
    entries = dict(re.findall(r"^[ \t]*(\w+):[ \t]*(.*\S)", text, re.MULTILINE))
    projections = {
        int(number): name
        for name in entries
        if (number := name.removeprefix("P_rect_0").removeprefix("P")) in {"0", "1", "2", "3"}
    }
    if cameras is None:
        cameras = (2, 3) if {2, 3} <= projections.keys() else (0, 1)
    if len(cameras) != 2 or not set(cameras) <= projections.keys():
        raise ValueError(f"holds the projection matrices of cameras {sorted(projections)}, not of {cameras}")
    left, right = (_projection(entries[projections[camera]], projections[camera]) for camera in cameras)
    size = entries.get(f"S_rect_0{cameras[0]}")
    fields = _projections(left, right)
    fields["image_size"] = None if size is None else tuple(int(value) for value in _numbers(size))
    return fields


def _projection(text: str, name: str) -> np.ndarray:
    words = text.split()
    if len(words) != 12 or not all(NUMBER.fullmatch(word) for word in words):
        raise ValueError(f"{name} must be 12 numbers, got {text!r}")
    return np.reshape([float(word) for word in words], (3, 4))


def opencv(tree: Fields, *, rectified: bool, alone: bool = False) -> Fields:
    """What OpenCV's stereo calibration sample and its many descendants write: M1 D1 M2 D2 R T and P1 P2 Q."""
    plain = {re.sub(r"[_\-\s]", "", name).lower(): value for name, value in tree.items()}
    found = {key: plain[name] for key, names in ALIASES.items() for name in names.split() if name in plain}
    size = _storage_size(plain)
    raw = {"m1", "m2", "r", "t"} <= found.keys()
    if not raw or rectified:
        if {"p1", "p2"} <= found.keys():
            fields = _projections(_shaped(found, "p1", 3, 4), _shaped(found, "p2", 3, 4))
        elif "q" in found:
            fields = _reprojection(_shaped(found, "q", 4, 4))
        elif alone and "m1" in found and "m2" not in found:
            fields = _alone(_shaped(found, "m1", 3, 3))
        elif {"m1", "m2"} <= found.keys():
            raise ValueError(
                "holds the two cameras but not how they stand to each other (R and T, or P1 and P2):"
                " give the extrinsics file as well, load_rig(intrinsics, extrinsics)"
            )
        else:
            raise ValueError("holds neither M1, M2, R, T nor P1, P2 nor Q, so it is no stereo calibration")
        return fields | {"image_size": size}
    left, right = _shaped(found, "m1", 3, 3), _shaped(found, "m2", 3, 3)
    for name, camera in (("M1", left), ("M2", right)):
        if not np.allclose(camera[2], [0, 0, 1]):
            raise ValueError(
                f"{name} must end in the row 0, 0, 1, got {camera[2].tolist()}: some programs write it transposed"
            )
    translation = np.ravel(found["t"])
    rotation = _rotation(np.asarray(found["r"], float))
    if translation.shape != (3,):
        raise ValueError(f"T must be 3 numbers, got {translation.size}")
    return _raw(left, found.get("d1", ()), right, found.get("d2", ()), rotation, translation) | {"image_size": size}


def ros(left: Fields, right: Fields | None, *, rectified: bool, alone: bool = False) -> Fields:
    """ROS camera_info: one file a camera; the right one's projection holds minus focal length times baseline."""
    first, second = _camera_info(left), None if right is None else _camera_info(right)
    if second is None:
        if first["p"][0, 3] == 0 and alone:
            return _alone(first["p"]) | {"image_size": first["size"]}
        if first["p"][0, 3] == 0:
            raise ValueError("is the left camera's camera_info and holds no baseline: give both, load_rig(left, right)")
        if not rectified and (np.any(first["d"]) or not np.allclose(first["r"], np.eye(3), atol=1e-9)):
            raise ValueError(
                "is one camera's camera_info with distortion: give both files, load_rig(left, right),"
                " or rectified=True where the images are rectified already"
            )
        left_projection = first["p"].copy()
        left_projection[0, 3] = 0
        return _projections(left_projection, first["p"]) | {"image_size": first["size"]}
    if rectified:
        return _projections(first["p"], second["p"]) | {"image_size": first["size"]}
    for camera in (first, second):
        if camera["model"] not in ("plumb_bob", "rational_polynomial", ""):
            raise ValueError(
                f"has the distortion model {camera['model']!r}; only 'plumb_bob' and 'rational_polynomial' are known:"
                " rectify first and give rectified=True"
            )
    baseline = _projections(first["p"], second["p"])["baseline_m"]
    rotation = second["r"].T @ first["r"]
    translation = -second["r"].T @ np.array([baseline, 0.0, 0.0])
    return _raw(first["k"], first["d"], second["k"], second["d"], rotation, translation) | {"image_size": first["size"]}


def storage(text: str) -> Fields:
    """An OpenCV FileStorage (XML, YAML or JSON) or a ROS yaml file as nested dicts, matrices as arrays."""
    head = text.lstrip()[:200]
    if head.startswith("<"):
        if "<!DOCTYPE" in text:
            raise ValueError("is XML with a DOCTYPE, which no calibration needs")
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            raise ValueError(f"is not valid XML ({error})") from None
        return _matrices({child.tag: _xml_value(child) for child in root})
    if head.startswith("{"):
        try:
            return _matrices(json.loads(text))
        except json.JSONDecodeError as error:
            raise ValueError(f"is not valid JSON ({error})") from None
    return _matrices(_yaml(text))


def _documents(text: str) -> list[str]:
    """The documents of a YAML file, each a mapping of its own; more than two are none of a pair of cameras."""
    if text.lstrip().startswith(("<", "{")):
        return [text]
    documents = [
        part
        for part in re.split(r"^(?:---|\.\.\.).*$", text, flags=re.MULTILINE)
        if re.search(r"^\s*\w+\s*:", part, re.MULTILINE)
    ]
    if len(documents) > 2:
        raise ValueError(f"holds {len(documents)} documents; one or two are read, of one or two cameras")
    return documents


def _is_camera_info(tree: Fields) -> bool:
    return "projection_matrix" in tree or {"P", "K"} <= tree.keys() or {"p", "k"} <= tree.keys()


def _yaml(text: str) -> Fields:
    """The part of YAML that calibration files use: nested mappings, numbers, and lists in brackets or by dashes."""
    text = re.sub(r"^%.*$|^---.*$|(?:^|\s)#.*$|^\.\.\.$", "", text, flags=re.MULTILINE)
    text = re.sub(r"\[[^\[\]]*\]", lambda match: re.sub(r"\s+", " ", match.group()), text)
    root: Fields = {}
    stack: list[tuple[int, Fields]] = [(-1, root)]
    last: tuple[Fields, str] | None = None
    for line in text.splitlines():
        if not line.strip():
            continue
        indent = len(line) - len(line.lstrip())
        if (dash := re.match(r"\s*(?:-\s+)+(.*)", line)) and last:
            parent, name = last
            if not isinstance(parent[name], list):
                parent[name] = []
            parent[name].append(_scalar(dash.group(1)))
            continue
        match = re.match(r"\s*\"?([\w./-]+)\"?\s*:\s*(.*)$", line)
        if not match:
            raise ValueError("is in no known format (Middlebury, KITTI, OpenCV FileStorage, ROS camera_info, own JSON)")
        while stack[-1][0] >= indent:
            stack.pop()
        name, value = match.group(1), re.sub(r"^!!\S+\s*", "", match.group(2)).strip()
        parent = stack[-1][1]
        parent[name] = _scalar(value) if value else {}
        last = (parent, name)
        if not value:
            stack.append((indent, parent[name]))
    return root


def _scalar(value: str) -> Any:
    value = value.strip()
    if value.startswith("["):
        return _numbers(value)
    return float(value) if NUMBER.fullmatch(value) else value.strip("'\"")


def _xml_value(node: ElementTree.Element) -> Any:
    if len(node):
        return {child.tag: _xml_value(child) for child in node}
    values = (node.text or "").split()
    if values and all(NUMBER.fullmatch(value) for value in values):
        return float(values[0]) if len(values) == 1 else [float(value) for value in values]
    return (node.text or "").strip()


def _matrices(tree: Fields) -> Fields:
    out: Fields = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            # OpenCV 5 writes what has not two axes with "sizes" in place of rows and columns.
            if "data" in value and ("sizes" in value or {"rows", "cols"} <= value.keys()):
                data = np.ravel(np.asarray(value["data"], float))
                sizes = value["sizes"] if "sizes" in value else (value["rows"], value["cols"])
                shape = tuple(int(size) for size in np.ravel(sizes))
                if data.size != int(np.prod(shape)):
                    raise ValueError(f"{name} says {' x '.join(map(str, shape))} but holds {data.size} numbers")
                out[name] = data.reshape(shape)
            else:
                out[name] = _matrices(value)
        else:
            out[name] = value
    return out


def _camera_info(tree: Fields) -> Fields:
    def matrix(names: tuple[str, ...], rows: int, cols: int) -> np.ndarray:
        value = next((tree[name] for name in names if name in tree), None)
        if value is None or np.size(value) != rows * cols:
            raise ValueError(f"is a camera_info without a {rows} x {cols} {names[0]}")
        return np.reshape(np.asarray(value, float), (rows, cols))

    width, height = (tree.get(f"image_{side}", tree.get(side)) for side in ("width", "height"))
    return {
        "k": matrix(("camera_matrix", "K", "k"), 3, 3),
        "r": matrix(("rectification_matrix", "R", "r"), 3, 3),
        "p": matrix(("projection_matrix", "P", "p"), 3, 4),
        "d": np.ravel(np.asarray(tree.get("distortion_coefficients", tree.get("D", tree.get("d", ()))), float)),
        "model": tree.get("distortion_model", ""),
        "size": None if width is None or height is None else (int(width), int(height)),
    }


def _projections(left: np.ndarray, right: np.ndarray) -> Fields:
    """A rectified pair from its projection matrices: the right one ends in minus focal length times baseline."""
    if not (left[0, 0] > 0 and right[0, 0] > 0):
        raise ValueError(f"has the focal lengths {left[0, 0]:g} and {right[0, 0]:g} px: it was never calibrated")
    if abs(left[1, 3] - right[1, 3]) > abs(left[0, 3] - right[0, 3]):
        raise ValueError("has one camera above the other; only side by side is supported: turn the images by 90°")
    for what, place in (("focal length", (0, 0)), ("row of the center", (1, 2))):
        if abs(left[place] - right[place]) > ALIKE_PX:
            raise ValueError(
                f"contradicts itself: the {what} is {left[place]:g} px on the left and {right[place]:g} on the right, though"
                " projections are those of rectified cameras"
            )
    return {
        "focal_px": (float(left[0, 0]), float(left[1, 1])),
        "center_px": (float(left[0, 2]), float(left[1, 2])),
        "baseline_m": float(left[0, 3] / left[0, 0] - right[0, 3] / right[0, 0]),
        "doffs_px": float(right[0, 2] - left[0, 2]),
    }


def _alone(camera: np.ndarray) -> Fields:
    """A single camera from its matrix: it has no baseline, and no other center to be offset from."""
    if not camera[0, 0] > 0:
        raise ValueError(f"has the focal length {camera[0, 0]:g} px: it was never calibrated")
    return {
        "focal_px": (float(camera[0, 0]), float(camera[1, 1])),
        "center_px": (float(camera[0, 2]), float(camera[1, 2])),
        "baseline_m": None,
        "doffs_px": 0.0,
    }


def _reprojection(q: np.ndarray) -> Fields:
    """A rectified pair from OpenCV's Q: Q[3, 2] = 1 / baseline, Q[3, 3] = doffs / baseline."""
    if q[3, 2] == 0:
        raise ValueError("Q[3, 2] is 0, so it holds no baseline")
    return {
        "focal_px": (float(q[2, 3]), float(q[2, 3])),
        "center_px": (float(-q[0, 3]), float(-q[1, 3])),
        "baseline_m": float(1 / q[3, 2]),
        "doffs_px": float(q[3, 3] / q[3, 2]),
    }


def side_by_side(translation: Sequence[float] | np.ndarray) -> bool:
    """Whether the right camera stands beside the left one rather than above or before it."""
    return abs(translation[0]) >= max(abs(translation[1]), abs(translation[2]))


def _raw(left: Any, left_lens: Any, right: Any, right_lens: Any, rotation: Any, translation: Any) -> Fields:
    if not side_by_side(translation):
        raise ValueError(
            "has one camera above or before the other; only side by side is supported: turn the images by 90°"
        )
    return {
        "focal_px": (left[0, 0], left[1, 1]),
        "center_px": (left[0, 2], left[1, 2]),
        "baseline_m": float(np.linalg.norm(translation)) * (1.0 if translation[0] < 0 else -1.0),
        "right_focal_px": (right[0, 0], right[1, 1]),
        "right_center_px": (right[0, 2], right[1, 2]),
        "distortion": tuple(tuple(np.ravel(np.asarray(lens, float)).tolist()) for lens in (left_lens, right_lens)),
        "rotation": rotation,
        "translation": translation,
        "doffs_px": 0.0,
    }


def _rotation(value: np.ndarray) -> np.ndarray:
    """A rotation matrix from itself or from a rotation vector (Rodrigues)."""
    if value.size == 9:
        return value.reshape(3, 3)
    if value.size != 3:
        raise ValueError(f"R must be a 3 x 3 matrix or a vector of 3, got {value.size} numbers")
    angle = float(np.linalg.norm(value))
    if angle == 0:
        return np.eye(3)
    x, y, z = np.ravel(value) / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def _storage_size(plain: Fields) -> tuple[int, int] | None:
    for name in ("imagesize", "size", "resolution"):
        if np.size(plain.get(name, ())) == 2 and not isinstance(plain[name], str):
            width, height = np.ravel(plain[name])
            return int(width), int(height)
    for width, height in (("imagewidth", "imageheight"), ("width", "height")):
        if width in plain and height in plain:
            return int(plain[width]), int(plain[height])
    return None


def _shaped(found: Fields, name: str, rows: int, cols: int) -> np.ndarray:
    if np.size(found[name]) != rows * cols:
        raise ValueError(f"{name.upper()} must be {rows} x {cols}, got {np.size(found[name])} numbers")
    return np.reshape(np.asarray(found[name], float), (rows, cols))


def _numbers(text: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(text)]


def _entry(entries: dict[str, str], name: str) -> float | None:
    if name not in entries:
        return None
    if not NUMBER.fullmatch(entries[name]):
        raise ValueError(f"{name} must be a number, got {entries[name]!r}")
    return float(entries[name])
