"""Any table of points for the command line: named columns of numbers in, the same with labels and memberships out."""

import csv
import io
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxfuzzy import cloudfiles
from jaxfuzzy.fcm import Partition
from jaxfuzzy.files import one_line, read_arrays, read_bytes, write_atomic

WRITTEN = (".csv", ".json", ".npz")


def read_points(path: str | os.PathLike[str], columns: Sequence[str] = ()) -> tuple[list[str], np.ndarray]:
    """Points (N, D) of any dimension, and the names of their columns.

    Reads CSV and other text (commas, semicolons, tabs or blanks, with or without a line of names), NPY and NPZ (an array
    `points`, or the only one), PLY and PCD (x, y, z unless `columns` says otherwise).

    Args:
        path: The file.
        columns: Which columns, by name or number from 0; all of a table by default.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, holds something that is not a number, or lacks a column.
    """
    data = read_bytes(path, "points")
    try:
        if data.startswith((b"ply", b"# .PCD", b"VERSION", b"FIELDS")):
            found = cloudfiles.parse(data)
            columns = columns or ("x", "y", "z")
            names, table = list(found), np.stack([values.astype(float) for values in found.values()], axis=1)
        elif data.startswith((b"\x93NUMPY", b"PK")):
            names, table = _from_numpy(data)
        else:
            names, cells = _from_text(data)
            chosen = _chosen(names, columns)
            rows = [[_number(row[i], names[i], line) for i in chosen] for line, row in cells]
            return [names[i] for i in chosen], np.array(rows, float).reshape(len(rows), len(chosen))
        chosen = _chosen(names, columns)
        return [names[i] for i in chosen], table[:, chosen]
    except ValueError as error:
        raise ValueError(f"points {os.fspath(path)} {one_line(error)}") from None


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Whether `write_points` knows the format a name asks for.

    Raises:
        ValueError: It does not.
    """
    if Path(path).suffix.lower() not in WRITTEN:
        raise ValueError(f"out must end in one of {', '.join(WRITTEN)}, got {os.fspath(path)}")


def write_points(path: str | os.PathLike[str], names: Sequence[str], points: np.ndarray, partition: Partition) -> None:
    """Writes points with their label, their membership in each cluster and in noise: CSV, JSON or NPZ by suffix.

    Raises:
        ValueError: The suffix is none of these.
        OSError: The file cannot be written.
    """
    check_suffix(path)
    labels, noise = np.asarray(partition.labels), np.asarray(partition.noise)
    memberships = np.asarray(partition.memberships)
    suffix = Path(path).suffix.lower()
    if suffix == ".npz":
        file = io.BytesIO()
        arrays = {"points": points, "labels": labels, "memberships": memberships, "noise": noise}
        arrays |= {"centers": np.asarray(partition.centers), "sizes": np.asarray(partition.sizes)}
        np.savez_compressed(file, allow_pickle=False, **arrays)
        write_atomic(path, file.getvalue())
        return
    degrees = [f"membership_{i}" for i in range(memberships.shape[1])]
    header = [*names, "label", *degrees, "noise"]
    rows = [
        [*map(float, point), int(label), *map(float, degree), float(rest)]
        for point, label, degree, rest in zip(points, labels, memberships, noise, strict=True)
    ]
    if suffix == ".json":
        text = json.dumps({"columns": header, "rows": rows})
    else:
        lines = io.StringIO()
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([[f"{value:.9g}" if isinstance(value, float) else value for value in row] for row in rows])
        text = lines.getvalue()
    write_atomic(path, text.encode())


def _from_numpy(data: bytes) -> tuple[list[str], np.ndarray]:
    arrays = read_arrays(data)
    if "points" not in arrays and len(arrays) != 1:
        raise ValueError(f"must hold an array 'points' or a single one, got {', '.join(arrays) or 'none'}")
    table = arrays.get("points", next(iter(arrays.values())))
    if table.ndim != 2 or table.dtype.kind not in "fiub":
        raise ValueError(f"must hold real numbers of shape (N, D), got {table.dtype} of shape {table.shape}")
    return [f"x{i}" for i in range(table.shape[1])], table.astype(float)


def _from_text(data: bytes) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Names of the columns, and each row's cells with its line number."""
    if b"\0" in data[: 1 << 16]:
        raise ValueError("is in no known format (CSV, NPY, NPZ, PLY, PCD)")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError("is no UTF-8 text") from None
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.split("#")[0].strip()]
    mark = next((mark for mark in ",;\t" if lines and mark in lines[0][1]), None)
    cells = [(number, _cells(line.split("#")[0], mark)) for number, line in lines]
    if not cells:
        raise ValueError("holds no points")
    width = len(cells[0][1])
    if uneven := next((number for number, row in cells if len(row) != width), None):
        raise ValueError(f"has {width} columns, but not in line {uneven}")
    if any(_is_number(cell) for cell in cells[0][1]):
        return [f"x{i}" for i in range(width)], cells
    if len(cells) == 1:
        raise ValueError("holds names but no points")
    return cells[0][1], cells[1:]


def _cells(line: str, mark: str | None) -> list[str]:
    if mark is None:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line.strip()], delimiter=mark))]


def _chosen(names: Sequence[str], columns: Sequence[str]) -> list[int]:
    found = []
    for column in columns or [str(i) for i in range(len(names))]:
        if column in names:
            found.append(names.index(column))
        elif column.isdecimal() and int(column) < len(names):
            found.append(int(column))
        else:
            raise ValueError(f"has no column {column!r}, only {', '.join(names)}")
    return found


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _number(cell: str, name: str, line: int) -> float:
    if not _is_number(cell):
        raise ValueError(
            f"has {cell!r} in column {name}, line {line}, which is not a number; choose others by --columns"
        )
    return float(cell)
