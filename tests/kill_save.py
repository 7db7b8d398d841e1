"""Killed in the middle of writing: run by `test_hardness` in a process of its own, which does not survive.

Prints what a reader finds after a kill before every single move, then saves a scene twice and dies during the second.
"""

import dataclasses
import os
import signal
import sys
from pathlib import Path

from jaxfuzzy.folder import staged, standing

NAMES = ("a", "b/c", "list")
replace = Path.replace


def kill_before(move: int) -> None:
    """Lets so many files be moved, then ends the process as the power switch would."""
    moved = []

    def maybe(self: Path, target: Path) -> Path:
        moved.append(self)
        if len(moved) == move + 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return replace(self, target)

    Path.replace = maybe  # type: ignore[method-assign]


def write(folder: Path, text: str, names: tuple[str, ...]) -> None:
    """Writes a small folder of results."""
    with staged(folder, lambda folder: NAMES, names) as stage:
        for name in names:
            (stage / name).parent.mkdir(exist_ok=True)
            (stage / name).write_text(text)


def found(folder: Path) -> str:
    """What stands in the folder: old, new, or a mixture of both."""
    return " ".join(standing(folder, name).read_text() if standing(folder, name).exists() else "-" for name in NAMES)


def main() -> None:
    folder = Path(sys.argv[1])
    for move in range(6):
        out = folder / f"small{move}"
        write(out, "old", NAMES[:2])
        child = os.fork()  # before JAX has started a thread
        if not child:
            kill_before(move)
            write(out, "new", NAMES)
            os._exit(0)
        killed = os.WIFSIGNALED(os.waitpid(child, 0)[1])
        first = found(out)
        write(out, "later", NAMES)
        print("killed" if killed else "done", "|", first, "|", found(out), flush=True)
    from jaxfuzzy import report
    from synthetic import make_scene

    scene = dataclasses.replace(make_scene(), settings={"run": 1})
    report.save(scene, folder / "scene", view=False)
    print("saved", flush=True)
    kill_before(int(sys.argv[2]))
    report.save(dataclasses.replace(scene, settings={"run": 2}), folder / "scene", view=False)


if __name__ == "__main__":
    main()
