"""Cost of a sweep against the number of points and of clusters: linear in both, with a plot.

    python benchmarks/scaling.py [--most 3e7]
    python benchmarks/scaling.py --memory [--most 3e7]      only peak memory and time at a tenth of it and at all of it

Float32, D = 3, m = 2 and m = 1.7; one sweep from two runs of different length, warm, in the processor's time (a sweep keeps to one
core), so that what else runs on the machine does not count. Peak memory is that of a process of its own,
less what it held after a first small fit; the points are counted in. They come as a JAX array or, with their copy, as NumPy's.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence

import numpy as np
from common import RESULTS, provenance, table, write

CODE = """
import json, re, sys, numpy as np, jax, jaxfuzzy as jf
# Of this program alone: the peak that getrusage gives is handed down by the process that started it.
peak = lambda: 1024 * int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])
n, k = int(sys.argv[1]), 8
small = np.zeros((1000, 3), np.float32); small[:, 0] = np.arange(1000)
jf.fcm(small, small[:k], memberships=False, solver=jf.Solver(2, 0.0)).centers.block_until_ready()
before = peak()
# Not by jax.random, which takes four times what it makes.
x = np.random.default_rng(0).standard_normal((n, 3), np.float32)
if sys.argv[2] == "jax":
    x = jax.numpy.array(x).block_until_ready()
jf.fcm(x, x[:k], memberships=False, solver=jf.Solver(5, 0.0)).centers.block_until_ready()
print(json.dumps((peak() - before) / (12 * n)))
"""
# The targets: peak over the points' own size, and time a point at the most points over that at a tenth of them.
LARGEST, STEEPEST = 4.0, 1.3


def peak(n: int, kind: str = "jax") -> float:
    return json.loads(subprocess.check_output([sys.executable, "-c", CODE, str(n), kind], text=True))


def memory_and_time(most: int) -> None:
    counts = (most // 10, most)
    seconds = sweeps(counts, 8, 2.0, 5)
    rows = {n: {"jax": peak(n), "numpy": peak(n, "numpy"), "sweep": seconds[n]} for n in counts}
    few, many = (rows[n]["sweep"] / n for n in counts)
    table(
        f"K = 8, m = 2, memberships=False (targets: peak {LARGEST:g}, time a point {STEEPEST:g} times)",
        ("N", "peak over the points' size", "the same, NumPy's array", "ms a sweep", "ns a sweep and point"),
        [(n, r["jax"], r["numpy"], 1e3 * r["sweep"], 1e9 * r["sweep"] / n) for n, r in rows.items()],
    )
    met = {"memory": rows[most]["jax"] <= LARGEST, "linear": many / few <= STEEPEST}
    print(f"time a point at {most} over that at {most // 10}: {many / few:.2f}; met: {met}")
    write(
        "memory",
        {"points": most, "times_own_size": rows[most]["jax"], "time_ratio": many / few, "met": met, "rows": rows},
    )


def sweeps(counts: Sequence[int], k: int, m: float, rounds: int) -> dict[int, float]:
    """Seconds a sweep for several numbers of points, in turns, least of some rounds."""
    import jax

    import jaxfuzzy as jf

    def run(x: jax.Array, steps: int) -> float:
        begin = time.process_time()
        jf.fcm(x, x[:k], m=m, memberships=False, solver=jf.Solver(steps, 0.0, None)).centers.block_until_ready()
        return time.process_time() - begin

    points = {n: jax.random.normal(jax.random.key(0), (n, 3), dtype=np.float32) for n in counts}
    lengths = {n: (2, 12) if n > 1e5 else (10, 110) for n in counts}
    seconds: dict[tuple[int, int], list[float]] = {(n, steps): [] for n in counts for steps in lengths[n]}
    for _ in range(1 + rounds):
        for n, steps in seconds:
            seconds[n, steps].append(run(points[n], steps))
    least = {at: min(took[1:]) for at, took in seconds.items()}  # the first one compiles
    return {n: (least[n, many] - least[n, few]) / (many - few) for n, (few, many) in lengths.items()}


def a_sweep(n: int, k: int, m: float) -> float:
    return sweeps((n,), k, m, 3 if n > 1e6 else 7)[n]


def draw(by_count: dict[int, dict[float, float]], by_clusters: dict[int, dict[float, float]]) -> None:
    """The plot: milliseconds a sweep against points and against clusters."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    for axes, rows, label in ((left, by_count, "points N, K = 8"), (right, by_clusters, "clusters K, N = 200,000")):
        xs = np.array(list(rows), float)
        for m, style in ((2.0, "o-"), (1.7, "s-")):
            axes.loglog(xs, [1e3 * r[m] for r in rows.values()], style, label=f"m = {m:g}")
        last = 1e3 * rows[max(rows)][2.0]
        axes.loglog(xs, last * xs / xs[-1], "k:", label="linear")
        axes.set(xlabel=label, ylabel="ms a sweep")
        axes.legend()
    right.set_xticks(list(by_clusters), list(map(str, by_clusters)))
    right.minorticks_off()
    RESULTS.mkdir(exist_ok=True)
    figure.savefig(RESULTS / "scaling.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=float, default=1e7, help="largest number of points")
    parser.add_argument(
        "--memory", action="store_true", help="peak memory and time alone, at the largest number and a tenth of it"
    )
    args = parser.parse_args()
    if args.memory:
        memory_and_time(int(args.most))
        return
    print(provenance())
    counts = [n for n in (10**3, 10**4, 10**5, 10**6, 3 * 10**6, 10**7, 3 * 10**7) if n <= args.most]
    clusters = (2, 4, 8, 16, 32, 64)
    by_count = {n: {m: a_sweep(n, 8, m) for m in (2.0, 1.7)} for n in counts}
    by_clusters = {k: {m: a_sweep(200_000, k, m) for m in (2.0, 1.7)} for k in clusters}
    memory = {n: peak(n) for n in counts if n >= 10**6}
    table(
        "Nanoseconds a sweep and point, K = 8",
        ("N", "m = 2", "m = 1.7", "peak memory over the points' own size"),
        [(n, 1e9 * r[2.0] / n, 1e9 * r[1.7] / n, memory.get(n, "")) for n, r in by_count.items()],
    )
    table(
        "Nanoseconds a sweep, point and cluster, N = 200,000",
        ("K", "m = 2", "m = 1.7"),
        [(k, 1e9 * r[2.0] / k / 2e5, 1e9 * r[1.7] / k / 2e5) for k, r in by_clusters.items()],
    )
    draw(by_count, by_clusters)
    write("scaling", {"by_count": by_count, "by_clusters": by_clusters, "memory": memory})


if __name__ == "__main__":
    main()
