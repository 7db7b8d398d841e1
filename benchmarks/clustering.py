"""Fuzzy c-means beside its peers: a sweep, a fit, the choice of k, a gradient, the first call.

    python benchmarks/clustering.py [--fuzzy-c-means PYTHON] [--only NAME ...]

Peers run in processes of their own, from the same start with the same fuzzifier. fuzzy-c-means needs an old NumPy and so an
environment of its own: PYTHON is its interpreter; without it the row is left out and named. R's e1071 runs where Rscript is there.
"To tolerance" means: as many plain steps as it takes until no center moves by more than 1e-5 of the spread. That number is the same
for every correct implementation of plain alternation, so the peers take exactly those steps; we take what we need to the same
tolerance, and the objectives are compared on the same data in float64.
"""

import argparse
import ctypes
import json
import os
import shutil
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import plain_environment, provenance, seconds_of, table, timings, write

import jaxfuzzy as jf

HERE = Path(__file__).parent
R_CODE = """
suppressMessages(library(e1071)); a <- commandArgs(TRUE); x <- as.matrix(read.csv(a[1], header=FALSE))
v <- as.matrix(read.csv(a[2], header=FALSE)); few <- 3; many <- 13
f <- function(n) system.time(cmeans(x, v, iter.max=n, m=as.numeric(a[3]), control=list(reltol=0)))[["elapsed"]]
invisible(f(2)); r <- sort(replicate(5, (f(many) - f(few)) / (many - few))); cat(r[3], r[1], r[5])
"""


class Peers:
    """Runs tasks in the peers' own processes."""

    def __init__(self, other_python: str | None) -> None:
        self.folder = Path(tempfile.mkdtemp())
        self.pythons = {"scikit-fuzzy": sys.executable, "scikit-learn k-means": sys.executable}
        if other_python:
            self.pythons["fuzzy-c-means"] = other_python

    def run(self, peer: str, data: np.ndarray, seeds: np.ndarray, **task: object) -> dict[str, float]:
        np.save(self.folder / "data.npy", data)
        np.save(self.folder / "seeds.npy", seeds)
        task |= {"data": str(self.folder / "data.npy"), "seeds": str(self.folder / "seeds.npy")}
        done = subprocess.run(
            [self.pythons[peer], str(HERE / "peers.py"), peer],
            input=json.dumps(task),
            capture_output=True,
            text=True,
            env=plain_environment(),
            check=True,
        )
        return json.loads(done.stdout)

    def e1071(self, data: np.ndarray, seeds: np.ndarray, m: float) -> dict[str, float] | None:
        if not shutil.which("Rscript"):
            return None
        np.savetxt(self.folder / "data.csv", data, delimiter=",")
        np.savetxt(self.folder / "seeds.csv", seeds, delimiter=",")
        arguments = [str(self.folder / "data.csv"), str(self.folder / "seeds.csv"), str(m)]
        done = subprocess.run(["Rscript", "-e", R_CODE, *arguments], capture_output=True, text=True)
        if done.returncode:
            return None
        return dict(zip(("median", "min", "max"), map(float, done.stdout.split()), strict=True))


def every_core() -> jax.sharding.Mesh:
    """One device a processor, as `main` sets them up."""
    return jax.make_mesh((len(jax.devices()),), ("points",))


def ours_a_sweep(x: np.ndarray, seeds: np.ndarray, m: float, mesh: jax.sharding.Mesh | None = None) -> dict[str, float]:
    """Seconds a sweep, from two runs of different length, warm."""
    fit = lambda steps: jf.fcm(
        x, seeds, m=m, memberships=False, solver=jf.Solver(steps, 0.0, None, mesh=mesh)
    ).centers.block_until_ready()
    x, seeds = jnp.asarray(x), jnp.asarray(seeds)
    few, many = (partial(fit, steps) for steps in (10, 60))
    few(), many()  # compiled
    each = [(seconds_of(many) - seconds_of(few)) / 50 for _ in range(7)]
    return {"median": float(np.median(each)), "min": min(each), "max": max(each)}


def fused_c(x: np.ndarray, seeds: np.ndarray) -> dict[str, float] | None:
    """Seconds of the hand-written loop, one thread; None without a compiler."""
    if not shutil.which("gcc"):
        return None
    library = Path(tempfile.mkdtemp()) / "sweep.so"
    subprocess.run(
        ["gcc", "-O3", "-march=native", "-ffast-math", "-shared", "-fPIC", str(HERE / "sweep.c"), "-o", str(library)],
        check=True,
    )
    run = ctypes.CDLL(str(library)).sweep
    planes, v, sums = np.ascontiguousarray(x.T), np.ascontiguousarray(seeds), np.zeros((8, 4))
    as_pointer = lambda a: a.ctypes.data_as(ctypes.c_void_p)
    call = lambda: run(as_pointer(planes), as_pointer(v), ctypes.c_long(len(x)), as_pointer(sums))
    measured = timings(call, 21)
    one = jf.fcm(x, seeds, memberships=False, solver=jf.Solver(1, 0.0, None))
    # The loop leaves out the last few points of a block; the centers must still be the same to four digits.
    np.testing.assert_allclose(sums[:, :3] / sums[:, 3:], one.centers, atol=2e-4)
    return measured


def sweep(peers: Peers) -> dict[str, object]:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(200_000, 3)).astype(np.float32)
    seeds = x[:8].copy()
    rows = {
        "jaxfuzzy, m = 2": ours_a_sweep(x, seeds, 2.0),
        "jaxfuzzy, m = 1.7": ours_a_sweep(x, seeds, 1.7),
        "jaxfuzzy, m = 2, mesh of all cores": ours_a_sweep(x, seeds, 2.0, every_core()),
    }
    for peer in peers.pythons:
        rows[peer] = peers.run(peer, x, seeds, what="sweep", m=2.0)
    for name, found in (("R e1071", peers.e1071(x, seeds, 2.0)), ("fused C, one thread", fused_c(x, seeds))):
        if found is not None:
            rows[name] = found
    ours = rows["jaxfuzzy, m = 2"]["median"]
    table(
        "One sweep, 200,000 x 3, K = 8, float32, warm",
        ("", "ms", "of ours", "fastest", "slowest"),
        [(n, 1e3 * r["median"], r["median"] / ours, 1e3 * r["min"], 1e3 * r["max"]) for n, r in rows.items()],
    )
    return rows


def overlapping(count: int, clusters: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(clusters, 3)) * 2
    x = np.concatenate([c + 1.5 * rng.normal(size=(count // clusters, 3)) for c in centers])
    return x, x[rng.choice(len(x), clusters, replace=False)]


def fit(peers: Peers) -> dict[str, object]:
    x, seeds = overlapping(60_000, 6, 1)
    results, starts = {}, 20
    for dtype in (np.float32, np.float64):
        with jax.enable_x64(dtype == np.float64):
            data, start = jnp.asarray(x, dtype), jnp.asarray(seeds, dtype)
            run = lambda s, data=data, start=start: jf.fcm(data, start, memberships=False, solver=s)
            fast, plain = jf.Solver(tol=1e-5), jf.Solver(5000, 1e-5, None)
            name = np.dtype(dtype).name
            spread = jf.Solver(tol=1e-5, mesh=every_core())
            for label, solver in (("accelerated", fast), ("plain", plain), ("accelerated, mesh of all cores", spread)):
                found = run(solver)
                seconds = timings(lambda run=run, solver=solver: run(solver).centers.block_until_ready(), 5)
                results[f"jaxfuzzy {name}, {label}"] = {
                    "seconds": seconds["median"],
                    "steps": int(found.steps),
                    "sweeps": int(found.steps) if solver.acceleration is None else 2 * int(found.steps) - 1,
                    "centers": np.asarray(found.centers, float),
                }
    needed = results["jaxfuzzy float64, plain"]["steps"]
    for peer in peers.pythons:
        if "k-means" not in peer:
            found = peers.run(peer, x, seeds, what="fit", m=2.0, steps=needed)
            results[peer] = found | {"sweeps": needed}
    from peers import objective

    for result in results.values():
        if "centers" in result:
            result["objective"] = objective(x, result.pop("centers"), 2.0)
    ours = results["jaxfuzzy float32, accelerated"]
    lowest = min(result["objective"] for result in results.values())
    table(
        "To tolerance 1e-5 on overlapping clusters, 60,000 x 3, K = 6, m = 2",
        ("", "ms", "of ours", "steps", "sweeps", "objective above the lowest, relative"),
        [
            (
                n,
                1e3 * r["seconds"],
                r["seconds"] / ours["seconds"],
                r["steps"],
                r["sweeps"],
                r["objective"] / lowest - 1,
            )
            for n, r in results.items()
        ],
    )
    # The guard bounds every step, not the basin: starts whose accelerated end is higher than the plain one's are counted.
    higher = 0
    with jax.enable_x64(True):
        for trial in range(starts):
            data, start = overlapping(6_000, 6, 100 + trial)
            ends = [
                float(jf.fcm(data, start, memberships=False, solver=jf.Solver(5000, 1e-8, how)).objective)
                for how in ("anderson", None)
            ]
            higher += ends[0] > ends[1] * (1 + 1e-9)
    print(f"\nOf {starts} random starts the accelerated fit ended higher than the plain one in {higher}.")
    return results | {"starts": starts, "accelerated ended higher": higher}


def choose(peers: Peers) -> dict[str, object]:
    x, _ = overlapping(20_000, 5, 2)
    x = x.astype(np.float32)
    ks = tuple(range(2, 11))
    ours = timings(lambda: jf.choose_k(x, ks, solver=jf.Solver(tol=1e-5)).scores.block_until_ready(), 3)
    seconds = 0.0
    for k in ks:
        seeds = np.asarray(jf.histogram_seeds(x, k).centers)
        steps = int(jf.fcm(x, seeds, memberships=False, solver=jf.Solver(5000, 1e-5, None)).steps)
        seconds += peers.run("scikit-fuzzy", x, seeds, what="fit", m=2.0, steps=steps)["seconds"]
    table(
        "Choice of k over 2...10, 20,000 x 3, variance ratio included in ours",
        ("", "ms", "of ours"),
        [("jaxfuzzy", 1e3 * ours["median"], 1.0), ("loop over scikit-fuzzy", 1e3 * seconds, seconds / ours["median"])],
    )
    return {"jaxfuzzy": ours, "scikit-fuzzy": seconds}


def gradient(peers: Peers) -> dict[str, object]:
    del peers
    x, seeds = overlapping(60_000, 6, 1)
    x, seeds = jnp.asarray(x, jnp.float32), jnp.asarray(seeds, jnp.float32)
    rows = {}
    for steps in (10, 20, 40, 80):
        solver = jf.Solver(steps, 0.0)

        def loss(m: jax.Array, noise: jax.Array, solver: jf.Solver = solver) -> jax.Array:
            return jnp.square(
                jf.fcm(x, seeds, m=m, noise_distance=noise, memberships=False, solver=solver).centers
            ).sum()

        at = (jnp.float32(2.0), jnp.float32(4.0))
        whole, derived = jax.jit(loss), jax.jit(jax.value_and_grad(loss, (0, 1)))
        memory = [f.lower(*at).compile().memory_analysis().temp_size_in_bytes for f in (whole, derived)]
        alone = timings(lambda whole=whole, at=at: whole(*at).block_until_ready(), 5)
        both = timings(lambda derived=derived, at=at: jax.block_until_ready(derived(*at)), 5)
        rows[steps] = {"fit": alone["median"], "fit and gradient": both["median"], "bytes": memory}
    table(
        "A fit with its gradient in (m, noise distance), 60,000 x 3, K = 6, float32",
        ("steps", "fit ms", "with gradient ms", "ratio", "working memory of the fit, MB", "with gradient, MB"),
        [
            (
                n,
                1e3 * r["fit"],
                1e3 * r["fit and gradient"],
                r["fit and gradient"] / r["fit"],
                *(b / 1e6 for b in r["bytes"]),
            )
            for n, r in rows.items()
        ],
    )
    return {str(steps): row for steps, row in rows.items()}


def first(peers: Peers) -> dict[str, object]:
    del peers
    code = (
        "import time; t = time.perf_counter(); import numpy as np, jaxfuzzy as jf;"
        "x = np.random.default_rng(0).normal(size=(20000, 3)).astype('f'); jf.fcm(x, x[:4]).centers.block_until_ready();"
        "print(time.perf_counter() - t)"
    )
    rows = {}
    with tempfile.TemporaryDirectory() as cache:
        kept = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        for name, extra in (("no cache", {}), ("filling the cache", kept), ("from the cache", kept)):
            times = [
                float(
                    subprocess.run(
                        [sys.executable, "-c", code], env=os.environ | extra, capture_output=True, text=True
                    ).stdout
                )
                for _ in range(1 if "filling" in name else 3)
            ]
            rows[name] = {"median": float(np.median(times)), "min": min(times), "max": max(times)}
    table(
        "First call in a fresh process, imports and compilation included, seconds",
        ("", "median", "fastest", "slowest"),
        [(n, r["median"], r["min"], r["max"]) for n, r in rows.items()],
    )
    return rows


PARTS = {"sweep": sweep, "fit": fit, "choose": choose, "gradient": gradient, "first": first}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--fuzzy-c-means", metavar="PYTHON", help="interpreter of an environment with fuzzy-c-means 2.3"
    )
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    args = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", os.cpu_count())
    print(provenance())
    peers = Peers(args.fuzzy_c_means)
    if not args.fuzzy_c_means:
        print("fuzzy-c-means is left out: no --fuzzy-c-means PYTHON was given")
    results = {name: PARTS[name](peers) for name in args.only}
    if set(args.only) == set(PARTS):
        write("clustering", results)


if __name__ == "__main__":
    main()
