"""Run folders: found, read, and refused when they are broken."""

import os
import shutil
import subprocess
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.settings import error_of, get_cfgs

from legged_torque import __version__
from legged_torque.utils import runs
from legged_torque.utils.config import flat, to_dict
from legged_torque.utils.files import part_of, write_whole


@pytest.fixture
def log_root(tmp_path):
    """Three runs, of which the middle one is the newest with a checkpoint, and things that are no checkpoints."""
    for run, files in {
        "2026-01-01_00-00-00": ["model_2.pt", "model_10.pt", "model_9.pt"],
        "2026-01-02_00-00-00_wide": ["model_3.pt", "model_4.pt.part", "model_best.pt", "policy.pt"],
        "2026-01-03_00-00-00": ["config.yaml", "model_1.pt.part"],
    }.items():
        (tmp_path / run).mkdir()
        for file in files:
            zipfile.ZipFile(tmp_path / run / file, "w").close()
    return tmp_path


def test_find_run(log_root, monkeypatch):
    """The newest run that has a checkpoint, one by its name, or one by its path, which gives its name even if short."""
    assert runs.find_run(log_root, None) == log_root / "2026-01-02_00-00-00_wide"
    assert runs.find_run(log_root, "2026-01-01_00-00-00") == log_root / "2026-01-01_00-00-00"
    assert runs.find_run(log_root, f"{log_root}/2026-01-03_00-00-00") == log_root / "2026-01-03_00-00-00"
    shutil.copytree(log_root / "2026-01-01_00-00-00", log_root / "best")  # without a date, older than all others
    assert runs.find_run(log_root, None) == log_root / "2026-01-02_00-00-00_wide"
    assert runs.find_run(log_root, "best") == log_root / "best"
    (log_root / "2026-01-01_00-00-00" / "exported_2").mkdir()
    for folder, short in (("2026-01-03_00-00-00", "."), ("2026-01-01_00-00-00/exported_2", "..")):
        monkeypatch.chdir(log_root / folder)
        assert runs.find_run(log_root, short).name == folder.split("/")[0]


def test_find_run_that_does_not_exist(log_root):
    """The nearest run is proposed; an experiment without runs says that there is nothing to load."""
    line = error_of(runs.find_run, log_root, "2026-01-02_00-00-00")
    assert line.startswith("unknown run '2026-01-02_00-00-00'; did you mean '2026-01-0")
    for folder in (log_root / "nothing", log_root / "2026-01-03_00-00-00"):
        assert str(folder) in error_of(runs.find_run, folder, None)


def test_find_checkpoint(log_root):
    """The last checkpoint is that of the highest number, not that of the last name."""
    run = log_root / "2026-01-01_00-00-00"
    assert runs.find_checkpoint(run, None) == run / "model_10.pt"
    assert runs.find_checkpoint(run, 2) == run / "model_2.pt"


def test_find_checkpoint_that_does_not_exist(log_root):
    """All checkpoints are listed; half-written and foreign files are none."""
    line = error_of(runs.find_checkpoint, log_root / "2026-01-01_00-00-00", 1)
    assert line.startswith("unknown checkpoint '1'") and line.endswith("allowed: 10, 2, 9")
    assert runs.checkpoint_numbers(log_root / "2026-01-02_00-00-00_wide") == [3]
    empty = log_root / "2026-01-03_00-00-00"
    assert error_of(runs.find_checkpoint, empty, None) == f"there is no checkpoint in '{empty}'"


@pytest.mark.parametrize("task", ["a1_position", "a1_torque_gravity_multihead"])
def test_config_file_round_trip(task, tmp_path, monkeypatch):
    """What a run has written gives the same settings again, of the same types; versions of all packages are there."""
    words = ["--preset=paper", "--set=rewards.scales.torques=-1e-7", "--set=actor.hidden_dims=[8, 4]", "--run_name=7"]
    env_cfg, train_cfg = get_cfgs(*words, task=task)
    monkeypatch.setattr("sys.argv", ["scripts/train.py", "--run_name", "a b"])
    runs.save_config(tmp_path / "run", {"task": task, "env": to_dict(env_cfg), "train": to_dict(train_cfg)})
    assert "!!" not in (tmp_path / "run" / "config.yaml").read_text()  # any program reads it
    config = runs.load_config(tmp_path / "run")
    loaded = get_cfgs(task=task, run_config=config)
    for new, old in zip(loaded, (env_cfg, train_cfg), strict=True):
        new, old = flat(to_dict(new)), flat(to_dict(old))
        assert new == old
        assert {key: type(value) for key, value in new.items()} == {key: type(value) for key, value in old.items()}
    assert config["task"] == task
    assert config["versions"]["numpy"] == np.__version__
    assert {"python", "torch", "mujoco", "warp-lang", "rsl-rl-lib"} <= config["versions"].keys()
    assert config["versions"]["legged_torque"].startswith(__version__)
    assert config["command"] == "train.py --run_name 'a b'"


def test_commits_in_versions(tmp_path, monkeypatch):
    """Of a checkout: its commit, and whether files have changed since; none without git, or for another's checkout."""
    where = tmp_path / "legged_torque" / "utils" / "runs.py"
    where.parent.mkdir(parents=True)
    where.write_text("x = 1")
    monkeypatch.setattr(runs, "__file__", str(where))
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path)]
    assert runs.commit.__wrapped__() == ""
    for words in (["init"], ["add", "."], ["commit", "-m", "one"], ["tag", "v7"]):
        subprocess.run([*git, *words], check=True, capture_output=True)
    number = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True).stdout
    clean = runs.commit.__wrapped__()
    assert clean.startswith("+g") and number.startswith(clean[2:]) and len(clean) >= 9
    where.write_text("x = 2")
    assert runs.commit.__wrapped__() == f"{clean}.dirty"
    monkeypatch.setenv("PATH", "")
    assert runs.commit.__wrapped__() == ""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\x00\x01", "is not valid YAML"),
        ("- task\n- env\n- train", "lacks the entries task, env and train"),
        ("task: a1_position\nenv: {}", "lacks the entries task, env and train"),
        (None, "has no config.yaml"),
    ],
)
def test_broken_config_file(text, message, tmp_path):
    """A file that is missing, not YAML or without the entries is named in one line."""
    if text is not None:
        (tmp_path / "config.yaml").write_text(text)
    line = error_of(runs.load_config, tmp_path)
    assert message in line and str(tmp_path) in line


def test_last_run_after_the_clock_moved(tmp_path, monkeypatch):
    """The run that was started last is the last one by name in any time zone, and beside names that are no times."""
    (tmp_path / "9999-12-31_23-59-59").mkdir()
    (tmp_path / "best").mkdir()
    for zone in ("UTC", "Etc/GMT-9", "Etc/GMT+5", "UTC"):
        with monkeypatch.context() as patch:
            patch.setenv("TZ", zone)
            time.tzset()
            run = runs.claim_run_dir(runs.new_run_dir(tmp_path, ""), {})
        zipfile.ZipFile(run / "model_1.pt", "w").close()
        assert runs.find_run(tmp_path, None) == run
    time.tzset()


def test_runs_of_the_same_second_do_not_share_a_folder(tmp_path):
    """Every run gets a folder of its own, numbered where the name is taken."""
    folders = [runs.claim_run_dir(tmp_path / "logs" / "2026-11-21_10-00-00", {"run": i}) for i in range(3)]
    assert [folder.name for folder in folders] == [f"2026-11-21_10-00-00{end}" for end in ("", "_2", "_3")]
    assert sorted((tmp_path / "logs").iterdir()) == folders  # nothing else is left
    assert [yaml.safe_load((folder / "config.yaml").read_text())["run"] for folder in folders] == [0, 1, 2]


def test_no_run_is_without_its_settings(tmp_path, monkeypatch):
    """If the process ends while they are written, there is no folder of a run; the next run removes what is left."""
    monkeypatch.setattr(os, "fsync", lambda stream: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        runs.claim_run_dir(tmp_path / "run", {})
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr(os, "getpid", lambda: 999999999)  # a process that was killed
    part_of(tmp_path / "run").mkdir()
    assert (tmp_path / f"run.{os.uname().nodename}.999999999.part").is_dir()  # on shared disks, others have that number
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) != [runs.claim_run_dir(tmp_path / "run", {})] == list(tmp_path.iterdir())


def test_a_device_is_not_replaced(tmp_path):
    """What is written to /dev/null is gone, and /dev/null is still there."""
    link = tmp_path / "link"
    link.symlink_to("/dev/null")
    write_whole(link, b"1")
    assert link.is_symlink() and link.read_bytes() == b"" and Path("/dev/null").is_char_device()


def test_given_iterations():
    """They are a number, or not given; what else a file may say is refused."""
    settings = {"env": {"env": {"num_envs": 4}}, "train": {"runner": {"num_steps_per_env": 2, "total_steps": 79}}}
    assert runs.given_iterations({"given_iterations": 7, "max_iterations": 9}) == 7
    assert runs.given_iterations({"given_iterations": None, "max_iterations": 9}) is None
    assert [runs.given_iterations({**settings, "max_iterations": number}) for number in (9, 10, 11)] == [9, None, 11]
    for config in ({"given_iterations": "many"}, {"max_iterations": 2.5}):
        assert "has no number of iterations" in error_of(runs.given_iterations, config)
