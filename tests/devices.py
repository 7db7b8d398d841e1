"""Run by `test_devices` in processes of their own: fits on several devices, compared with one.

python tests/devices.py alone 4 [more]           four devices in this process
python tests/devices.py together PORT NUMBER     one of two processes with a device each
"""

import os
import sys

MODE = sys.argv[1]
HERE = int(sys.argv[2]) if MODE == "alone" else 1
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={HERE}"
os.environ["JAX_PLATFORMS"] = "cpu"

import jax  # noqa: E402

if MODE == "together":
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"127.0.0.1:{sys.argv[2]}", num_processes=2, process_id=int(sys.argv[3]))
jax.config.update("jax_enable_x64", True)
if "JAX_COMPILATION_CACHE_DIR" in os.environ:
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

import numpy as np  # noqa: E402
from jax.sharding import Mesh, NamedSharding, PartitionSpec  # noqa: E402

import jaxfuzzy as jf  # noqa: E402

N = 1003 if MODE == "alone" else 1004  # what comes as one global array must divide evenly
DEVICES = Mesh(np.array(jax.devices()), ("points",))


def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    centers = rng.normal(size=(3, 3)) * 4
    return centers[rng.integers(0, 3, N)] + rng.normal(size=(N, 3))


def check(name: str, found: object, expected: object, fields: tuple[str, ...]) -> None:
    """Compares what every process can see."""
    for field in fields:
        one, other = np.asarray(getattr(found, field)), np.asarray(getattr(expected, field))
        # Both stand still to 1e-12 of the spread; sums in another order differ by rounding.
        np.testing.assert_allclose(
            one, other, rtol=1e-8, atol=1e-8 * np.abs(other).max(initial=0), err_msg=f"{name} {field}"
        )
    assert int(found.status) == int(expected.status), name
    print("same", name, flush=True)


def alone() -> None:
    """One process, several devices: chosen by the solver, or by where the array lies."""
    x, weights = points(), np.random.default_rng(1).random(N)
    tight = {"tol": 1e-12}
    one, many = jf.Solver(**tight), jf.Solver(**tight, mesh=DEVICES)
    shared = ("centers", "sizes", "objective")
    options = {"m": 1.8, "sizes": True, "noise_distance": 4.0, "weights": weights}
    whole = jf.fcm(x, x[:3], **options, solver=one)
    found = jf.fcm(x, x[:3], **options, solver=many)
    check("fcm", found, whole, (*shared, "memberships", "noise", "labels"))
    print("parts", len(found.memberships.sharding.device_set), flush=True)
    placed = jax.device_put(x[:1000], NamedSharding(jax.make_mesh((HERE,), ("anything",)), PartitionSpec("anything")))
    check("fcm where the array lies", jf.fcm(placed, x[:3], solver=one), jf.fcm(x[:1000], x[:3], solver=one), shared)
    start = np.random.default_rng(2).dirichlet(np.ones(2), N)
    settings = {"embedding": "4d", "noise_distance": 0.5, "weights": weights}
    lines = [jf.nfcv(x, start, **settings, solver=jf.Solver(10, 0.0, mesh=mesh)) for mesh in (None, DEVICES)]
    check("nfcv", lines[1], lines[0], ("centers", "normals", "objective", "memberships", "labels", "bounds"))
    if "more" not in sys.argv:
        return
    by_blocks = jf.fcm(jf.blocks(x, rows=400), x[:3], **options, memberships=False, solver=many)
    check("fcm over blocks", by_blocks, whole, shared)
    slopes = [jax.grad(lambda m, s=s: jf.fcm(x, x[:3], m=m, solver=s).centers.std())(1.8) for s in (one, many)]
    np.testing.assert_allclose(*slopes, rtol=1e-7)
    print("same gradient", flush=True)


def together() -> None:
    """Two processes that hold half of the points each."""
    x = points()
    half = x[:502] if jax.process_index() == 0 else x[502:]
    placed = jax.make_array_from_process_local_data(NamedSharding(DEVICES, PartitionSpec("points")), half)
    assert placed.shape == (N, 3)
    solver = jf.Solver(tol=1e-12)
    found = jf.fcm(placed, x[:3], memberships=False, solver=solver)
    check("fcm", found, jf.fcm(x, x[:3], memberships=False, solver=solver), ("centers", "objective"))
    broken = jax.make_array_from_process_local_data(NamedSharding(DEVICES, PartitionSpec("points")), half * np.nan)
    try:
        jf.fcm(broken, x[:3], memberships=False)
    except ValueError as error:
        print("refused:", error, flush=True)


if __name__ == "__main__":
    alone() if MODE == "alone" else together()
