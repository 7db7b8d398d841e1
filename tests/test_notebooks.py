"""Every notebook runs from top to bottom as it stands, in a kernel of its own, wherever the package is installed."""

from pathlib import Path

import jax
import pytest

nbformat = pytest.importorskip("nbformat", reason="notebooks need the extra notebooks")
nbclient = pytest.importorskip("nbclient", reason="notebooks need the extra notebooks")

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def test_all_are_there():
    assert len(NOTEBOOKS) == 6


@pytest.mark.filterwarnings("ignore")  # of Jupyter's own packages
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs_from_top_to_bottom(path, tmp_path, monkeypatch):
    book = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in book.cells), "outputs are not kept"
    # What one has compiled another takes: the objects of 4 are as large as those of 2, whose search takes longest to compile.
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(jax.config.jax_compilation_cache_dir))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
    # Everything is compiled for one run, so optimising the code takes longer than it saves.
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    # In an empty folder: nothing beside the notebook is needed.
    client = nbclient.NotebookClient(
        book, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    figures = [out for cell in book.cells for out in cell.get("outputs", []) if "image/png" in out.get("data", {})]
    assert figures
    assert all(cell.execution_count for cell in book.cells if cell.cell_type == "code" and cell.source.strip())
