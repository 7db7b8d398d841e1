import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", os.environ.get("JAX_COMPILATION_CACHE_DIR", "/tmp/jaxfuzzy-test-cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data():
    """The folder of real stereo pairs and clouds that may not ship with the project."""
    if not DATA.is_dir():
        pytest.skip(f"real data not found at {DATA}")
    return DATA


@pytest.fixture(autouse=True, scope="module")
def _few_programs():
    """Compiled programs hold memory maps, of which Linux grants a process 65,530; XLA crashes beyond them."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="module")
def compiled_for_one_run():
    """For small data and many programs: optimising the code takes longer than it saves."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With `--dist loadfile` a file stays in one process, but for notebooks: each has a process of its own anyway."""
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return nodeid if "test_notebooks" in nodeid else super()._split_scope(nodeid)

    return ByFile(config, log) if config.getoption("dist") == "loadfile" else None
