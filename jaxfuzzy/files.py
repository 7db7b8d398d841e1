"""Files at the door: reading with a clear error, writing all or nothing."""

import contextlib
import io
import math
import os
import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import IO

import numpy as np

# An archive that unpacks to this many times its own size holds hardly anything: measured data shrink by a factor of 2 to 20,
# with masks and labels beside them by up to 50. Below the small size it does no harm either way.
MOST_SHRUNK = 200
SMALL = 1 << 24
LONGEST_ERROR = 400


def read_bytes(path: str | os.PathLike[str], what: str) -> bytes:
    """Everything in a file.

    Args:
        path: The file.
        what: What it should be, for the error text.

    Raises:
        FileNotFoundError: There is no such file.
        TypeError: It is no path.
        ValueError: It is a folder, empty, or may not be read.
    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"{what} must be the path of a file, got {type(path).__name__}")
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{what} not found: {path}")
    if path.is_dir():
        raise ValueError(f"{what} must be a file, got the folder {path}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{what} cannot be read: {path} ({error.strerror})") from None
    if not data:
        raise ValueError(f"{what} is empty: {path}")
    return data


def one_line(error: Exception) -> str:
    """What an error says, on one line and no longer than a person reads, whatever the file put into it."""
    text = " ".join(str(error).split())
    return text if len(text) <= LONGEST_ERROR else text[: LONGEST_ERROR - 4] + " ..."


def read_arrays(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of an NPY file (named "points") or an NPZ file; nothing is unpickled.

    Raises:
        ValueError: It is damaged, cut short, holds Python objects, or unpacks to more than it can hold.
    """
    try:
        if not data.startswith(b"PK"):
            return {"points": _read_array(io.BytesIO(data), len(data))}
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            unpacked = sum(member.file_size for member in members)
            if unpacked > max(SMALL, MOST_SHRUNK * len(data)):
                raise ValueError(f"would unpack {len(data)} bytes to {unpacked}, which no measured data do")
            arrays = {}
            for member in members:
                if not member.filename.endswith(".npy"):
                    continue
                with archive.open(member) as file:
                    arrays[member.filename.removesuffix(".npy")] = _read_array(file, member.file_size)
            return arrays
    except (EOFError, OSError, MemoryError, KeyError, SyntaxError, TypeError, OverflowError, NotImplementedError,
            RuntimeError, UnicodeError, zipfile.BadZipFile, zlib.error) as error:  # fmt: skip
        # NumPy and zipfile have no error of their own for a damaged file.
        raise ValueError(f"is damaged, cut short or holds Python objects ({type(error).__name__})") from None


def _read_array(file: IO[bytes], size: int) -> np.ndarray:
    """One array, its promised size compared with what is there before anything is allocated."""
    try:
        version = np.lib.format.read_magic(file)
        reader = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = reader(file)
    except Exception:  # the header is parsed as Python's literals, whose parser has a dozen errors of its own
        raise ValueError("is damaged, cut short or no NPY file: its header is not as NumPy writes it") from None
    if dtype.hasobject:
        raise ValueError("holds Python objects, which are never loaded")
    count = math.prod(shape)
    if min(shape, default=0) < 0 or count * dtype.itemsize > size:
        raise ValueError(f"is damaged, cut short: {dtype} of shape {shape} is promised, {size} bytes are there")
    body = file.read(count * dtype.itemsize)
    if len(body) < count * dtype.itemsize:
        raise ValueError("is damaged, cut short")
    if dtype.itemsize == 0:
        raise ValueError(f"holds {dtype}, which is no number")
    return np.frombuffer(body, dtype).reshape(shape, order="F" if by_columns else "C")


def write_atomic(path: str | os.PathLike[str], data: bytes) -> None:
    """Writes a file so that a reader sees the old one or the whole new one, never a part.

    Raises:
        OSError: The folder does not exist or cannot be written.
    """
    path = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise OSError(f"cannot write {path}: {error.strerror}") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # mkstemp makes the file private; a result is as open as any other file
        os.replace(temporary, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise OSError(f"cannot write {path}: {error.strerror}") from None
