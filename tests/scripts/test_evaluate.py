"""Evaluation of checkpoints by evaluate.py, and the rows of resumed runs."""

import json
import re

import pytest
import torch
from support.evaluations import note_steps
from support.scripts import run_here
from torch.nn.functional import elu, linear

from legged_torque.utils.metrics import UNITS

TASK = ["--task=a1_position", "--device=cpu"]
SMALL = [*TASK, "--num_envs=2", "--set=runner.num_steps_per_env=4", "--set=runner.save_interval=1", "--logger=none"]
SMALL += ["--set=actor.hidden_dims=[8]", "--set=critic.hidden_dims=[8]", "--set=algorithm.num_mini_batches=1"]
SMALL += ["--set=evaluation.interval=8", "--set=evaluation.num_samples=6"]
MECHANICAL = [name for name in UNITS if "electrical" not in name]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder whose logs hold a small run of ``a1_position`` without perturbations."""
    root = tmp_path_factory.mktemp("root")
    assert run_here("train.py", *SMALL, "--max_iterations=3", "--run_name=first", root=root)[0] == 0
    return root


def evaluate(root, file, *words):
    """What evaluate.py prints, and its file, which must be JSON to the letter."""
    status, output, error = run_here("evaluate.py", *TASK, f"--json={file}", *words, root=root)
    assert (status, error) == (0, "")
    return output, json.loads(file.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_a_seed_fixes_every_number(root, tmp_path):
    """Two evaluations with one seed give the same file; another seed, perturbation or checkpoint, other numbers."""
    often = "--set=domain_rand.push_probability=0.5"  # or low and high would rarely differ in so few steps
    words = ["--num_envs=3", "--steps=20", "--seed=3", often]
    output, result = evaluate(root, tmp_path / "a.json", *words)
    assert "Note: domain_rand.push_probability has no effect without domain_rand.push_robots=true\n" in output
    assert result["set"] == ["domain_rand.push_probability=0.5"]
    torch.rand(11)
    evaluate(root, tmp_path / "b.json", *words)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert [result[key] for key in ("steps", "checkpoint", "num_envs", "num_steps")] == [24, "model_3.pt", 3, 20]
    changes = ["--seed=4", "--perturbation=low", "--perturbation=high", "--checkpoint=1", "--perturbation=none"]
    others = [evaluate(root, tmp_path / f"{i}.json", *words, change)[1] for i, change in enumerate(changes)]
    numbers = [json.dumps([each["metrics"], each["by_command"]]) for each in (result, *others)]
    assert len(set(numbers)) == 5 and numbers[0] == numbers[-1]  # the run had no perturbations either
    assert [each["seed"] for each in others] == [4, 3, 3, 3, 3] and others[3]["steps"] == 8
    assert [each["perturbation"] for each in others] == ["as in training", "low", "high", "as in training", "none"]


def test_fixed_command_with_one_world(root, tmp_path, monkeypatch):
    """The command holds in all steps, new episodes included; standard errors are null; the folder is created."""
    noted = note_steps(monkeypatch)
    words = ["--num_envs=1", "--steps=9", "--set=env.episode_length_s=0.05", "--set=commands.resampling_probability=1"]
    output, result = evaluate(root, tmp_path / "new" / "folder" / "x.json", *words, "--command", "0.5", "0", "-0.2")
    assert len(noted) == 9 and any(note.reset.any() for note in noted)
    assert result["command"] == [0.5, 0.0, -0.2]
    state = torch.load(next(root.glob("logs/*/*_first/model_3.pt")), weights_only=True)["actor_state_dict"]
    weights = [state[f"mlp.{name}"] for name in ("0.weight", "0.bias", "2.weight", "2.bias")]
    for note in noted:  # mean actions of a network with one hidden layer
        torch.testing.assert_close(note.commands, torch.tensor([[0.5, 0.0, -0.2]]))
        mean = linear(elu(linear(note.obs["policy"], *weights[:2])), *weights[2:])
        torch.testing.assert_close(note.actions, mean)
    for name, value in {"lin_vel_x": 0.5, "lin_vel_y": 0.0, "ang_vel_yaw": -0.2}.items():
        (part,) = result["by_command"][name]
        assert (part["from"], part["to"], part["share"]) == pytest.approx((value, value, 1.0), abs=1e-6)
        unit = "rad/s" if name == "ang_vel_yaw" else "m/s"
        assert re.search(rf"(?m)^  error of {name} \[{unit}\] +{part['error']:.3f}$", output)
    metrics = result["metrics"]
    assert list(metrics) == MECHANICAL and all(entry["standard_error"] is None for entry in metrics.values())
    for name, entry in metrics.items():
        assert re.search(rf"(?m)^  {name} +{entry['mean']:.4f} {re.escape(UNITS[name])}$", output), name
    assert "model_3.pt, after 24 steps of training, 1 world x 9 steps:" in output


def test_crossing_tiles_after_training_on_a_plane(root, tmp_path):
    """The policy sees what it saw; there is a row per kind and level; a seed fixes every number."""
    words = ["--terrain", "stairs_up", "flat", "--level", "0.5", "0", "--num_envs=2", "--command", "2", "0", "0"]
    output, result = evaluate(root, tmp_path / "a.json", *words)
    evaluate(root, tmp_path / "b.json", *words)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    tiles = [(row["kind"], row["level"], row["worlds"]) for row in result["grounds"]]
    assert tiles == [("stairs_up", 0.0, 2), ("stairs_up", 0.5, 2), ("flat", 0.0, 2), ("flat", 0.5, 2)]
    assert (result["num_envs"], result["time_limit"], result["steps"]) == (8, 4.0, 24) and "num_steps" not in result
    for row in result["grounds"]:
        assert row["crossed"] == {"mean": 0.0, "standard_error": 0.0}  # it cannot walk yet
        assert list(row["metrics"]) == MECHANICAL
        place = rf"{row['kind']} +{row['level']:g} +2 +0.000 \+- 0.000 +{row['fell']['mean']:.3f} "
        assert re.search(rf"(?m)^  {place}", output), row
    assert "8 worlds, commanded to walk 2 0 m/s for 4.0 s at most:" in output
    _, result = evaluate(root, tmp_path / "c.json", "--terrain=flat", "--level=0", "--num_envs=1")
    assert result["command"] == [0.6, 0.0, 0.0]
