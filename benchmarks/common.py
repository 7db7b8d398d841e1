"""What every benchmark needs: where it ran, how long things take, a table on the screen and the same as JSON."""

import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("jaxfuzzy", "jax", "optimistix", "numpy", "opencv-python-headless", "scikit-learn", "scikit-fuzzy")
# Settings that slow NumPy's matrix products on some machines; peers run without them.
SLOWING = ("OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE")


def provenance() -> dict[str, Any]:
    """Machine, commit and versions of a run."""
    git = lambda *words: subprocess.run(
        ["git", *words], capture_output=True, text=True, cwd=RESULTS.parent
    ).stdout.strip()
    # What was measured is the code: results of earlier runs may wait to be committed.
    changed = git("status", "--porcelain", "--untracked-files=no", "--", ":/", f":(exclude){RESULTS}")
    cpu = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
        platform.processor(),
    )
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "commit": (git("rev-parse", "--short", "HEAD") or "unknown") + ("-dirty" if changed else ""),
        "date": time.strftime("%Y-%m-%d"),
        "machine": f"{cpu}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": versions,
    }


def seconds_of(call: Callable[[], Any]) -> float:
    """Seconds of one call."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def timings(call: Callable[[], Any], repeats: int = 7) -> dict[str, float]:
    """Seconds of a call: median, fastest and slowest of some repeats after one that does not count."""
    call()
    seconds = [seconds_of(call) for _ in range(repeats)]
    return {"median": float(np.median(seconds)), "min": min(seconds), "max": max(seconds)}


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Prints a table in Markdown."""
    cells = [[f"{c:.4g}" if isinstance(c, float) else str(c) for c in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(head, *cells, strict=True)]
    print(f"\n{title}\n")
    for row in (list(head), ["-" * w for w in widths], *cells):
        print("| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |", flush=True)


def write(name: str, result: dict[str, Any]) -> Path:
    """Writes a result with its provenance to benchmarks/results/NAME.json."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(provenance() | result, indent=1) + "\n")
    print(f"\nwrote {path}")
    return path


def plain_environment() -> dict[str, str]:
    """The environment for a peer's process."""
    return {name: value for name, value in os.environ.items() if name not in SLOWING}
