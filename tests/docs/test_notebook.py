"""The notebook in examples/ runs from top to bottom with few steps, but for what it installs."""

import os
import sys

import nbformat
from nbclient import NotebookClient
from support.scripts import ROOT


def test_first_steps(tmp_path, monkeypatch):
    """It trains, and shows a curve and a video; in the repository it has no outputs."""
    few = "--num_envs 2 --max_iterations 2 --set evaluation.at_end=false --device cpu"
    notebook = nbformat.read(ROOT / "examples" / "first_steps.ipynb", as_version=4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
    tagged = {tag: cell for cell in notebook.cells for tag in cell.metadata.get("tags", ())}
    tagged["install"].source, tagged["options"].source = "", f"TRAINING, VIDEO = '{few}', '--num_envs 1 --steps 2'"
    monkeypatch.setenv("PATH", os.path.dirname(sys.executable), prepend=os.pathsep)
    NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}}).execute()
    curve, video = (cell.outputs[-1].data for cell in notebook.cells[-3::2])
    assert "image/png" in curve and "<video" in video["text/html"] and (tmp_path / "walk.mp4").is_file()
