"""The notebook in examples/ runs from top to bottom with few steps, but for what it installs."""

import os
import shlex
import sys

import matplotlib.pyplot as plt
import nbformat
from IPython.core.interactiveshell import InteractiveShell
from support.scripts import ROOT, run_here


class Shell(InteractiveShell):
    """Cells run in this process, and so do trainings; a video needs a process that renders."""

    def system(self, line):
        """Run a line that begins with an exclamation mark."""
        _, command, script, *words = shlex.split(self.var_expand(line))
        assert command == "legged-torque"
        if script == "train":
            assert run_here("train.py", *words, root=".")[0] == 0
        else:
            self.system_raw(line)


def test_first_steps(tmp_path, monkeypatch):
    """It trains, and shows a curve and a video; in the repository it has no outputs."""
    few = "--num_envs 2 --max_iterations 2 --set evaluation.at_end=false --device cpu"
    notebook = nbformat.read(ROOT / "examples" / "first_steps.ipynb", as_version=4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
    tagged = {tag: cell for cell in notebook.cells for tag in cell.metadata.get("tags", ())}
    tagged["install"].source, tagged["options"].source = "", f"TRAINING, VIDEO = '{few}', '--num_envs 1 --steps 2'"
    monkeypatch.setenv("PATH", os.path.dirname(sys.executable), prepend=os.pathsep)
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "settings"))
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])  # given back: the shell takes its place
    monkeypatch.chdir(tmp_path)
    shell = Shell()
    for cell in notebook.cells:
        if cell.cell_type == "code":
            done = shell.run_cell(cell.source)
            done.raise_error()
    (line,) = plt.gca().lines
    assert len(line.get_xdata()) == 2 and "<video" in done.result._repr_html_() and (tmp_path / "walk.mp4").is_file()
