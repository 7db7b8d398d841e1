"""Rigs written as others read them: this library's own JSON, OpenCV FileStorage, Middlebury's `calib.txt`."""

import json
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from jaxfuzzy.rigfiles import Fields

SCHEMA, VERSION = "jaxfuzzy/rig", 1


def written(fields: Fields, suffix: str) -> str:
    """The text of a rig's file.

    Args:
        fields: The fields of the rig, those that are None left out.
        suffix: How the name of the file ends, in small letters.

    Raises:
        ValueError: No format that is known here has this suffix, or it cannot hold this rig.
    """
    check_suffix(suffix, rectified="rotation" not in fields)
    if WRITERS[suffix] is not _own and not fields["metric"]:
        raise ValueError(f"path must end in .json for a rig in arbitrary units, which {suffix} files cannot tell")
    return WRITERS[suffix](fields)


def check_suffix(suffix: str, name: str = "path", *, rectified: bool) -> None:
    """Whether some format has it that can hold a rig which is rectified, or is not."""
    able = [known for known in WRITERS if rectified or known not in RECTIFIED_ALONE]
    if suffix not in able:
        whose = "" if rectified else " for cameras that are not rectified"
        raise ValueError(f"{name} must end in one of {', '.join(filter(None, able))}{whose}, got {suffix}")


def own_tree(fields: Fields) -> dict[str, Any]:
    """What the own JSON holds."""
    return {"schema": SCHEMA, "version": VERSION} | fields


def _own(fields: Fields) -> str:
    return json.dumps(own_tree(fields), indent=2) + "\n"


def _storage(kind: str) -> Callable[[Fields], str]:
    """OpenCV's FileStorage as its stereo sample writes it: M1, D1, M2, D2, R, T of raw cameras, P1, P2, Q of rectified ones."""

    def text(fields: Fields) -> str:
        focal, center, baseline = fields["focal_px"], fields["center_px"], fields["baseline_m"]
        matrices: dict[str, np.ndarray] = {}
        if "rotation" in fields:
            lenses = fields.get("distortion", ((), ()))
            matrices["M1"] = _camera(focal, center)
            matrices["M2"] = _camera(fields.get("right_focal_px", focal), fields.get("right_center_px", center))
            matrices |= {f"D{i}": np.array([lens or np.zeros(5)]) for i, lens in enumerate(lenses, 1)}
            matrices |= {"R": np.array(fields["rotation"]), "T": np.array(fields["translation"])[:, None]}
        else:
            right = center[0] + fields["doffs_px"]
            matrices["P1"] = np.pad(_camera(focal, center), ((0, 0), (0, 1)))
            matrices["P2"] = np.pad(_camera(focal, (right, center[1])), ((0, 0), (0, 1)))
            matrices["P2"][0, 3] = -focal[0] * baseline
            matrices["Q"] = np.array(
                [
                    [1, 0, 0, -center[0]],
                    [0, 1, 0, -center[1]],
                    [0, 0, 0, focal[0]],
                    [0, 0, 1 / baseline, fields["doffs_px"] / baseline],
                ]
            )
        file = cv2.FileStorage(f"rig{kind}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        if "image_size" in fields:
            for name, value in zip(("image_width", "image_height"), fields["image_size"], strict=True):
                file.write(name, value)
        for name, matrix in matrices.items():
            file.write(name, np.asarray(matrix, float))
        return str(file.releaseAndGetString())

    return text


def _middlebury(fields: Fields) -> str:
    (fx, fy), (x, y), doffs = fields["focal_px"], fields["center_px"], fields["doffs_px"]
    lines = [f"cam{i}=[{fx!r} 0 {column!r}; 0 {fy!r} {y!r}; 0 0 1]" for i, column in enumerate((x, x + doffs))]
    lines += [f"doffs={doffs!r}", f"baseline={1e3 * fields['baseline_m']!r}"]
    if "image_size" in fields:
        lines += [f"width={fields['image_size'][0]}", f"height={fields['image_size'][1]}"]
    if "max_disparity_px" in fields:
        lines.append(f"ndisp={int(np.ceil(fields['max_disparity_px']))}")
    return "\n".join(lines) + "\n"


def _camera(focal: Any, center: Any) -> np.ndarray:
    return np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])


WRITERS: dict[str, Callable[[Fields], str]] = {
    ".json": _own,
    "": _own,
    ".yml": _storage(".yml"),
    ".yaml": _storage(".yaml"),
    ".xml": _storage(".xml"),
    ".txt": _middlebury,
}
RECTIFIED_ALONE = (".txt",)
