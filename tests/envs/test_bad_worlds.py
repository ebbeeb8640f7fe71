"""Numbers that are not finite cost their world its episode and nobody else anything; who is to blame is told."""

import functools
import math
import re
from pathlib import Path

import pytest
import torch
from support.bad_worlds import WORLDS, Run, check
from support.scripts import run_here
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.envs import task_registry
from legged_torque.envs.approaches.torque_curriculum import TorqueCurriculumRobot
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.envs.tasks import A1TorqueCurriculumCfg, A1TorqueCurriculumCfgPPO
from legged_torque.learning.guard import PATIENCE
from legged_torque.utils.config import set_by_path
from legged_torque.utils.errors import TrainingError
from legged_torque.utils.mirroring import SCALAR

RANDOM = {"domain_rand.randomize_parameters": True}
HISTORY = {"env.history_length": 3, "motors.delay.range": [1, 6]}
FIXED = {"domain_rand.randomize_parameters": False}

BUFFERS = {
    "stiffness": lambda task: task.p_gains,
    "damping": lambda task: task.d_gains,
    "motor_strength": lambda task: task.motor_strength,
    "joint_offset": lambda task: task.joint_offset,
    "torque_scale": lambda task: task.torque_scale,
    "random_parameters": lambda task: task.randomization.values,
    "commands": lambda task: task.commands,
    "feet_air_time": lambda task: task.feet_air_time,
    "last_actions": lambda task: task.last_actions,
    "last_dof_vel": lambda task: task.last_dof_vel,
    "episode_return": lambda task: task.episode_return.unsqueeze(1),
    "episode_sums": lambda task: task.episode_sums.T,
}
DELAYED_BUFFERS = {
    "delay.drawn": lambda task: task.motors.links["delay"].drawn,
    "delay.before": lambda task: task.motors.links["delay"].before[:, 0],
    "observation_history": lambda task: task.obs_buf["policy"][:, -1:],
}
MODEL_FIELDS = ["body_mass", "body_ipos", "geom_friction", "geom_solref", "dof_armature", "gravity"]


@pytest.fixture(scope="module")
def healthy(make_task):
    """The runs in which nothing is broken, by the settings that they have."""
    return [(overrides, Run(make_task, **overrides)) for overrides in (RANDOM, FIXED, HISTORY)]


def break_buffer(buffer, value, world=1):
    """What spoils the last number of a world in a buffer."""

    def break_state(task):
        buffer(task)[world, -1] = value

    return break_state


def names_of(task):
    """What the task blames."""
    return {str(tensor): count for tensor, count in task.health.read()[1].items()}


@pytest.mark.parametrize(("settings", "value"), [(0, math.nan), (1, math.inf)], ids=["randomized", "fixed"])
@pytest.mark.parametrize("name", BUFFERS)
def test_bad_buffer(make_task, healthy, name, settings, value):
    """The world starts anew and stays healthy, no bit of the others changes, and the buffer is named, once."""
    overrides, expected = healthy[settings]
    run = Run(make_task, break_state=break_buffer(BUFFERS[name], value), **overrides)
    check(run, expected, [1])
    assert torch.isfinite(BUFFERS[name](run.task)).all()
    assert names_of(run.task) == {f"buffer '{name}'": 1}
    if overrides == FIXED:
        assert torch.equal(run.task.p_gains[1], run.task.p_gains[0])
        assert (run.task.motor_strength == 1.0).all() and (run.task.joint_offset == 0.0).all()


@pytest.mark.parametrize("name", DELAYED_BUFFERS)
def test_bad_history(make_task, healthy, name):
    """Delayed actions, their delay and older observations are forgotten with the episode."""
    overrides, expected = healthy[2]
    run = Run(make_task, break_state=break_buffer(DELAYED_BUFFERS[name], math.nan), **overrides)
    check(run, expected, [1])
    assert names_of(run.task) == {f"buffer '{name}'": 1}


@pytest.mark.parametrize("name", MODEL_FIELDS)
def test_bad_model(make_task, healthy, name):
    """Parameters of the robot and the ground come back, those that are never drawn too."""
    broken = break_buffer(lambda task: task.sim.fields[name].flatten(1), math.nan)
    run = Run(make_task, break_state=broken, **RANDOM)
    check(run, healthy[0][1], [1])
    assert torch.isfinite(run.task.sim.fields[name]).all()
    assert names_of(run.task) == {f"buffer '{name}'": 1}


def test_bad_action_is_named(make_task, healthy):
    """Actions come from outside, and are not the task's own fault."""

    def break_action(actions):
        actions[1, 4] = math.nan

    run = Run(make_task, break_action=break_action)
    check(run, healthy[1][1], [1])
    assert names_of(run.task) == {"buffer 'actions'": 1}


def test_state_that_diverged_is_nobodys_fault(make_task):
    """Rewards and torques that follow from a bad state are not blamed for it, and healthy worlds blame nobody."""

    def break_state(task):
        task.sim.qvel[2, 9] = math.nan

    assert names_of(Run(make_task, break_state=break_state).task) == {}
    assert names_of(Run(make_task).task) == {}


# ------------------------------------------------------------------------------------------ terms of a user


class DividingRobot(TorqueCurriculumRobot):
    """A robot whose reward or observation divides by what is zero in some worlds."""

    def _init_buffers(self):
        """Add the divisors."""
        super()._init_buffers()
        self.reward_divisor, self.observation_divisor = torch.ones(2, self.num_envs, 1).unbind()

    def _reward_ratio(self):
        """1 over the divisor. Shape: (num_envs,)."""
        return 1.0 / self.reward_divisor[:, 0]

    def observation_terms(self):
        """One more, that policy and critic see."""
        return [*super().observation_terms(), ObservationTerm("ratio", lambda: 1.0 / self.observation_divisor, SCALAR)]


class BrokenRobot(DividingRobot):
    """The same, with a reward that is never finite."""

    def _init_buffers(self):
        """Divide by zero."""
        super()._init_buffers()
        self.reward_divisor.zero_()


class DividingCfg(A1TorqueCurriculumCfg):
    """Settings of both."""

    class rewards:
        class scales:
            ratio: float = 1e-3


@pytest.fixture
def make_dividing(make_task, monkeypatch):
    """Factory of such tasks, which are registered for the time of a test."""
    for kind in (DividingRobot, BrokenRobot):
        entry = (kind, DividingCfg(), A1TorqueCurriculumCfgPPO())
        monkeypatch.setitem(task_registry._tasks, f"a1_{kind.__name__}", entry)
    return functools.partial(make_task, "a1_DividingRobot", seed=3)


def steps(task, num=4):
    """Step under the same random actions as every other call."""
    generator = torch.Generator().manual_seed(1)
    torch.manual_seed(2)
    results = []
    for _ in range(num):
        obs, rewards, dones, extras = task.step(torch.randn(task.num_envs, 12, generator=generator))
        results.append((obs["policy"], obs["critic"], rewards.clone(), dones.clone(), extras["time_outs"].clone()))
    return results


def assert_finite_and_same(results, expected, others):
    """All results are finite, and equal to the bit in the worlds of ``others``."""
    for values, wanted in zip(results, expected, strict=True):
        for value, right in zip(values, wanted, strict=True):
            assert torch.isfinite(value).all() and torch.equal(value[others], right[others])


@pytest.mark.parametrize("value", [0.0, -0.0, math.nan])
def test_reward_that_divides_by_zero(make_dividing, value):
    """The world ends in the same step, without a reward; that goes on as long as the term is bad."""
    expected = steps(make_dividing(WORLDS))
    task = make_dividing(WORLDS)
    task.reward_divisor[1] = value
    results = steps(task, 3)
    assert_finite_and_same(results, expected[:3], [0, 2])
    for _, _, rewards, dones, time_outs in results:
        assert dones[1] and rewards[1] == 0.0 and not time_outs[1]
    assert names_of(task) == {"reward term 'ratio'": 3} and task.num_diverged == 3
    assert task.log.read(1.0)["Health/diverged_worlds"] == 3.0
    task.reward_divisor[1] = 1.0
    *_, rewards, dones, _ = steps(task, 1)[0]
    assert not dones[1] and rewards[1] > 0.0 and names_of(task) == {}
    assert task.episode_return[1] == rewards[1] and task.episode_length_buf[1] == 1


def test_bad_reward_is_no_time_out(make_dividing):
    """An episode that ends for both reasons is one that ends for good: no value is bootstrapped."""
    task = make_dividing(WORLDS)
    task.episode_length_buf = torch.full((WORLDS,), task.max_episode_length - 1)
    task.reward_divisor[1] = 0.0
    *_, dones, time_outs = steps(task, 1)[0]
    assert dones.all() and time_outs.tolist() == [True, False, True]


@pytest.mark.parametrize("history", [1, 3])
def test_observation_that_divides_by_zero(make_dividing, history):
    """The policy sees 0 instead, and the world is reset in the step after."""
    overrides = {"env.history_length": history}
    expected = steps(make_dividing(WORLDS, **overrides))
    task = make_dividing(WORLDS, **overrides)
    task.observation_divisor[1] = 0.0
    first = steps(task, 1)
    assert_finite_and_same(first, expected[:1], [0, 2])
    column = task.observations.policy_columns("ratio")[0]
    assert first[0][0][1, column] == 0.0 and first[0][0][0, column] == 1.0
    assert not first[0][3][1]
    task.observation_divisor[1] = 1.0
    obs, _, rewards, dones, time_outs = steps(task, 1)[0]
    assert dones[1] and rewards[1] == 0.0 and not time_outs[1]
    assert (obs[1, task.observations.policy_columns("ratio")] == 1.0).all()
    assert names_of(task)["observation 'ratio'"] == 1
    assert not steps(task, 1)[0][3].any() and names_of(task) == {}


# ------------------------------------------------------------------------------------------ training


@pytest.fixture
def make_runner(make_dividing):
    """Factory of trainings of such tasks, and the task."""

    def make(log_root, **overrides):
        _, train_cfg = task_registry.get_cfgs("a1_torque_curriculum")
        settings = {"runner.num_steps_per_env": 4, "algorithm.num_mini_batches": 2, "algorithm.schedule": "fixed"}
        for path, value in {**settings, **overrides}.items():
            set_by_path(train_cfg, path, value)
        task = make_dividing(4)
        return task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=log_root)[0], task

    return make


def test_training_with_a_bad_world(make_runner, tmp_path, capsys):
    """It learns from the other worlds; the term is told once and its number logged in every iteration."""
    runner, task = make_runner(tmp_path)
    task.reward_divisor[2] = 0.0
    runner.learn(PATIENCE + 1)
    lines = [line for line in capsys.readouterr().err.splitlines() if "not finite;" in line]
    assert lines == ["Warning: reward term 'ratio' was not finite; resets of worlds for it: 4."]
    for tensor in runner.alg.actor.parameters():
        assert torch.isfinite(tensor).all()
    events = EventAccumulator(runner.log_dir).Reload()
    values = {tag: [event.value for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    assert values["Loss/skipped_updates"] == [0.0] * (PATIENCE + 1)
    assert values["Health/not_finite/reward_ratio"] == values["Health/diverged_worlds"] == [4.0] * (PATIENCE + 1)
    page = (Path(__file__).parents[2] / "docs/reference/logs.md").read_text()
    assert "`Health/not_finite/<kind>_<name>`" in page
    assert {tag for tag in values if "not_finite" in tag} == {"Health/not_finite/reward_ratio"}


def stops(runner, iterations=100):
    """Train until it is given up; return why."""
    with pytest.raises(TrainingError) as error:
        runner.learn(iterations)
    assert "\n" not in str(error.value)
    assert (Path(runner.log_dir) / f"model_{runner.current_learning_iteration}.pt").is_file()
    return str(error.value)


def test_stops_when_most_worlds_diverge(make_runner, tmp_path):
    """Three of four worlds are too many; the number of iterations in a row counts."""
    runner, task = make_runner(tmp_path, **{"runner.logger": "none"})
    update, seen = runner.alg.update, []

    def update_and_mend():
        seen.append(runner.current_learning_iteration)
        task.reward_divisor[1:] = 1.0 if len(seen) == 3 else 0.0  # the fourth iteration is a good one
        return update()

    task.reward_divisor[1:] = 0.0
    runner.alg.update = update_and_mend
    why = stops(runner)
    assert runner.current_learning_iteration == len(seen) == 4 + PATIENCE
    assert "more than half" in why and "75%" in why and "reward term 'ratio' 12" in why
    assert "skipped" not in why


def test_half_of_the_worlds_may_diverge(make_runner, tmp_path):
    """Two of four worlds are not too many."""
    runner, task = make_runner(tmp_path, **{"runner.logger": "none"})
    task.reward_divisor[2:] = 0.0
    runner.learn(PATIENCE + 1)
    assert runner.current_learning_iteration == PATIENCE + 1


def test_stops_when_all_updates_are_skipped(make_runner, tmp_path):
    """Nothing was learned, nothing was spoiled, and the learning rate is told."""
    runner, _ = make_runner(tmp_path, **{"runner.logger": "none", "algorithm.schedule": "adaptive"})
    before = [parameter.detach().clone() for parameter in runner.alg.actor.parameters()]
    runner.alg.learning_rate.fill_(math.nan)
    why = stops(runner)
    assert runner.current_learning_iteration == PATIENCE
    assert re.search(r"all 10 updates .* 5 iterations were skipped.*\(learning rate nan\)", why) and "half" not in why
    assert all(torch.equal(*pair) for pair in zip(before, runner.alg.actor.parameters(), strict=True))


def test_stops_late_if_some_updates_are_made(make_runner, tmp_path):
    """One iteration with one good minibatch begins the count anew."""
    runner, _ = make_runner(tmp_path, **{"runner.logger": "none"})
    compute, rate = runner.alg.compute_returns, runner.alg.learning_rate

    def compute_and_spoil(obs):
        compute(obs)
        if runner.current_learning_iteration != 2:
            runner.alg.storage.returns.fill_(math.nan)

    runner.alg.compute_returns = compute_and_spoil
    why = stops(runner)
    assert runner.current_learning_iteration == 3 + PATIENCE
    assert f"(learning rate {float(rate):g})" in why


def test_exit_status(make_dividing, tmp_path):
    """The script ends with the reason and status 1, which is not that of a user's mistake, and leaves a checkpoint."""
    words = ["--task=a1_BrokenRobot", "--device=cpu", "--num_envs=2", "--set=algorithm.num_mini_batches=2"]
    status, output, error = run_here("train.py", *words, "--set=runner.num_steps_per_env=4", root=tmp_path)
    assert status == 1 and "The run is in" not in output
    warning, line = error.splitlines()
    assert warning == "Warning: reward term 'ratio' was not finite; resets of worlds for it: 8."
    assert re.fullmatch(r"error: training cannot learn: .*100%; not finite, .*: reward term 'ratio' 8", line)
    assert {file.name for file in tmp_path.glob("logs/*/*/model_*.pt")} == {"model_0.pt", f"model_{PATIENCE}.pt"}
