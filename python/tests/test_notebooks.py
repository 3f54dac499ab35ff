"""Runs each notebook from top to bottom in a folder that stands for a clone: in its `python/notebooks`, and in its
root."""

import nbformat
import pytest
from conftest import SHIPPED, beside
from nbclient import NotebookClient

NOTEBOOKS = sorted(beside("notebooks").glob("*.ipynb"))
ONNX = beside("tests/fixtures/onnx")


def test_there_is_a_notebook_for_each_use():
    assert [path.stem for path in NOTEBOOKS] == [
        "import-an-onnx-policy",
        "read-recordings-and-sessions",
        "run-on-the-emulated-qube",
        "simulate-and-train",
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
# The libraries of the kernel raise warnings of their own.
@pytest.mark.filterwarnings("default")
def test_every_notebook_runs(path, tmp_path):
    (tmp_path / "policies").symlink_to(SHIPPED)
    (tmp_path / "tests" / "fixtures").mkdir(parents=True)
    (tmp_path / "tests" / "fixtures" / "onnx").symlink_to(ONNX)
    own = tmp_path / "python" / "notebooks"
    own.mkdir(parents=True)
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    for folder in [own, tmp_path]:
        NotebookClient(
            notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
        ).execute()
