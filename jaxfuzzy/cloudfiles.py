"""Point-cloud files as named columns: PLY, PCD, NPY, NPZ and plain text, read and written without unpickling anything.

A file is whole or refused: what its header promises is compared with what is there before anything is allocated.
"""

import io
import re

import numpy as np

from jaxfuzzy.files import read_arrays

Columns = dict[str, np.ndarray]

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
PLY_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
             "f8": "double"}  # fmt: skip
PLY_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
PCD_TYPES = {"I": "i", "U": "u", "F": "f"}
LONGEST_HEADER = 1 << 16


def parse(data: bytes) -> Columns:
    """The columns of a point-cloud file, told apart by its first bytes.

    Raises:
        ValueError: It is none of the known formats, damaged or cut short.
    """
    data = data.removeprefix(b"\xef\xbb\xbf")  # editors on Windows mark the order of bytes before the text
    if data.startswith(b"ply"):
        return parse_ply(data)
    if data.startswith(b"\x93NUMPY") or data.startswith(b"PK"):
        return parse_numpy(data)
    if re.match(rb"(\s*#[^\n]*\n)*\s*(VERSION|FIELDS)\s", data[:LONGEST_HEADER]):
        return parse_pcd(data)
    return parse_text(data)


def parse_ply(data: bytes) -> Columns:
    """The vertices of a PLY file, ascii or binary of either byte order; other elements are passed over."""
    head, body = _header(data, b"end_header")
    lines = [
        words for line in head.splitlines()[1:-1] if (words := line.split()) and words[0] not in ("comment", "obj_info")
    ]
    order = ""
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in lines:
        if words[0] == "format" and len(words) == 3 and words[1] in PLY_FORMATS:
            order = words[1]
        elif words[0] == "element" and len(words) == 3:
            elements.append((words[1], _count(words[2], f"element {words[1]}"), []))
        elif words[0] == "property" and len(words) in (3, 5) and elements and _known_types(words):
            elements[-1][2].append(words[1:])
        else:
            raise ValueError(f"has the header line {' '.join(words)!r}, which is no PLY")
    if not order:
        raise ValueError("has no format line")
    if "vertex" not in [name for name, _, _ in elements]:
        raise ValueError("has no vertices")
    rows = body.decode("ascii", "replace").split("\n") if order == "ascii" else []
    at = 0
    for name, count, properties in elements:
        if name == "vertex":
            names = _unique([words[-1] for words in properties])
            if any(words[0] == "list" for words in properties):
                raise ValueError("has a list among the vertex properties, which is not supported")
            last = elements[-1][0] == "vertex"
            if order == "ascii":
                table = _table([row for row in rows[at:] if row.strip()], None, count, exact=last)
                if table.shape[1] != len(names):
                    raise ValueError(f"has {table.shape[1]} numbers a vertex where the header says {len(names)}")
                kinds = [PLY_TYPES[words[0]] for words in properties]
                return _typed(table, list(zip(names, kinds, strict=True)))
            kinds = [PLY_FORMATS[order] + PLY_TYPES[words[0]] for words in properties]
            return _records(body[at:], list(zip(names, kinds, strict=True)), count, exact=last)
        at += count if order == "ascii" else _ply_element_size(body[at:], count, properties, PLY_FORMATS[order])
    raise AssertionError("unreachable: there is a vertex element")


def _ply_element_size(body: bytes, count: int, properties: list[list[str]], order: str) -> int:
    """Bytes of a binary element before the vertices."""
    at = 0
    fixed = sum(np.dtype(PLY_TYPES[words[0]]).itemsize for words in properties if words[0] != "list")
    if all(words[0] != "list" for words in properties):
        at = fixed * count
    else:
        for _ in range(count):
            for words in properties:
                if words[0] != "list":
                    at += np.dtype(PLY_TYPES[words[0]]).itemsize
                    continue
                kind = np.dtype(order + PLY_TYPES[words[1]])
                if len(body) < at + kind.itemsize:
                    raise ValueError("is cut short")
                length = int(np.frombuffer(body, kind, 1, at)[0])
                if length < 0:
                    raise ValueError(f"has a list of {length} numbers")
                at += kind.itemsize + length * np.dtype(PLY_TYPES[words[2]]).itemsize
            if at > len(body):
                break
    if at > len(body):
        raise ValueError("is cut short")
    return at


def _known_types(words: list[str]) -> bool:
    if words[1] == "list":
        return len(words) == 5 and words[2] in PLY_TYPES and words[3] in PLY_TYPES
    return len(words) == 3 and words[1] in PLY_TYPES


def parse_pcd(data: bytes) -> Columns:
    """A PCD file: ascii, binary or binary_compressed."""
    head, body = _header(data, b"DATA")
    entries = {
        words[0]: words[1:] for line in head.splitlines() if (words := line.split()) and not line.startswith("#")
    }
    if missing := [name for name in ("FIELDS", "SIZE", "TYPE", "DATA") if not entries.get(name)]:
        raise ValueError(f"is a PCD file without {' and '.join(missing)}")
    fields, sizes, types = entries["FIELDS"], entries["SIZE"], entries["TYPE"]
    counts = entries.get("COUNT", ["1"] * len(fields))
    if not len(fields) == len(sizes) == len(types) == len(counts):
        raise ValueError("is a PCD file whose FIELDS, SIZE, TYPE and COUNT differ in length")
    shape = [_count(entries[name][0], name) for name in ("WIDTH", "HEIGHT") if entries.get(name)]
    count = _count(entries["POINTS"][0], "POINTS") if entries.get("POINTS") else int(np.prod(shape)) if shape else -1
    if count < 0:
        raise ValueError("is a PCD file that does not say how many POINTS it has")
    if len(shape) == 2 and shape[0] * shape[1] != count:
        raise ValueError(f"says {count} POINTS but WIDTH x HEIGHT is {shape[0]} x {shape[1]}")
    kinds = []
    for field, size, type_, repeat in zip(fields, sizes, types, counts, strict=True):
        if type_ not in PCD_TYPES or size not in ("1", "2", "4", "8") or (type_ == "F" and size in "12"):
            raise ValueError(f"has the field {field!r} of unknown type {type_} {size}")
        times = _count(repeat, "COUNT")
        if times > LONGEST_HEADER:
            raise ValueError(f"says {times} numbers for the field {field!r} of every point")
        kinds += [(f"{field}{'' if times == 1 else f'_{i}'}", f"<{PCD_TYPES[type_]}{size}") for i in range(times)]
    kinds = list(zip(_unique([name for name, _ in kinds]), [kind for _, kind in kinds], strict=True))
    layout = entries["DATA"][0].lower()
    if layout == "ascii":
        rows = [row for row in body.decode("ascii", "replace").split("\n") if row.strip()]
        table = _table(rows, None, count, exact=True)
        if table.shape[1] != len(kinds):
            raise ValueError(f"has {table.shape[1]} numbers a point where the header says {len(kinds)}")
        return _typed(table, kinds)
    if layout == "binary":
        return _records(body, kinds, count, exact=False)  # PCL pads the file to a whole page
    if layout == "binary_compressed":
        return _pcd_compressed(body, kinds, count)
    raise ValueError(f"has DATA {layout!r}; known are ascii, binary and binary_compressed")


def viewpoint(data: bytes) -> tuple[float, ...] | None:
    """Where a PCD file says its points were seen from; None where that is the origin, or is not said."""
    found = re.search(rb"^VIEWPOINT[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", data[:LONGEST_HEADER], re.MULTILINE)
    if found is None or not all(_is_number(word.decode("ascii", "replace")) for word in found.groups()):
        return None
    place = tuple(float(word) for word in found.groups())
    return place if any(place) else None


def _pcd_compressed(body: bytes, kinds: list[tuple[str, str]], count: int) -> Columns:
    """Two sizes, then LZF data that hold one field after the other."""
    if len(body) < 8:
        raise ValueError("is cut short")
    packed, size = (int(number) for number in np.frombuffer(body[:8], "<u4"))
    expected = count * sum(np.dtype(kind).itemsize for _, kind in kinds)
    if size != expected:
        raise ValueError(f"says {size} bytes of points where its fields make {expected}")
    if len(body) < 8 + packed:
        raise ValueError("is cut short")
    unpacked = _lzf(body[8 : 8 + packed], size)
    columns, at = {}, 0
    for name, kind in kinds:
        end = at + count * np.dtype(kind).itemsize
        columns[name] = np.frombuffer(unpacked[at:end], kind)
        at = end
    return columns


def _lzf(data: bytes, size: int) -> bytes:
    """Undoes LibLZF's compression: runs of literal bytes, and copies of what came up to 8 KiB before."""
    out = bytearray()
    at = 0
    try:
        while at < len(data):
            control = data[at]
            at += 1
            if control < 32:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            length += 2
            if start < 0:
                raise ValueError("is damaged: its compressed data refer to before their start")
            piece = out[start : start + length]
            while len(piece) < length:  # a copy may overlap what it writes
                piece += piece[: length - len(piece)]
            out += piece
            if len(out) > size:
                break
    except IndexError:
        raise ValueError("is cut short") from None
    if len(out) != size:
        raise ValueError(f"is damaged: unpacks to {len(out)} bytes where {size} are promised")
    return bytes(out)


def parse_numpy(data: bytes) -> Columns:
    """NPY (N, 3 or more), (H, W, 3 or more) or with named fields; NPZ with points or xyz, and colors or rgb."""
    arrays = read_arrays(data)
    name = next((name for name in ("points", "xyz", "arr_0") if name in arrays), None)
    if name is None:
        raise ValueError(f"holds neither 'points' nor 'xyz', only {', '.join(map(repr, arrays)) or 'nothing'}")
    points = arrays[name]
    if points.dtype.names:
        return {field: np.ravel(points[field]) for field in points.dtype.names if points[field].ndim == points.ndim}
    if points.ndim not in (2, 3) or points.shape[-1] < 3 or points.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be numbers of shape (N, 3) or (H, W, 3), got {points.dtype} {points.shape}")
    flat = points.reshape(-1, points.shape[-1])
    columns = _unnamed(flat)
    colors = next((arrays[other] for other in ("colors", "rgb") if other in arrays), None)
    # With or without an opacity.
    if colors is not None and colors.shape[-1:] in ((3,), (4,)) and colors.size == colors.shape[-1] * len(flat):
        columns |= dict(zip(("red", "green", "blue"), colors.reshape(-1, colors.shape[-1]).T[:3], strict=True))
    if "pixels_px" in arrays and arrays["pixels_px"].shape == (len(flat), 2):
        columns |= dict(zip(("column_px", "row_px"), arrays["pixels_px"].T, strict=True))
    for other, values in arrays.items():
        if (
            other not in (name, "colors", "rgb", "pixels_px")
            and values.size == len(flat)
            and values.dtype.kind in "fiub"
        ):
            columns[other] = values.ravel()
    return columns


def parse_text(data: bytes) -> Columns:
    """Rows of numbers separated by commas, semicolons or blanks, with or without a line of names; # starts a comment.

    Without names the first three are x, y, z; three further columns of whole numbers 0..255 are a color. CloudCompare puts //
    before its names, and how many points follow after them. Spreadsheets put numbers in quotes, and leave out unknown ones.
    """
    if b"\0" in data[:LONGEST_HEADER]:
        raise ValueError("is in no known format (PLY, PCD, NPY, NPZ, CSV, XYZ)")
    # Rows of delimiters alone hold nothing either.
    rows = [
        row for line in data.decode("utf-8", "replace").splitlines() if (row := line.split("#")[0].strip()).strip(" ,;")
    ]
    if not rows:
        raise ValueError("holds no points")
    delimiter = next((mark for mark in ",;" if any(mark in row for row in rows[:2])), None)
    if delimiter is not None and all(row.endswith(delimiter) for row in rows):
        rows = [row[:-1] for row in rows]
    names = [word.strip().strip('"').lower() for word in rows[0].split(delimiter)]
    if delimiter is not None:
        rows = _filled(rows, delimiter)
    if any(names) and all(not word or _is_number(word) for word in names):
        if len(names) == 1 and len(rows) > 1 and len(rows[1].split(delimiter)) >= 3:
            count, rows = _count(names[0], "the first line"), rows[1:]  # PTS: how many points follow
        else:
            count = len(rows)
        table = _table(rows, delimiter, count, exact=True)
        if table.shape[1] < 3:
            raise ValueError(f"must have at least three columns, x, y and z, got {table.shape[1]}")
        return _unnamed(table)
    if names[0].startswith("//"):
        names[0] = names[0].removeprefix("//").strip()
        names = names[0 if names[0] else 1 :]
    if len(rows) > 2 and len(names) > 1 and rows[1].isdecimal():
        del rows[1]
    if len(rows) < 2:
        raise ValueError("holds no points, or is in no known format (PLY, PCD, NPY, NPZ, CSV, XYZ)")
    table = _table(rows[1:], delimiter, len(rows) - 1, exact=True)
    if table.shape[1] != len(names):
        raise ValueError(f"has {len(names)} names but {table.shape[1]} columns")
    return dict(zip(_unique(names), table.T, strict=True))


def _unnamed(table: np.ndarray) -> Columns:
    """Columns of rows (N, 3 or more) without names: x, y, z, and a color where three others look like one."""
    columns: Columns = dict(zip("xyz", table.T[:3], strict=True))
    rest = table[:, 3:6]
    if (
        rest.size
        and table.shape[1] == 6
        and np.all((rest >= 0) & (rest <= 255) & (rest == np.round(rest)))
        and rest.max() > 1
    ):
        columns |= dict(zip(("red", "green", "blue"), rest.T.astype(np.uint8), strict=True))
    return columns


def _filled(rows: list[str], delimiter: str) -> list[str]:
    """Rows without quotes, and with "nan" where a cell is empty."""
    empty, ends = delimiter + delimiter, (row[0] + row[-1] for row in rows)
    if not any(delimiter in end for end in ends) and not any(
        '"' in row or empty in row.replace(" ", "") for row in rows
    ):
        return rows
    return [delimiter.join(cell.strip().strip('"') or "nan" for cell in row.split(delimiter)) for row in rows]


def write_ply(columns: Columns, *, ascii: bool) -> bytes:
    """Vertices as PLY, binary little-endian or ascii."""
    order = "ascii" if ascii else "binary_little_endian"
    lines = ["ply", f"format {order} 1.0", f"element vertex {_length(columns)}"]
    lines += [f"property {PLY_NAMES[values.dtype.str[1:]]} {name}" for name, values in columns.items()]
    return "\n".join([*lines, "end_header", ""]).encode() + _body(columns, ascii)


def write_pcd(columns: Columns, *, ascii: bool) -> bytes:
    """A PCD file, binary or ascii; colors go into one packed field as PCL has them."""
    columns = dict(columns)
    if {"red", "green", "blue"} <= columns.keys():
        red, green, blue = (columns.pop(name).astype(np.uint32) for name in ("red", "green", "blue"))
        columns["rgb"] = red << 16 | green << 8 | blue
    count = _length(columns)
    kinds = [values.dtype for values in columns.values()]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        f"DATA {'ascii' if ascii else 'binary'}",
        "",
    ]
    return "\n".join(lines).encode() + _body(columns, ascii)


def write_text(columns: Columns, *, delimiter: str, names: bool) -> bytes:
    """Rows of numbers, with a line of names where asked."""
    head = (delimiter.join(columns) + "\n").encode() if names else b""
    return head + _body(columns, True, delimiter)


def write_numpy(arrays: dict[str, np.ndarray], *, packed: bool) -> bytes:
    """NPZ with every array, or NPY with the points alone."""
    file = io.BytesIO()
    if packed:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    else:
        np.save(file, arrays["points"], allow_pickle=False)
    return file.getvalue()


def _body(columns: Columns, ascii: bool, delimiter: str = " ") -> bytes:
    if not ascii:
        records = np.empty(_length(columns), [(name, "<" + values.dtype.str[1:]) for name, values in columns.items()])
        for name, values in columns.items():
            records[name] = values
        return records.tobytes()
    # Shortest digits that read back as the same number of that type.
    texts = [[repr(value) for value in values.tolist()] if values.dtype.kind in "iu" or values.dtype.itemsize == 8
             else [np.format_float_positional(value, unique=True, trim="0") for value in values]
             for values in columns.values()]  # fmt: skip
    return "".join(delimiter.join(row) + "\n" for row in zip(*texts, strict=True)).encode()


def _header(data: bytes, last: bytes) -> tuple[str, bytes]:
    """The header up to and with the line that starts with `last`, and the rest."""
    at = 0
    while at < min(len(data), LONGEST_HEADER):
        end = data.find(b"\n", at)
        end = len(data) if end < 0 else end
        if data[at:end].strip().startswith(last):
            return data[:end].decode("ascii", "replace"), data[end + 1 :]
        at = end + 1
    raise ValueError(f"has a header without {last.decode()}")


def _records(body: bytes, kinds: list[tuple[str, str]], count: int, *, exact: bool) -> Columns:
    dtype = np.dtype(kinds)
    held = len(body) // max(dtype.itemsize, 1)
    if held < count:
        raise ValueError(f"is cut short: the header promises {count} points, there are {held}")
    if exact and len(body[count * dtype.itemsize :].strip(b"\0\r\n ")):
        raise ValueError(f"holds more than the {count} points its header promises")
    records = np.frombuffer(body, dtype, count)
    return {name: records[name] for name, _ in kinds}


def _table(rows: list[str], delimiter: str | None, count: int, *, exact: bool) -> np.ndarray:
    if len(rows) < count:
        raise ValueError(f"is cut short: {count} points are promised, there are {len(rows)}")
    if exact and len(rows) > count:
        raise ValueError(f"holds {len(rows)} points where {count} are promised")
    if count == 0:
        raise ValueError("holds no points")
    try:
        return np.loadtxt(rows[:count], delimiter=delimiter, ndmin=2, comments=None)
    except ValueError as error:
        raise ValueError(f"has a row that is not numbers ({str(error).splitlines()[0]})") from None


def _typed(table: np.ndarray, kinds: list[tuple[str, str]]) -> Columns:
    """The columns of a table of text, each as the type its header says where that can hold it."""
    columns = {}
    for values, (name, kind) in zip(table.T, kinds, strict=True):
        with np.errstate(invalid="ignore"):
            typed = values.astype(kind)
        columns[name] = typed if np.dtype(kind).kind == "f" or np.array_equal(typed, values) else values
    return columns


def _count(word: str, what: str) -> int:
    if not word.isdecimal():
        raise ValueError(f"says {word!r} where {what} must be a whole number of at least 0")
    return int(word)


def _unique(names: list[str]) -> list[str]:
    seen: dict[str, int] = {}
    out = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name}#{seen[name]}")
    return out


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _length(columns: Columns) -> int:
    return len(next(iter(columns.values())))
