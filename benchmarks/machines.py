"""Cost of a sweep over several processes: what is computed, what travels, and a model of both up to 1e9 points on 64 hosts.

    python benchmarks/machines.py [--points 2000000]

One process and two local ones (`jax.distributed`, gloo) fit the same points, float32, D = 3, K = 8, m = 2; the all-reduce of a
sweep's sums is timed alone as well. The model: time = points a host x seconds a point + all-reduce (the next sweep waits for the
sums), all-reduce = 2 log2(hosts) x latency of a message, since the sums are a few hundred bytes however many points there are.

The two processes share one machine: its caches, its memory and the clock of its cores, which no two hosts do. So the model is
checked with the seconds a point of two processes side by side that know nothing of each other, with half of the points each.
"""

import argparse
import json
import math
import socket
import subprocess
import sys

from common import table, write

K, D = 8, 3
# What travels in a sweep: for each cluster its moments, mass and unused squared length, 4-byte floats.
MESSAGE = 4 * K * (D + 2)
# The check: measured over predicted.
ALLOWED = 1.5

CODE = """
import json, sys, time
each, processes, number, port = map(int, sys.argv[1:5])
import jax
if processes > 1:
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=processes, process_id=number)
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
import jaxfuzzy as jf
mesh = Mesh(np.array(jax.devices()), ("points",))
x = np.random.default_rng(number).normal(size=(each, 3)).astype(np.float32)
seeds = np.random.default_rng(9).normal(size=(8, 3)).astype(np.float32)
if processes > 1:
    x = jax.make_array_from_process_local_data(NamedSharding(mesh, P("points")), x)
else:
    x = jax.numpy.asarray(x)
def fit(steps):
    jf.fcm(x, seeds, memberships=False, solver=jf.Solver(steps, 0.0, None)).centers.block_until_ready()
def seconds(*calls):
    # In turns, and the least of some rounds: what else runs on the machine only adds.
    times = [[] for _ in calls]
    for _ in range(10):
        for call, took in zip(calls, times):
            begin = time.perf_counter(); call(); took.append(time.perf_counter() - begin)
    return [min(took[1:]) for took in times]
few, many = seconds(lambda: fit(2), lambda: fit(32))
sweep = (many - few) / 30
message = 0.0
if processes > 1:
    rounds = 500
    def many(value):
        return lax.fori_loop(0, rounds, lambda i, v: lax.psum(v, "points") * 0.5, value)
    reduce = jax.jit(jax.shard_map(many, mesh=mesh, in_specs=P(), out_specs=P(), check_vma=False))
    value = np.ones(MESSAGE // 4, np.float32)
    message = seconds(lambda: reduce(value).block_until_ready())[0] / rounds
print(json.dumps({"sweep": sweep, "all_reduce": message}))
""".replace("MESSAGE", str(MESSAGE))


def measured(each: int, processes: int, *, joined: bool = True) -> dict[str, float]:
    """Seconds of the slowest of some processes with so many points each, which work on one fit or side by side."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    running = [
        subprocess.Popen(
            [sys.executable, "-c", CODE, *map(str, (each, processes if joined else 1, number, port))],
            stdout=subprocess.PIPE,
            text=True,
        )
        for number in range(processes)
    ]
    told = [json.loads(process.communicate()[0].splitlines()[-1]) for process in running]
    return {name: max(one[name] for one in told) for name in told[0]}


def modelled(points: float, hosts: int, point: float, message: float) -> tuple[float, float]:
    """Seconds of computing and of all-reduce a sweep."""
    return points / hosts * point, 2 * math.log2(hosts) * message if hosts > 1 else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=2_000_000)
    args = parser.parse_args()
    half = args.points // 2
    one, alone = measured(args.points, 1), measured(half, 1)
    apart, two = measured(half, 2, joined=False), measured(half, 2)
    point, latency = one["sweep"] / args.points, two["all_reduce"] / 2
    model = sum(modelled(args.points, 2, apart["sweep"] / half, latency))
    ratio = two["sweep"] / model
    table(
        f"Milliseconds a sweep, {args.points} points, K = 8",
        ("what", "ms"),
        [
            ("one process", 1e3 * one["sweep"]),
            ("one process, half of the points", 1e3 * alone["sweep"]),
            ("two side by side, half of the points each", 1e3 * apart["sweep"]),
            (f"all-reduce of {MESSAGE} bytes", 1e3 * two["all_reduce"]),
            ("two processes, by the model", 1e3 * model),
            ("two processes", 1e3 * two["sweep"]),
        ],
    )
    print(f"measured over predicted: {ratio:.2f} (at most {ALLOWED}, at least {1 / ALLOWED:.2f} allowed)")
    rows = []
    for points in (1e6, 1e7, 1e8, 1e9):
        for hosts in (1, 8, 64):
            compute, reduce = modelled(points, hosts, point, latency)
            rows.append((f"{points:g}", hosts, 1e3 * compute, 1e3 * reduce, 1e3 * (compute + reduce)))
    table("By the model, one such core a host", ("points", "hosts", "compute ms", "all-reduce ms", "sweep ms"), rows)
    runs = {"one": one, "half": alone, "apart": apart, "two": two}
    write("machines", {"points": args.points, **runs, "model_two": model, "ratio": ratio, "rows": rows})


if __name__ == "__main__":
    main()
