"""The check that trainings repeat: it finds what differs, and finds nothing where nothing does."""

import random
from pathlib import Path

import pytest
import torch
from support.scripts import run_here

from tools.reproducible import Training, compare, kill_often, values

SMALL = ["--task=a1_torque", "--device=cpu", "--num_envs=3", "--perturbation=low", "--logger=none"]
SMALL += ["--set=runner.num_steps_per_env=4", "--set=algorithm.num_mini_batches=1", "--set=actor.hidden_dims=[8]"]
SMALL += ["--set=critic.hidden_dims=[8]", "--set=evaluation.interval=1", "--set=evaluation.num_samples=6"]
SMALL += ["--set=evaluation.also=[high]", "--set=evaluation.also_from=24"]


def train(folder, *words):
    """A training that has run in this process."""
    for each in words:
        status, _, error = run_here(
            "train.py", *SMALL, *each.split(), f"--log_root={folder}", "--experiment_name=trained", root=folder.parent
        )
        assert (status, error) == (0, "")
    return Training(SMALL, folder)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A training of three iterations."""
    return train(tmp_path_factory.mktemp("trained"), "--max_iterations=3")


def test_the_same_again(trained, tmp_path):
    """Nothing differs if a training is repeated, or stopped and resumed; networks, moments and tables are compared."""
    resumed = train(tmp_path / "resumed", "--max_iterations=1", "--resume --max_iterations=3")
    again = train(tmp_path / "again", "--max_iterations=3")
    assert len(list((tmp_path / "resumed").glob("trained/*/config.yaml"))) == 2
    for other in (again, resumed):
        result = compare("x", trained, other)
        assert result.different == [] and result.compared > 60
    names = dict(values({"checkpoint": torch.load(trained.checkpoint(), weights_only=True)}))
    assert {"checkpoint.infos.worlds", "checkpoint.infos.random_states.0.cpu", "checkpoint.iter"} <= names.keys()
    assert "checkpoint.optimizer_state_dict.state.0.exp_avg" in names
    counts = {name: len(rows) for name, rows in trained.evaluations().items()}
    assert counts == {"evaluations.csv": 3, "evaluations_high.csv": 2}


def test_another_seed_is_found(trained, tmp_path):
    """Everything that is learned differs."""
    other = train(tmp_path / "other", "--max_iterations=3 --seed=9")
    different = compare("x", trained, other).different
    assert {"checkpoint.actor_state_dict.mlp.0.weight", "evaluations.csv.0.track_xy"} <= set(different)
    assert "checkpoint.iter" not in different and not any("seconds" in name for name in different)


def test_one_bit_is_found(trained, tmp_path):
    """The name of the one tensor in which it is."""
    other = train(tmp_path / "other", "--max_iterations=3")
    state = torch.load(other.checkpoint(), weights_only=True)
    state["critic_state_dict"]["mlp.0.bias"].view(torch.int32)[1] ^= 1
    torch.save(state, other.checkpoint())
    assert compare("x", trained, other).different == ["checkpoint.critic_state_dict.mlp.0.bias"]


def test_killed(tmp_path):
    """Training goes on after kills, nothing is broken, and a broken file would be told."""
    training = Training([*SMALL, "--set=runner.save_interval=2"], tmp_path / "killed")
    left, saved = kill_often(training, 2, 2, random.Random(2))
    assert left.count == 2 and left.most_lost <= 2 and left.broken == []
    training.run_until(saved + 1)
    (file,) = Path(tmp_path).glob(f"killed/trained/*/model_{saved + 1}.pt")
    file.write_bytes(file.read_bytes()[:1000])
    assert training.broken() == [str(file)]


def test_script(tmp_path):
    """It trains twice in processes of their own and ends with status 0."""
    status, output, error = run_here(
        "check_reproducible.py", *(word for word in SMALL if "logger" not in word and "interval" not in word),
        "--iterations=1", "--resumes=0", root=tmp_path,
    )  # fmt: skip
    assert (status, error) == (0, "")
    assert output.splitlines()[1].split()[:2] == ["trained", "twice"] and output.splitlines()[1].endswith("0 different")
    assert not list(tmp_path.iterdir())


def test_more_resumes_than_iterations(tmp_path):
    """It is refused in one line."""
    status, _, error = run_here("check_reproducible.py", "--iterations=2", "--resumes=2", root=tmp_path)
    assert status == 2 and error.startswith("error: --resumes must be less than --iterations")
