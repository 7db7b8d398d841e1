"""Several devices and several processes give what one gives; the core compiles for accelerators."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfuzzy as jf

SCRIPT = Path(__file__).parent / "devices.py"


def start(*words):
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir}
    return subprocess.Popen(
        [sys.executable, SCRIPT, *map(str, words)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process):
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, out + err
    return out.splitlines()


@pytest.mark.parametrize(("devices", "more"), [(2, ()), pytest.param(4, ("more",), marks=pytest.mark.slow)])
def test_devices_of_one_process(devices, more):
    lines = ended(start("alone", devices, *more))
    expected = ["same fcm", f"parts {devices}", "same fcm where the array lies", "same nfcv"]
    assert lines == expected + (["same fcm over blocks", "same gradient"] if more else [])


def test_two_processes():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    both = [start("together", port, number) for number in range(2)]
    for out in [ended(process) for process in both]:
        lines = [line for line in out if not line.startswith("[Gloo]")]
        assert lines == ["same fcm", "refused: points must be finite, got non-finite rows"]


@pytest.mark.parametrize("platform", ["cuda", "tpu"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_core_compiles_for_accelerators(platform, dtype):
    # Lowering fails where a primitive has no rule for the platform: nothing in the core may be for processors alone.
    x = jax.ShapeDtypeStruct((64, 3), dtype)
    seeds = jax.ShapeDtypeStruct((3, 3), dtype)
    memberships = jax.ShapeDtypeStruct((64, 2), dtype)

    def clusters(x, seeds):
        return jf.fcm(x, seeds, m=1.7, sizes=True, noise_distance=1.0).centers

    def gradient(x, seeds):
        return jax.grad(lambda x: jf.fcm(x, seeds).centers.sum())(x)

    def varieties(x, memberships):
        return jf.nfcv(x, memberships, embedding=("4d", "6d"), noise_distance=0.1).normals

    for name, call, arguments in (
        ("fcm", clusters, (x, seeds)),
        ("gradient", gradient, (x, seeds)),
        ("nfcv", varieties, (x, memberships)),
    ):
        if platform == "tpu" and dtype == jnp.float64 and name != "fcm":
            continue
        exported = jax.export.export(jax.jit(call), platforms=[platform])(*arguments)
        assert exported.platforms == (platform,)


def test_one_device_is_no_mesh():
    from jax.sharding import Mesh

    from jaxfuzzy.tiles import Parts

    assert Parts.of(np.zeros((4, 3)), None) is None
    assert Parts.of(jnp.zeros((4, 3)), None) is None
    assert Parts.of(jnp.zeros((4, 3)), Mesh(np.array(jax.devices()[:1]), ("points",))) is None
