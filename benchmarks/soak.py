"""A thousand scenes in one process: does memory stay flat, does compiling end, how many scenes a second?

    python benchmarks/soak.py [--scenes 1000] [--batches]

Every scene is simulated anew, one to three objects of 150 to 500 points each, every other one with a table under them, no two with
the same number of points; it goes through `model_cloud`, and a sample of it through `fcm`. Counted are the programs that XLA is
asked for, those of the compilation cache included, and the resident memory of the process after each scene. `--batches` gives the
throughput of many objects in one call instead: `fit_shapes`, and `fcm` under `vmap`.
"""

import argparse
import gc
import json
import re
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from common import table, timings, write

# Fewer than the smallest scene has: a sample of another size would be another program.
SAMPLE = 128


def scene(seed: int) -> np.ndarray:
    """Points (N, 3) of a simulated scene, y up."""
    from jaxfuzzy.simulate import simulate_scene

    rng = np.random.default_rng(seed)
    made = simulate_scene(1 + seed % 3, seed, points=(150, 500))
    points = np.asarray(made.points, np.float32)
    if seed % 2:
        bottom = points[np.asarray(made.labels) >= 0, 1].min()
        flat = rng.uniform(-0.5, 0.5, size=(int(rng.integers(600, 1000)), 2))
        heights = bottom + rng.normal(size=len(flat)) * 1e-3
        points = np.concatenate([points, np.stack([flat[:, 0], heights, flat[:, 1] + 1.2], axis=1)])
    return points.astype(np.float32)


def resident() -> float:
    """Resident memory of this process, MiB."""
    return int(re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())[1]) / 1024


def soak(scenes: int) -> dict[str, list[float]]:
    """Programs compiled so far, resident memory and seconds, after each scene."""
    import jax

    import jaxfuzzy as jf

    compiled = 0

    def count(event: str, seconds: float, **_: object) -> None:
        nonlocal compiled
        compiled += event == "/jax/core/compile/backend_compile_duration"

    jax.monitoring.register_event_duration_secs_listener(count)
    told: dict[str, list[float]] = {"programs": [], "memory": [], "seconds": [], "points": []}
    for seed in range(scenes):
        points = scene(seed)
        begin = time.perf_counter()
        options = {} if seed % 2 else {"ground": None, "up": (0.0, 1.0, 0.0)}
        jf.model_cloud(jf.Cloud(points), **options)
        sample = points[np.random.default_rng(seed).permutation(len(points))[:SAMPLE]]
        jf.fcm(sample, sample[:3], m=1.5 + 0.001 * seed, noise_distance=0.1).centers.block_until_ready()
        told["seconds"].append(time.perf_counter() - begin)
        gc.collect()
        told["programs"].append(compiled)
        told["memory"].append(resident())
        told["points"].append(len(points))
        if (seed + 1) % 50 == 0:
            print(f"{seed + 1} scenes, {compiled} programs, {told['memory'][-1]:.0f} MiB", flush=True)
    return told


def batches() -> None:
    """Objects a second where many come in one call."""
    import jax

    import jaxfuzzy as jf
    from jaxfuzzy.simulate import KINDS, simulate_object

    def seconds(call: Callable[[], object]) -> float:
        return timings(call, 3)["median"]

    rows = []
    for count in (1, 24, 96):
        made = [simulate_object(KINDS[i % len(KINDS)], i, points=(200, 500)) for i in range(count)]
        points = np.concatenate([one.points for one in made]).astype(np.float32)
        labels = np.concatenate([np.full(len(one.points), i) for i, one in enumerate(made)])
        rows.append(("fit_shapes", count, seconds(partial(jf.fit_shapes, points, labels, camera=made[0].camera))))
    clouds = np.random.default_rng(0).normal(size=(1000, 300, 3)).astype(np.float32)
    one = lambda x: jf.fcm(x, x[:3], memberships=False).centers
    for name, every in (("vmap", jax.vmap(one)), ("lax.map", lambda xs: jax.lax.map(one, xs))):
        fit = jax.jit(every)
        for count in (1, 100, 1000):
            some = jax.device_put(clouds[:count])
            call = lambda fit=fit, some=some: fit(some).block_until_ready()
            rows.append((f"fcm under {name}, 300 points, K = 3", count, seconds(call)))
    table(
        "Many in one call",
        ("call", "objects", "seconds", "objects a second"),
        [(*row, row[1] / row[2]) for row in rows],
    )
    write("batches", {"rows": rows})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--batches", action="store_true", help="throughput of many in one call alone")
    parser.add_argument("--out", type=Path, help="where to write the result, in place of benchmarks/results")
    args = parser.parse_args()
    if args.batches:
        batches()
        return
    told = soak(args.scenes)
    programs, memory, half = np.array(told["programs"]), np.array(told["memory"]), args.scenes // 2
    marks = sorted({max(1, round(share * args.scenes)) for share in (0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)})
    rows = [(n, int(programs[n - 1]), float(memory[n - 1])) for n in marks]
    late = told["seconds"][half:]
    result = {
        "scenes": args.scenes,
        "numbers_of_points": len(set(told["points"])),
        "scenes_a_second": len(late) / sum(late),
        "last_compiled": int(np.argmax(programs)) + 1,
        "late_programs": int(programs[-1] - programs[half - 1]),
        "late_growth_mib": float(memory[-1] - memory[half - 1]),
        "rows": rows,
    }
    table("After so many scenes", ("scenes", "programs compiled", "resident MiB"), rows)
    print({name: value for name, value in result.items() if name != "rows"})
    if args.out is not None:
        args.out.write_text(json.dumps(result))
    else:
        write("soak", result)


if __name__ == "__main__":
    main()
