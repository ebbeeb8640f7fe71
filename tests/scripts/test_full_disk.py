"""A disk that is full, here one that takes no file of more than 600 bytes: what was there stays as it was."""

import contextlib
import resource

import pytest
from support.scripts import SMALL, assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque import RESOURCES_DIR
from legged_torque.learning.evaluator import append_row

LIMIT = 600  # bytes
A1 = RESOURCES_DIR / "robots" / "a1" / "a1.xml"
COMMANDS = {
    "train.py": ([*SMALL, "--log_root={out}"], []),
    "evaluate.py": (["--task=a1_position", "--load_run={run}", "--steps=2", "--json={out}/a.json"], ["a.json"]),
    "export.py": (["--task=a1_position", "--load_run={run}", "--out={out}"], ["policy.onnx", "policy.yaml"]),
    "import_robot.py": ([str(A1), "--name=full", "--out={out}", "--force"], ["full.py", "full.xml"]),
    "report.py": (["{run}", "--out={out}"], ["report.html", "report.md", "table.csv"]),
}
"""Arguments of scripts, and the files that they would replace in the folder ``out``."""


@contextlib.contextmanager
def full_disk():
    """Context in which no file can become longer than the limit."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("script", COMMANDS)
def test_scripts(trained, tmp_path, script):
    """One line, exit status 2, files as they were and no unfinished ones."""
    if script == "report.py":
        pytest.importorskip("pandas", reason="the extra 'plots' is not installed")
    words, names = COMMANDS[script]
    (out := tmp_path / "out").mkdir()
    for name in names:
        (out / name).write_text("old")
    with full_disk():
        words = [word.format(out=out, run=trained["a1_position"]) for word in words]
        assert_told_in_one_line(run_here(script, *words, root=tmp_path), "File too large")
    files = {path.relative_to(out).as_posix(): path.read_text() for path in out.rglob("*") if path.is_file()}
    assert files == dict.fromkeys(names, "old")
    assert not list(tmp_path.rglob("*.part"))


def test_rows_of_evaluations(tmp_path):
    """A row that does not fit leaves no part of it."""
    row = {"steps": 10**99, "track_xy": 0.5}
    with full_disk():
        for _ in range(5):
            append_row(tmp_path / "rows.csv", row)
        assert "File too large" in error_of(append_row, tmp_path / "rows.csv", row)
    assert (tmp_path / "rows.csv").read_text() == "steps,track_xy\n" + f"{10**99},0.5\n" * 5
