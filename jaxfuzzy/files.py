"""Files at the door: reading with a clear error, writing all or nothing."""

import contextlib
import os
import tempfile
from pathlib import Path


def read_bytes(path: str | os.PathLike[str], what: str) -> bytes:
    """Everything in a file.

    Args:
        path: The file.
        what: What it should be, for the error text.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is a folder, empty, or may not be read.
    """
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


def write_atomic(path: str | os.PathLike[str], data: bytes) -> None:
    """Writes a file so that a reader sees the old one or the whole new one, never a part.

    Raises:
        ValueError: The folder does not exist or cannot be written.
    """
    path = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror}") from None
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
        raise ValueError(f"cannot write {path}: {error.strerror}") from None
