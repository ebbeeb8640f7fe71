"""A small gravity pre-training, made by its script."""

import json

import pytest
from support.scripts import run_here

TASK = "a1_torque_gravity"
SMALL = ["--device=cpu", "--num_envs=16"]
FEW = {"num_rounds": 2, "num_epochs": 3, "batch_size": 16}
CONFIGURATIONS, STEPS = 41, 6
STD = "distribution.log_std_param"


def words_of(**changes):
    """Changes of the settings of pre-training, as words of a command line."""
    return [f"--set=pretraining.{name}={value}" for name, value in changes.items()]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder in which pretrain_gravity.py has made a small policy: the folder, its file, the report, the output."""
    root = tmp_path_factory.mktemp("pretrained")
    few = [f"--num_configurations={CONFIGURATIONS}", f"--num_steps={STEPS}", *words_of(**FEW)]
    status, output, error = run_here("pretrain_gravity.py", *SMALL, *few, f"--json={root / 'report.json'}", root=root)
    assert (status, error) == (0, ""), output + error
    file = root / "logs" / "pretrained" / f"{TASK}.pt"
    return root, file, json.loads((root / "report.json").read_text()), output
