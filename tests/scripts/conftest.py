"""Shared by the tests of scripts: a run of one iteration, and a trap for code of strangers."""

import re
import shutil
import sys

import pytest
from support.scripts import SMALL, run_here


@pytest.fixture
def harm(tmp_path, monkeypatch):
    """A file that appears when code of a stranger runs: when ``payload`` is imported or a pickle of it is loaded."""
    file = tmp_path / "harm"
    (tmp_path / "payload.py").write_text(f"open({str(file)!r}, 'w')\n\ndef run(*args, **kwargs):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield file
    assert not file.exists()
    assert "payload" not in sys.modules


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Run folders of one iteration, by task."""
    root = tmp_path_factory.mktemp("trained")
    for task in ("a1_position", "a1_torque"):
        words = [*SMALL, f"--task={task}", "--max_iterations=1", "--logger=none"]
        status, _, error = run_here("train.py", *words, root=root)
        assert (status, error) == (0, "")
    for first in root.glob("logs/*/*/model_0.pt"):  # nothing to fall back on
        first.unlink()
    return {folder.name: next(folder.iterdir()) for folder in (root / "logs").iterdir()}


@pytest.fixture
def run(trained, tmp_path):
    """A copy of the run of a1_position, in a folder of logs."""
    return shutil.copytree(trained["a1_position"], tmp_path / "root" / "logs" / "a1_position" / "2026-01-01_00-00-00")


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    """A folder whose logs hold a run of ``a1_position`` and broken copies of it, one experiment each."""
    root = tmp_path_factory.mktemp("root")
    status, _, error = run_here("train.py", *SMALL, "--set=runner.save_interval=1", "--run_name=good", root=root)
    assert (status, error) == (0, "")
    (run,) = (root / "logs" / "a1_position").iterdir()
    config = (run / "config.yaml").read_text()
    broken = {
        "not_yaml": "task: [a1_position",
        "unknown_key": config.replace("num_envs:", "num_env:"),
        "no_section": re.sub(r"^env:\n(  .*\n)+", "env: 3\n", config, flags=re.MULTILINE),
    }
    for name, text in broken.items():
        copy = shutil.copytree(run, root / "logs" / name / run.name)
        assert text != config
        (copy / "config.yaml").write_text(text)
    (shutil.copytree(run, root / "logs" / "no_config" / run.name) / "config.yaml").unlink()
    checkpoint = (run / "model_2.pt").read_bytes()
    copy = shutil.copytree(run, root / "logs" / "half_checkpoint" / run.name)
    for number in (0, 1, 2):
        (copy / f"model_{number}.pt").write_bytes(checkpoint[: len(checkpoint) // 2])
    return root
