"""Trainings repeat to the bit: trained again, stopped and resumed, evaluated or not, each in a process of its own."""

import pytest
from support.reproducible import content, differences, finish, start

SMALL = ["--task=a1_torque_multihead", "--num_envs=256", "--perturbation=low", "--set=runner.num_steps_per_env=8"]
SMALL += ["--set=algorithm.num_mini_batches=2", "--set=runner.save_interval=2"]
SMALL += ["--set=motors.chain=[delay,drive,ideal,lag,urdf,friction,thermal]", "--set=motors.drive.damping=0.2"]
SMALL += ["--set=motors.lag.time_constant=0.003", "--set=motors.friction.coulomb_friction=0.2"]
SMALL += ["--set=motors.thermal.continuous_torque=8", "--set=motors.thermal.time_constant=1"]
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


def trained_in_four_ways(folder, words, iterations):
    """What a training leaves: in one go, again, without CUDA graphs, and stopped in the middle and resumed."""
    graphs, parts = {"whole": "true", "again": "true", "plain": "false", "stopped": "true"}, []
    for name, capture in graphs.items():
        count = iterations // 2 if name == "stopped" else iterations
        parts.append(start(folder / name, *words, f"--max_iterations={count}", f"--set=runner.capture={capture}"))
    finish(*parts)
    device = next(word for word in words if word.startswith("--device"))
    finish(start(folder / "stopped", device, "--resume", f"--max_iterations={iterations}"))
    return [content(folder / name) for name in graphs]


def test_flashsac(device, tmp_path):
    """FlashSAC repeats to the bit: again, without CUDA graphs, and stopped and resumed with its replay."""
    words = ["--task=a1_position", "--preset=flashsac", "--num_envs=64", f"--device={device}", *UNSEEN]
    words += ["--set=flashsac.buffer_min_length=512", "--set=flashsac.replay_buffer_size=4096"]
    words += ["--set=flashsac.learning_rate_end=3e-4", "--set=flashsac.save_replay=true"]
    words += ["--set=flashsac.updates_per_step=1"]
    whole, *others = trained_in_four_ways(tmp_path, words, 6)
    for values in (whole, *others):
        values.pop("checkpoint.infos.worlds")  # the digest of a file, whose layout differs after loading
    assert [differences(whole, other) for other in others] == [[], [], []]


def test_student(device, tmp_path):
    """A student repeats to the bit: again, without CUDA graphs, and stopped and resumed."""
    words = ["--task=a1_position", "--num_envs=64", "--set=runner.num_steps_per_env=8", f"--device={device}", *UNSEEN]
    finish(start(tmp_path / "teacher", *words, "--set=algorithm.num_mini_batches=2", "--max_iterations=1"))
    (run,) = (tmp_path / "teacher").glob("**/model_1.pt")
    words += ["--preset=student", "--set=distillation.gradient_length=4", f"--set=distillation.teachers=[{run}]"]
    whole, *others = trained_in_four_ways(tmp_path, words, 4)
    assert [differences(whole, other) for other in others] == [[], [], []]
