"""A folder of results, written all or nothing: as it was, or with every new file in its place.

A run that is killed while it moves files leaves a journal beside the old ones: until the last move the old files count, `standing`
finds them for readers, and the next run puts them back before it begins.
"""

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path, PurePosixPath

from jaxfuzzy.files import write_atomic

PREFIX = ".jaxfuzzy-"
JOURNAL = "journal"


@contextlib.contextmanager
def staged(
    folder: str | os.PathLike[str],
    earlier: Callable[[Path], Collection[str]],
    names: Collection[str],
    *,
    keep: bool = True,
) -> Iterator[Path]:
    """A temporary folder whose files take their place in `folder` when the block ends well, and vanish when not.

    Args:
        folder: Where to; made if it does not exist, its parents too.
        earlier: Names, relative to the folder, of the files in it that may be replaced or removed.
        names: Names that may be written; looked at before the block, so that a long computation is not in vain.
        keep: False throws everything away even when all is well.

    Raises:
        OSError: The folder cannot be written, or holds a file of the same name that may not be replaced.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"out must be a folder, got the file {folder}")
    _undo(folder)
    replaceable = tuple(name for name in earlier(folder) if not _leaves(name))
    _refuse_foreign(folder, replaceable, names)
    # Beside the folder, or inside where it exists: renaming then stays on one disk, and a mounted folder works too.
    base = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    stage = None
    try:
        stage = Path(tempfile.mkdtemp(dir=base, prefix=PREFIX))
        yield stage
        if keep and folder.exists():
            _refuse_foreign(folder, replaceable, files_in(stage))
            _swap(stage, folder, replaceable)
        elif keep:
            umask = os.umask(0)
            os.umask(umask)
            stage.chmod(0o777 & ~umask)  # mkdtemp makes it private; a result is as open as any other folder
            folder.parent.mkdir(parents=True, exist_ok=True)
            stage.rename(folder)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(f"cannot write to {folder}: {error.strerror}") from None
    finally:
        if stage is not None:
            shutil.rmtree(stage, ignore_errors=True)


def standing(folder: Path, name: str) -> Path:
    """Where a file of the folder is that counts: among those put aside where a run was killed before its last move."""
    return next((aside / name for aside in _interrupted(folder) if (aside / name).is_file()), folder / name)


def files_in(folder: Path) -> list[str]:
    """All files in a folder and its subfolders, relative to it."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def _refuse_foreign(folder: Path, replaceable: Collection[str], names: Collection[str]) -> None:
    if foreign := [name for name in names if name not in replaceable and (folder / name).exists()]:
        raise FileExistsError(
            f"folder {folder} holds {', '.join(foreign)}, which no earlier run wrote: choose another folder"
        )


def _leaves(name: str) -> bool:
    path = PurePosixPath(name)
    return path.is_absolute() or ".." in path.parts


def _swap(stage: Path, folder: Path, replaceable: Collection[str]) -> None:
    """Moves what may be replaced out of the folder and the new files in; all of it or nothing."""
    retired = Path(tempfile.mkdtemp(dir=folder, prefix=PREFIX))
    old, new = [name for name in replaceable if (folder / name).is_file()], files_in(stage)
    moves = [(folder / name, retired / name) for name in old] + [(stage / name, folder / name) for name in new]
    begun = []
    try:
        write_atomic(retired / JOURNAL, json.dumps({"old": old, "new": new, "stage": stage.name}).encode())
        for source, target in moves:
            target.parent.mkdir(parents=True, exist_ok=True)
            begun.append((source, target))
            source.replace(target)
        (retired / JOURNAL).unlink()  # from here on the new files count
    except BaseException:
        for source, target in reversed(begun):
            if target.exists() and not source.exists():
                target.replace(source)
        raise
    finally:
        shutil.rmtree(retired, ignore_errors=True)
        for parent in {(folder / name).parent for name in replaceable} - {folder}:
            with contextlib.suppress(OSError):
                parent.rmdir()  # goes only where it is empty


def _interrupted(folder: Path) -> list[Path]:
    """What runs that were killed while they moved files had put aside."""
    return [path.parent for path in folder.glob(f"{PREFIX}*/{JOURNAL}") if path.is_file()]


def _undo(folder: Path) -> None:
    """Puts back what a killed run had moved; may itself be killed and begun again."""
    for aside in _interrupted(folder):
        try:
            tree = json.loads((aside / JOURNAL).read_bytes())
            old, new = ([name for name in tree[of] if not _leaves(name)] for of in ("old", "new"))
            stage = folder / PurePosixPath(tree["stage"]).name
        except (ValueError, TypeError, KeyError):
            continue  # not a journal of ours
        for name in set(new) - set(old):
            (folder / name).unlink(missing_ok=True)
        for name in old:
            if (aside / name).is_file():
                (aside / name).replace(folder / name)
        shutil.rmtree(aside, ignore_errors=True)
        if stage.name.startswith(PREFIX):
            shutil.rmtree(stage, ignore_errors=True)
