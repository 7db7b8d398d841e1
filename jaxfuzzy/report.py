"""A scene on disk: written all or nothing into one folder, and read back.

| file | for |
|---|---|
| `scene.json` | machines: what was found, with units, settings and timings; its form is `data/scene.schema.json` |
| `arrays.npz` | `load`: everything that is one number or more a point, and the photographs |
| `rig.json` | the cameras, where there were any |
| `cloud.ply` | point-cloud viewers: the points with object, kind, membership, residual |
| `model.glb`, `model.obj` | any 3D program: the models |
| `report.html`, `figures/*.png` | people; need the `view` extra |
"""

import contextlib
import dataclasses
import importlib.metadata
import importlib.util
import json
import math
import os
import platform
import re
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfuzzy import drawing, export
from jaxfuzzy.cloud import Cloud, write_cloud
from jaxfuzzy.files import one_line, read_arrays
from jaxfuzzy.folder import files_in, staged, standing
from jaxfuzzy.primitives import primitive_from_dict
from jaxfuzzy.rig import load_rig, save_rig
from jaxfuzzy.segment import Segmentation
from jaxfuzzy.shapes import Shape
from jaxfuzzy.status import SENTENCES, Status

if TYPE_CHECKING:
    from jaxfuzzy.scene import Scene

SCHEMA = "jaxfuzzy/scene"
VERSION = 1
# The modules that report.html and the figures need.
DRAWING = ("matplotlib", "k3d")
# What `save` may write, next to the pictures in figures/.
FILES = ("scene.json", "arrays.npz", "rig.json", "cloud.ply", "model.glb", "model.obj", "report.html")


def to_dict(scene: "Scene") -> dict[str, Any]:
    """A scene in plain Python, as `scene.json` holds it: everything but what is one number a point.

    Numbers that are not finite become None: a score of None is a kind that could not be fitted.
    """
    labels = np.asarray(scene.segmentation.labels)
    shapes = []
    for index, shape in enumerate(scene.shapes):
        body = shape.primitive
        shapes.append(
            {
                "object": index,
                "kind": shape.kind,
                "parameters": None if body is None else {k: v for k, v in body.to_dict().items() if k != "kind"},
                "sizes": [m._asdict() for m in drawing.measures(shape)],
                "covariance": np.asarray(shape.covariance),
                "covariance_of": body.parameter_names if body is not None and np.size(shape.covariance) else [],
                "points": int((labels == index).sum()),
                "inliers": int(np.asarray(shape.inliers).sum()),
                "noise_distance": float(shape.noise_distance),
                "scores": shape.scores,
                "margin": shape.margin,
                "counts": shape.counts,
                **_reasons(shape.status),
            }
        )
    plain: dict[str, Any] = _plain(
        {
            "schema": SCHEMA,
            "version": VERSION,
            "units": {"length": "arbitrary" if int(scene.status) & Status.ARBITRARY_UNITS else "m", "angle": "rad"},
            "frame": "as in the cloud given" if scene.rig is None else "left camera: x right, y down, z forward",
            "made_with": _versions(),
            "settings": scene.settings,
            "timings": scene.timings,
            "dtype": str(scene.cloud.points.dtype),
            "points": len(labels),
            "kind_numbers": {"none": 0} | export.KIND_NUMBERS,
            "outliers": int((labels < 0).sum()),
            "up": np.asarray(scene.up),
            "ground": None if scene.ground is None else scene.ground.to_dict(),
            **_reasons(scene.status),
            "shapes": shapes,
        }
    )
    return plain


def save(scene: "Scene", folder: str | os.PathLike[str], *, view: bool | None = None) -> tuple[str, ...]:
    """Writes a scene into a folder, all or nothing.

    What an earlier run wrote there is replaced, files of others are left alone. Until everything has been written the
    folder stays as it was; after an error or Ctrl-C too.

    Args:
        scene: The scene.
        folder: Where to; made if it does not exist.
        view: Whether to write report.html and the figures too; by default where the `view` extra is installed.

    Returns:
        The files written, relative to the folder.

    Raises:
        OSError: The folder cannot be written, or holds a file of the same name that no scene wrote.
        ModuleNotFoundError: `view` is True and the extra is not installed.
    """
    if view is None:
        view = can_draw()
    with staged(folder, _earlier, FILES) as stage:
        write_cloud(stage / "cloud.ply", scene.cloud, extra=export.point_columns(scene))
        (stage / "model.glb").write_bytes(export.glb(scene))
        (stage / "model.obj").write_text(export.obj(scene), encoding="utf-8")
        np.savez_compressed(stage / "arrays.npz", allow_pickle=False, **_flat(scene))
        if scene.rig is not None:
            save_rig(stage / "rig.json", scene.rig)
        if view:
            from jaxfuzzy import page, plot

            pictures = {f"figures/{name}.png": plot.png(figure) for name, figure in plot.figures(scene).items()}
            (stage / "figures").mkdir()
            for name, picture in pictures.items():
                (stage / name).write_bytes(picture)
            (stage / "report.html").write_text(page.html(scene, to_dict(scene), pictures), encoding="utf-8")
        files = tuple(sorted([*files_in(stage), "scene.json"]))
        tree = to_dict(scene) | {"files": files}
        (stage / "scene.json").write_text(_json(tree), encoding="utf-8")
    return files


def load(folder: str | os.PathLike[str]) -> "Scene":
    """Reads back what `save` wrote, from scene.json, arrays.npz and rig.json.

    Raises:
        FileNotFoundError: The folder or one of these files is missing.
        ValueError: They are damaged, or of another version.
    """
    from jaxfuzzy.scene import Scene

    folder = Path(folder)
    tree = _tree(folder)
    needed = [name for name in ("arrays.npz", "rig.json") if name in tree["files"]]
    if missing := [name for name in needed if not standing(folder, name).exists()]:
        raise FileNotFoundError(f"scene in {folder} lacks {' and '.join(missing)}")
    try:
        arrays = read_arrays(standing(folder, "arrays.npz").read_bytes())
        dtype = jax.dtypes.canonicalize_dtype(tree["dtype"])
        shapes = []
        for entry in tree["shapes"]:
            body = entry["parameters"] and primitive_from_dict({"kind": entry["kind"]} | entry["parameters"])
            shapes.append(
                Shape(
                    primitive=_cast(body, dtype),
                    inliers=jnp.asarray(arrays[f"inliers.{entry['object']}"]),
                    noise_distance=entry["noise_distance"],
                    scores={kind: _known(score) for kind, score in entry["scores"].items()},
                    margin=_known(entry["margin"]),
                    counts=entry["counts"],
                    covariance=jnp.asarray(_known(entry["covariance"]), dtype).reshape(
                        2 * (len(entry["covariance_of"]),)
                    ),
                    status=jnp.asarray(entry["status"]),
                    kind=entry["kind"],
                )
            )
        return Scene(
            cloud=_restore(Cloud, arrays, "cloud"),
            up=jnp.asarray(tree["up"], dtype),
            ground=_cast(tree["ground"] and primitive_from_dict(tree["ground"]), dtype),
            segmentation=_restore(Segmentation, arrays, "segmentation"),
            shapes=tuple(shapes),
            timings=tree["timings"],
            settings=tree["settings"],
            status=jnp.asarray(tree["status"]),
            image=_restore(jax.Array, arrays, "image"),
            image_right=_restore(jax.Array, arrays, "image_right"),
            rig=load_rig(standing(folder, "rig.json")) if "rig.json" in tree["files"] else None,
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"scene in {folder} is damaged ({type(error).__name__}: {one_line(error)})") from None


def can_draw() -> bool:
    """Whether the `view` extra is installed."""
    return all(importlib.util.find_spec(name) for name in DRAWING)


def check_folder(folder: str | os.PathLike[str]) -> None:
    """Finds out before a long computation whether `save` can write there; leaves no trace.

    Raises:
        OSError: It cannot, see `save`.
    """
    with staged(folder, _earlier, FILES, keep=False):
        pass


def _earlier(folder: Path) -> tuple[str, ...]:
    """The files an earlier run says it wrote into a folder."""
    try:
        return tuple(name for name in _tree(folder)["files"] if isinstance(name, str))
    except (OSError, ValueError):
        return ()


def _tree(folder: Path) -> dict[str, Any]:
    """What scene.json says."""
    path = standing(folder, "scene.json")
    if not path.is_file():
        raise FileNotFoundError(f"no scene.json in {folder}")
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON ({error})") from None
    if not isinstance(tree, dict) or tree.get("schema") != SCHEMA:
        raise ValueError(f"{path} is JSON of another kind: schema must be {SCHEMA!r}")
    if tree.get("version") != VERSION:
        raise ValueError(f"{path} has version {tree.get('version')!r}, only {VERSION} is known here")
    if not isinstance(tree.get("files"), list):
        raise ValueError(f"{path} does not list its files")
    return tree


def _flat(scene: "Scene") -> dict[str, np.ndarray]:
    """Every array of one number or more a point, and the photographs, by dotted name."""
    arrays: dict[str, np.ndarray] = {f"inliers.{i}": np.asarray(s.inliers) for i, s in enumerate(scene.shapes)}

    def walk(value: Any, name: str) -> None:
        if dataclasses.is_dataclass(value):
            for field in dataclasses.fields(value):
                walk(getattr(value, field.name), f"{name}.{field.name}")
        elif value is not None:
            arrays[name] = np.asarray(value)

    for name in ("cloud", "segmentation", "image", "image_right"):
        walk(getattr(scene, name), name)
    return arrays


def _restore(kind: Any, arrays: dict[str, np.ndarray], name: str) -> Any:
    """Undoes `_flat` for a field of the type `kind`; None where nothing was kept."""
    inner = next((k for k in (kind, *typing.get_args(kind)) if dataclasses.is_dataclass(k)), None)
    if inner is not None:
        if not any(key.startswith(f"{name}.") for key in arrays):
            return None
        hints = typing.get_type_hints(inner)
        fields = [field.name for field in dataclasses.fields(typing.cast(Any, inner))]
        return typing.cast(Any, inner)(**{field: _restore(hints[field], arrays, f"{name}.{field}") for field in fields})
    if name not in arrays:
        return None
    if kind is int:
        return int(arrays[name])
    return jnp.asarray(arrays[name])


def _cast(body: Any, dtype: Any) -> Any:
    """A record with its real numbers in another precision; None stays None."""
    return jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, body)


def _known(value: Any) -> Any:
    """Undoes `_plain` for numbers and lists of them: None was a number that is not finite."""
    if isinstance(value, list):
        return [_known(item) for item in value]
    return math.inf if value is None else value


def _plain(value: Any) -> Any:
    """Plain Python that JSON can hold; numbers that are not finite become None."""
    match value:
        case None | bool() | str() | int():
            return value
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {str(key): _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case np.ndarray() | np.generic() | jax.Array():
            return _plain(np.asarray(value).tolist())
        case os.PathLike():
            return os.fspath(value)
    raise TypeError(f"settings must be numbers, text, lists and dicts of them, got {type(value).__name__}")


def _json(tree: dict[str, Any]) -> str:
    """Indented JSON with a list of plain numbers on one line; text cannot hold a raw line break, so is never touched."""
    text = json.dumps(tree, indent=1, allow_nan=False) + "\n"
    return re.sub(r"\[\n[^\[\]{}\"]*\]", lambda found: "[" + " ".join(found[0][1:-1].split()) + "]", text)


def _reasons(status: Any) -> dict[str, Any]:
    bits = int(status)
    return {"status": bits, "reasons": [sentence for bit, sentence in SENTENCES.items() if bits & bit]}


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "machine": platform.machine(), "device": jax.default_backend()}
    for package in ("jaxfuzzy", "jax", "numpy", "opencv-python-headless"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found
