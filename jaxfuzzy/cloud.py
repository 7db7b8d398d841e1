"""The point cloud: its record, and reading and writing it."""

import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfuzzy import checks, cloudfiles
from jaxfuzzy.arrays import Array, Float, Int, as_float, extents, record
from jaxfuzzy.files import one_line, read_bytes, write_atomic

SUFFIXES = (".ply", ".pcd", ".npy", ".npz", ".csv", ".xyz", ".txt")
BESIDE = ("depth_std", "column_px", "row_px")
# Of colors between 0 and 1: more than rounding.
COLOR_SLACK = 0.01
COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


@record
class Cloud:
    """A point cloud in the left camera's frame (x right, y down, z forward), in metres.

    Attributes:
        points: The points.
        colors: Red, green, blue in 0..1.
        depth_std: Standard deviation of each point's depth.
        pixels_px: Column and row of each point in the left image.
        status: Reasons to read it with care; see `describe`.
    """

    points: Float[Array, "N 3"]
    colors: Float[Array, "N 3"] | None = None
    depth_std: Float[Array, " N"] | None = None
    pixels_px: Float[Array, "N 2"] | None = None
    status: Int[Array, ""] | int = 0


def check_cloud(cloud: Any) -> np.ndarray:
    """The points (N, 3) of a cloud on the host, its other fields being theirs.

    Raises:
        TypeError: It is no cloud.
        ValueError: A field has another shape, or holds what cannot be.
    """
    checks.kind(cloud, "cloud", Cloud, "Cloud(points) makes one, read_cloud reads one")
    points = np.asarray(checks.places(cloud.points, "cloud.points", whole=True))
    for name, width in (("colors", 3), ("pixels_px", 2)):
        if (value := getattr(cloud, name)) is None:
            continue
        array = np.asarray(checks.points(value, f"cloud.{name}", dims=width))
        if len(array) != len(points):
            raise ValueError(f"cloud.{name} must have shape ({len(points)}, {width}), got {array.shape}")
        if name == "colors":
            _check_colors(array)
        if name == "pixels_px" and len(array) > 1 and not extents(array).any():
            raise ValueError(
                f"cloud.pixels_px must be the column and row of each point, got {array[0].tolist()} for all"
            )
    if cloud.depth_std is not None:
        checks.noise_distance(cloud.depth_std, len(points), "cloud.depth_std")
    return points


def _check_colors(colors: np.ndarray) -> None:
    if not np.all((colors >= -COLOR_SLACK) & (colors <= 1 + COLOR_SLACK)):
        raise ValueError(f"cloud.colors must be 0 to 1, got {colors.min():g} to {colors.max():g}")


def read_cloud(path: str | os.PathLike[str]) -> Cloud:
    """Reads a point cloud: PLY, PCD, NPY, NPZ, CSV or XYZ, told apart by content. Nothing is unpickled.

    Coordinates are taken as they are, in metres. Points that are not finite, or whose depth deviation or pixel is not, are
    left out, and a warning says how many; another one tells a viewpoint other than the origin, which PCD files may have.
    What a file holds beside coordinates, colors and what `write_cloud` adds (normals, labels, ...) is passed over.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is in none of these formats, damaged, cut short, holds no finite point, or points so far from the origin
            that the precision of JAX does not tell them apart.
    """
    data = read_bytes(path, "cloud")
    try:
        columns = cloudfiles.parse(data)
        # Some write their names in capitals.
        columns = {name.lower(): values for name, values in columns.items() if name != name.lower()} | columns
        if missing := [name for name in "xyz" if name not in columns]:
            raise ValueError(f"has no column {', '.join(missing)}, only {', '.join(columns)}")
        points = np.stack([columns[name] for name in "xyz"], axis=1)
        # In the precision JAX will have them: what overflows there is as infinite as what was infinite before.
        with np.errstate(over="ignore"):
            kind = points.dtype.newbyteorder("=") if points.dtype.kind == "f" else np.dtype(float)
            points = np.asarray(as_float(points.astype(kind)))
            beside = {name: columns[name].astype(np.float32) for name in BESIDE if name in columns}
        finite = np.isfinite(np.stack([*points.T, *beside.values()])).all(axis=0)
        if not finite.any():
            raise ValueError(f"holds no finite point, out of {len(points)}")
        checks.places(points[finite], whole=True)
    except ValueError as error:
        raise ValueError(f"cloud {os.fspath(path)} {one_line(error)}") from None
    if not finite.all():
        warnings.warn(
            f"cloud {os.fspath(path)}: {int((~finite).sum())} of {len(points)} points are not finite and were left out",
            stacklevel=2,
        )

    if (place := cloudfiles.viewpoint(data)) is not None:
        warnings.warn(
            f"cloud {os.fspath(path)} was seen from {place} by its own word: unless points are in the camera's frame, give that"
            " as camera",
            stacklevel=2,
        )

    def kept(*names: str) -> Array | None:
        if not all(name in beside for name in names):
            return None
        values = np.stack([beside[name][finite] for name in names], axis=1)
        return as_float(values[:, 0] if len(names) == 1 else values)

    return Cloud(
        points=as_float(points[finite]),
        colors=_colors(columns, finite),
        depth_std=kept("depth_std"),
        pixels_px=kept("column_px", "row_px"),
    )


def write_cloud(
    path: str | os.PathLike[str], cloud: Cloud, *, extra: Mapping[str, Any] | None = None, ascii: bool = False
) -> None:
    """Writes a point cloud, whole or not at all, in the format its suffix names.

    Args:
        path: Ends in .ply, .pcd, .npz, .npy (points alone), .csv or .xyz/.txt (no names; points and colors).
        cloud: The cloud.
        extra: Further columns by name, one number a point.
        ascii: Write PLY and PCD as text.

    Raises:
        ValueError: The suffix is none of these, colors are not 0..1, or a column has another length, a number too large, or a name
            that the cloud has itself or that no file can have.
        OSError: The file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"path must end in one of {', '.join(SUFFIXES)}, got {os.fspath(path)}")
    checks.kind(cloud, "cloud", Cloud, "Cloud(points) makes one")
    points = np.asarray(cloud.points)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"cloud.points must have shape (N, 3) with at least one point, got {points.shape}")
    arrays = {"points": points}
    columns: cloudfiles.Columns = dict(zip("xyz", points.T, strict=True))
    if cloud.colors is not None:
        colors = np.asarray(cloud.colors)
        _check_colors(colors)
        arrays["colors"] = np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
        columns |= dict(zip(COLORS[0], arrays["colors"].T, strict=True))
    if cloud.depth_std is not None:
        arrays["depth_std"] = columns["depth_std"] = np.asarray(cloud.depth_std)
    if cloud.pixels_px is not None:
        arrays["pixels_px"] = np.asarray(cloud.pixels_px)
        columns |= dict(zip(("column_px", "row_px"), arrays["pixels_px"].T, strict=True))
    for name, values in (extra or {}).items():
        if name in columns or name in arrays or not re.fullmatch(r"[A-Za-z_]\w*", name):
            raise ValueError(f"extra must have names of letters that the cloud has not itself, got {name!r}")
        arrays[name] = columns[name] = np.asarray(values)
    for name, values in columns.items():
        columns[name] = _writable(name, values, len(points))
    if suffix == ".ply":
        data = cloudfiles.write_ply(columns, ascii=ascii)
    elif suffix == ".pcd":
        data = cloudfiles.write_pcd(columns, ascii=ascii)
    elif suffix in (".npy", ".npz"):
        data = cloudfiles.write_numpy(arrays, packed=suffix == ".npz")
    elif suffix == ".csv":
        data = cloudfiles.write_text(columns, delimiter=",", names=True)
    else:
        plain = {name: values for name, values in columns.items() if name in ("x", "y", "z", *COLORS[0])}
        data = cloudfiles.write_text(plain, delimiter=" ", names=False)
    write_atomic(path, data)


def _writable(name: str, values: np.ndarray, count: int) -> np.ndarray:
    """One number a point, of a type that the formats have."""
    if values.shape != (count,) or values.dtype.kind not in "fiub":
        raise ValueError(f"column {name} must hold {count} numbers, got {values.dtype} of shape {values.shape}")
    if values.dtype == bool:
        return values.astype(np.uint8)
    if values.dtype.kind in "iu" and values.dtype.itemsize == 8:
        whole = values.astype(np.int32)
        if not np.array_equal(whole, values):
            raise ValueError(f"column {name} must hold whole numbers of 32 bits, got up to {np.abs(values).max()}")
        return whole
    return values.astype(np.float32) if values.dtype.itemsize == 2 and values.dtype.kind == "f" else values


def _colors(columns: cloudfiles.Columns, kept: np.ndarray) -> Array | None:
    packed = next((columns[name] for name in ("rgb", "rgba") if name in columns), None)
    names = next((names for names in COLORS if all(name in columns for name in names)), None)
    if names is not None:
        colors = np.stack([columns[name][kept] for name in names], axis=1)
    elif packed is not None and packed.dtype.itemsize == 4:
        # PCL packs a color into the bits of a float or an unsigned number: 0x00RRGGBB.
        bits = packed[kept].astype(packed.dtype.newbyteorder("=")).view(np.uint32)
        colors = np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=1).astype(np.uint8)
    else:
        return None
    if colors.dtype.kind in "iu":
        top = 65535.0 if colors.dtype.itemsize == 2 else 255.0
    else:
        colors = np.where(np.isfinite(colors), colors, 0)
        top = 1.0 if colors.max(initial=0) <= 1 else 255.0
    return jnp.asarray(np.clip(colors.astype(np.float32) / top, 0, 1))
