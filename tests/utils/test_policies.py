"""Bundled policies: their cards hold, and what has been changed is refused."""

import json
import math
import shutil

import pytest
from support.scripts import assert_told_in_one_line, run_here
from support.settings import error_of

from legged_torque.utils import policies
from legged_torque.utils.policies import CARD, POLICIES_DIR, policy_dir, policy_names, read_card

NAMES = policy_names()
APART = 4.0  # standard errors of a difference
CHANCE = 0.1  # those of two robots may be small by chance


@pytest.mark.parametrize("name", NAMES)
def test_cards(name, tmp_path):
    """What a card says of a GPU's many worlds, plain MuJoCo agrees with; every file has its checksum."""
    folder = policy_dir(name)
    card = read_card(folder)
    assert {*card["files"], CARD} == {path.name for path in folder.iterdir()} and card["policy"] == name
    status, _, error = run_here("sim2sim.py", name, "--steps=120", "--robots=2", "--json=measured.json", root=tmp_path)
    assert status == 0, error
    here = json.loads((tmp_path / "measured.json").read_text())["metrics"]["track_percentage"]
    mean, deviation = card["metrics"]["none"]["track_percentage"]
    assert abs(here["mean"] - mean) <= APART * math.hypot(deviation, here["standard_error"]) + CHANCE


def test_scripts(tmp_path):
    """Names are taken in place of runs and exports, and listed."""
    name = NAMES[0]
    status, output, _ = run_here("policies.py", root=tmp_path)
    assert status == 0 and all(each in output for each in NAMES)
    assert run_here("export.py", f"--policy={name}", "--out=out", root=tmp_path)[0] == 0
    assert (tmp_path / "out" / "policy.onnx").is_file()
    for script, words, message in (
        ("play.py", [f"--policy={name[:-1]}"], f"did you mean '{name}'?"),
        ("demo.py", [name[:-1]], f"did you mean '{name}'?"),
        ("play.py", [f"--policy={name}", "--load_run=x"], "--policy and --load_run exclude each other"),
        ("train.py", [f"--policy={name}"], "--policy is for play.py, evaluate.py and export.py"),
        ("sim2sim.py", [name[:-1]], f"nor a bundled policy: {NAMES[0]}"),
    ):
        assert_told_in_one_line(run_here(script, *words, root=tmp_path), message)


def test_changed_files(tmp_path, monkeypatch):
    """A file that is not the one that was measured is refused, as is a missing one."""
    shutil.copytree(POLICIES_DIR, tmp_path / "policies")
    monkeypatch.setattr(policies, "POLICIES_DIR", tmp_path / "policies")
    file = tmp_path / "policies" / NAMES[0] / "policy.onnx"
    assert policy_dir(NAMES[0]) == file.parent
    file.write_bytes(file.read_bytes() + b"\0")
    assert error_of(policy_dir, NAMES[0]) == f"'{file}' is not the file that card.yaml describes"
    file.unlink()
    assert str(file) in error_of(policy_dir, NAMES[0])
