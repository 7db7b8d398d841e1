"""Many scenes in one process: compiling comes to an end and memory with it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest

SOAK = Path(__file__).parents[1] / "benchmarks" / "soak.py"
SCENES = 80


@pytest.mark.slow
def test_compiling_and_memory_come_to_an_end(tmp_path):
    out = tmp_path / "soak.json"
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir)}
    subprocess.run(
        [sys.executable, SOAK, "--scenes", str(SCENES), "--out", out], env=environment, timeout=900, check=True
    )
    told = json.loads(out.read_text())
    # Nearly every scene has its own number of points: one program for each number would be 40 in the second half. What is left are
    # sizes of batches and kinds of shapes met for the first time, of which there are a few dozen in all.
    assert told["numbers_of_points"] > 0.9 * SCENES
    assert told["late_programs"] <= 8
    # A program for each number of points took 24 MiB a scene, 960 in the second half. What rare programs and the allocator's own
    # slack take is below 2 MiB a scene.
    assert told["late_growth_mib"] < 80
