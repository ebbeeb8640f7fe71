"""A benchmark against an earlier one: ratios by hand, and files that do not fit are refused by name."""

import copy
import json
import math

import pytest
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.benchmark.baseline import Baseline

RESULT = {
    "task": "a1_position",
    "device": "NVIDIA H200",
    "versions": {"torch": "2.11", "numpy": "2.0"},
    "preset": "parallel",
    "perturbation": "none",
    "ranges": "default",
    "set": ["seed=3"],
    "rounds": 5,
}
OLD_ROW = {"num_envs": 4096, "num_steps_per_env": 24, "update_ms": 60.0, "log_ms": None, "physics_ms": 0.5}
NEW_ROW = {"num_envs": 4096, "num_steps_per_env": 24, "update_ms": 15.0, "log_ms": 1.0, "physics_ms": 0.4}


def write(folder, **changes):
    """A file of an earlier benchmark, as ``--json`` writes it."""
    file = folder / "old.json"
    rows = [OLD_ROW, {"num_envs": 65536, "error": "does not fit in memory"}]
    file.write_text(json.dumps(copy.deepcopy(RESULT) | {"rows": rows} | changes))
    return file


def test_ratios_by_hand(tmp_path):
    """Ratios are new over old, of numbers in both; a size that the baseline lacks has none."""
    baseline = Baseline(write(tmp_path), RESULT, [(4096, 24), (16384, 24)])
    compared = baseline.compare(NEW_ROW, ["update_ms", "log_ms", "physics_ms", "peak_memory_mib"])
    assert compared == [("update_ms", 60.0, 15.0, 0.25), ("physics_ms", 0.5, 0.4, 0.8)]
    assert baseline.compare(NEW_ROW | {"num_envs": 16384}, ["update_ms"]) == []
    assert baseline.compare({"num_envs": 4096, "error": "does not fit in memory"}, ["update_ms"]) == []
    assert baseline.notes == ["it has no 16384 worlds x 24 steps"]


def test_other_settings_and_machine(tmp_path):
    """Another task, other settings, another device and other software are reported, not refused."""
    changes = {"task": "a1_torque", "set": [], "perturbation": "low"}
    file = write(tmp_path, device="NVIDIA H100", versions={"torch": "2.10", "warp-lang": "1.19"}, **changes)
    assert Baseline(file, RESULT, [(4096, 24)]).notes == [
        "its task was 'a1_torque', is 'a1_position'",
        "its perturbation was 'low', is 'none'",
        "its set was [], is ['seed=3']",
        "its device was 'NVIDIA H100', is 'NVIDIA H200'",
        "its torch was '2.10', is '2.11'",
        "its warp-lang was '1.19', is None",
        "its numpy was None, is '2.0'",
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": [OLD_ROW | {"num_envs": 1024}]}, "has 1024 worlds x 24 steps, not 4096 worlds x 24 steps"),
        ({"rows": []}, "has no sizes, not 4096 worlds x 24 steps"),
        ({"rows": [3]}, "is not a file that benchmark.py --json has written"),
        ({"rows": [OLD_ROW | {"num_envs": [4096]}]}, "is not a file that benchmark.py --json has written"),
        ({"versions": 3}, "is not a file that benchmark.py --json has written"),
    ],
)
def test_files_that_do_not_fit(tmp_path, changes, message):
    """They are refused in one line with the file, its sizes and those of this run."""
    file = write(tmp_path, **changes)
    error = error_of(Baseline, file, RESULT, [(4096, 24)])
    assert f"'{file}'" in error and message in error


@pytest.mark.parametrize("value", ["60", 0, math.nan, 10**400])
def test_numbers_without_a_ratio(tmp_path, value):
    """They are left out."""
    file = write(tmp_path, rows=[OLD_ROW | {"update_ms": value}])
    compared = Baseline(file, RESULT, [(4096, 24)]).compare(NEW_ROW, ["update_ms", "physics_ms"])
    assert [name for name, *_ in compared] == ["physics_ms"]


def test_refused_before_anything_is_measured(tmp_path):
    """The script ends with status 2 and one line."""
    (tmp_path / "old.json").write_text("{")
    words = ["--task=a1_position", "--device=cpu", "--num_envs=2", "--baseline=old.json"]
    result = run_here("benchmark.py", *words, root=tmp_path)
    assert_told_in_one_line(result, "cannot read")
    assert result[1] == ""
