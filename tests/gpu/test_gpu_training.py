"""Trainings repeat to the bit: trained again, stopped and resumed, evaluated or not, each in a process of its own."""

import pytest
from support.reproducible import content, differences, finish, start

SMALL = ["--task=a1_torque_multihead", "--num_envs=256", "--perturbation=low", "--set=runner.num_steps_per_env=8"]
SMALL += ["--set=algorithm.num_mini_batches=2", "--set=runner.save_interval=2"]
EVALUATED = ["--set=evaluation.interval=1", "--set=evaluation.also=[high]", "--set=evaluation.also_from=4096"]
EVALUATED += ["--set=evaluation.num_samples=2048", "--set=evaluation.num_envs=128"]
UNSEEN = ["--set=evaluation.interval=0"]


@pytest.fixture(scope="module")
def trained(device, tmp_path_factory):
    """What four iterations leave: in one go, again, stopped and resumed in the middle, and without evaluation."""
    root = tmp_path_factory.mktemp("trained")
    kinds = {"whole": (4, EVALUATED), "again": (4, EVALUATED), "stopped": (2, EVALUATED), "unseen": (4, UNSEEN)}
    words = [*SMALL, f"--device={device}"]
    first = []
    for name, (count, evaluation) in kinds.items():
        first.append(start(root / name, *words, *evaluation, f"--max_iterations={count}"))
    finish(*first)
    finish(start(root / "stopped", *words, "--resume", "--max_iterations=4"))
    return {name: content(root / name) for name in kinds}


def test_the_same_bits_twice(trained):
    """Networks, moments, random numbers, worlds and evaluations repeat."""
    whole = trained["whole"]
    assert differences(whole, trained["again"]) == []
    names = {"checkpoint.infos.worlds", "checkpoint.optimizer_state_dict.state.0.exp_avg", "evaluations.csv.3.track_xy"}
    assert names | {"evaluations_high.csv.2.track_xy", "checkpoint.critic_state_dict.mlp.0.weight"} <= whole.keys()


def test_stopped_and_resumed(trained):
    """Stopping in the middle changes nothing."""
    assert differences(trained["whole"], trained["stopped"]) == []


def test_evaluation_changes_nothing(trained):
    """Evaluations do not change a training: only the worlds of the evaluation are missing without them."""
    names = differences(trained["whole"], trained["unseen"])
    assert [name for name in names if not name.startswith("evaluations")] == ["checkpoint.infos.worlds"]
