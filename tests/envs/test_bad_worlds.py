"""Numbers that are not finite, of the state or of a user's terms, are reported and reset; trainings end for them."""

import functools
import math
import re
from pathlib import Path

import pytest
import torch
from support.scripts import run_here
from support.settings import build_runner
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.envs import task_registry
from legged_torque.envs.approaches.torque_curriculum import TorqueCurriculumRobot
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.envs.tasks import A1TorqueCurriculumCfg, A1TorqueCurriculumCfgPPO
from legged_torque.learning.guard import PATIENCE
from legged_torque.utils.errors import TrainingError
from legged_torque.utils.mirroring import SCALAR

TASK = "a1_torque_curriculum"  # the one with the most reward terms
WORLDS, STEPS = 3, 10
RANDOM = {"domain_rand.randomize_parameters": True}
FIXED = {"domain_rand.randomize_parameters": False}
HISTORY = {"env.history_length": 3, "motors.delay.range": [1, 6], "sensing.delay.range": [1, 6]}
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
DRAWN_BUFFERS = {
    "body_mass": lambda task: task.sim.fields["body_mass"],
    "geom_solref": lambda task: task.sim.fields["geom_solref"].flatten(1),
    "gravity": lambda task: task.sim.fields["gravity"],
}
DELAYED_BUFFERS = {
    "delay.drawn": lambda task: task.motors.links["delay"].queue.drawn,
    "delay.before": lambda task: task.motors.links["delay"].queue.before[:, 0],
    "sensing.before": lambda task: task.sensors.sensing.queue.before[:, 0],
    "observation_history": lambda task: task.obs_buf["policy"][:, -1:],
}


class Run:
    """Four steps as warm-up, one in which something may be broken, and ten more, under the same random actions."""

    def __init__(self, make_task, break_state=None, break_action=None, **overrides):
        """Run a new task; the functions get the task or the actions before the fifth step."""
        self.task = task = make_task(TASK, WORLDS, seed=3, **overrides)
        generator = torch.Generator().manual_seed(7)
        task.base_pos[:, 2] = 0.3  # on the ground soon, so that warm starts matter
        self.records = []
        for step in range(5 + STEPS):
            actions = torch.randn(WORLDS, 12, generator=generator)
            if step == 4:
                assert task.num_diverged.item() == 0 and task.log.read(1.0)["Health/diverged_worlds"] == 0.0
                if break_state:
                    break_state(task)
                if break_action:
                    break_action(actions)
            obs, rewards, dones, extras = task.step(actions)
            if step >= 4:
                state = torch.cat([task.sim.qpos, task.sim.qvel, task.sim.qacc_warmstart, task.commands], dim=1)
                record = {"state": state, "rewards": rewards, "dones": dones, "time_outs": extras["time_outs"], **obs}
                record |= {"episode_length": task.episode_length_buf, "contacts": task.contacts}
                record |= {"forces": task.sim.contact_force, "num_diverged": task.num_diverged.expand(WORLDS)}
                self.records.append({name: value.clone() for name, value in record.items()})


def check(run, healthy, broken):
    """Compare a run in which the worlds ``broken`` were broken before the first recorded step with the healthy one."""
    others = [world for world in range(WORLDS) if world not in broken]
    for step, (record, expected) in enumerate(zip(run.records, healthy.records, strict=True)):
        for name, value in record.items():
            assert torch.isfinite(value).all(), (step, name)
            if name != "num_diverged":
                assert torch.equal(value[others], expected[name][others]), (step, name)
        assert (record["num_diverged"] == len(broken)).all(), step
    first = run.records[0]
    for world in broken:
        assert first["dones"][world] and not first["time_outs"][world]
        assert first["rewards"][world] == 0.0 and first["episode_length"][world] == 0
        assert first["state"][world, :3].tolist() == pytest.approx([0.0, 0.0, 0.4])  # a new start, at rest
        assert first["state"][world, 3:7].norm().item() == pytest.approx(1.0, abs=1e-5)
        assert (first["state"][world, 19:55] == 0).all()  # velocities and warm start
        assert run.records[-1]["episode_length"][world] == STEPS  # and no second reset
    log = run.task.log.read(1.0)
    assert log["Health/diverged_worlds"] == len(broken)
    assert all(math.isfinite(value) for value in log.values())


@pytest.fixture(scope="module")
def healthy(make_task):
    """The runs in which nothing is broken, by their settings."""
    return [(overrides, Run(make_task, **overrides)) for overrides in (FIXED, RANDOM, HISTORY)]


def reported(task):
    """Names of the tensors that the task reports as not finite, each with its number of worlds."""
    return {str(tensor): count for tensor, count in task.health.read()[1].items()}


CASES = [(0, name, buffer, math.inf) for name, buffer in BUFFERS.items()]
CASES += [(1, name, buffer, math.nan) for name, buffer in {**BUFFERS, **DRAWN_BUFFERS}.items()]
CASES += [(2, name, buffer, math.nan) for name, buffer in DELAYED_BUFFERS.items()]


@pytest.mark.parametrize(("settings", "name", "buffer", "value"), CASES)
def test_bad_buffer(make_task, healthy, settings, name, buffer, value):
    """The world starts anew, drawn or not drawn, with history and delay or without, and the buffer is reported once."""
    overrides, expected = healthy[settings]

    def break_state(task):
        buffer(task)[1, -1] = value

    run = Run(make_task, break_state=break_state, **overrides)
    check(run, expected, [1])
    assert torch.isfinite(buffer(run.task)).all()
    assert reported(run.task) == {f"buffer '{name}'": 1}
    if overrides == FIXED:
        assert torch.equal(run.task.p_gains[1], run.task.p_gains[0])
        assert (run.task.motor_strength == 1.0).all() and (run.task.joint_offset == 0.0).all()


@pytest.mark.parametrize("field", ["qpos", "qvel", "qacc_warmstart"])
@pytest.mark.parametrize("value", [math.nan, 1e30])
def test_bad_state(make_task, healthy, field, value):
    """One bad number in the state ends the episode of its world, and no buffer is reported for it."""

    def break_state(task):
        getattr(task.sim, field)[1, 9] = value

    run = Run(make_task, break_state=break_state)
    check(run, healthy[0][1], [1])
    assert reported(run.task) == {}


def test_all_worlds_bad(make_task, healthy):
    """With every world broken in its own way, all start anew."""
    contacts = torch.stack([record["contacts"] for record in healthy[0][1].records])
    assert contacts.any(dim=0).any(dim=1).all()  # in the healthy run all worlds touch the ground

    def break_state(task):
        task.sim.qpos[0] = math.nan
        task.sim.qvel[1] = math.inf
        task.sim.qacc_warmstart[2] = -1e30

    check(Run(make_task, break_state=break_state), healthy[0][1], [0, 1, 2])


@pytest.mark.parametrize("value", [math.nan, -math.inf, 1e30])
def test_bad_action(make_task, healthy, value):
    """An action that is not finite resets its world and is reported; a huge finite one is only clipped."""

    def break_action(actions):
        actions[1, 4] = value

    run = Run(make_task, break_action=break_action)
    if math.isfinite(value):
        assert run.task.num_diverged.item() == 0 and reported(run.task) == {}
        assert all(torch.isfinite(value).all() for record in run.records for value in record.values())
    else:
        check(run, healthy[0][1], [1])
        assert reported(run.task) == {"buffer 'actions'": 1}


def test_divergence_during_the_physics(make_task):
    """A state of possible numbers that explodes within the step is found at its end."""
    task = make_task(TASK, WORLDS)
    task.sim.qvel[1, 3:6] = 9e3  # each number is below the limit of a valid state
    task.sim.qvel[1, 6:] = -9e3
    obs, rewards, dones, _ = task.step(torch.zeros(WORLDS, 12))
    assert dones.tolist() == [False, True, False] and task.num_diverged.item() == 1
    assert torch.isfinite(obs["critic"]).all() and torch.isfinite(rewards).all() and rewards[1] == 0.0
    assert torch.isfinite(task.sim.qpos).all() and (task.sim.qvel[1] == 0).all()


class DividingRobot(TorqueCurriculumRobot):
    """A robot whose reward or observation divides by zero in some worlds, and which keeps tensors of its own."""

    def _init_buffers(self):
        """Add the divisors."""
        super()._init_buffers()
        self.mean = self.keep("actions", torch.full((self.num_envs,), 0.5))
        self.nearest = self.keep("nearest", torch.full((self.num_envs, 2), math.inf))
        self.count = self.keep("count", torch.full((self.num_envs,), -1))  # NaN, if it were read as a float
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


def test_reward_that_divides_by_zero(make_dividing):
    """The episode ends in the same step, without a reward, in every step in which the term is not finite."""
    expected = steps(make_dividing(WORLDS))
    task = make_dividing(WORLDS)
    task.reward_divisor[1] = 0.0
    results = steps(task, 3)
    assert_finite_and_same(results, expected[:3], [0, 2])
    for _, _, rewards, dones, time_outs in results:
        assert dones[1] and rewards[1] == 0.0 and not time_outs[1]
    assert reported(task) == {"reward term 'ratio'": 3} and task.num_diverged == 3
    assert task.log.read(1.0)["Health/diverged_worlds"] == 3.0
    task.reward_divisor[1] = 1.0
    *_, rewards, dones, _ = steps(task, 1)[0]
    assert not dones[1] and rewards[1] > 0.0 and reported(task) == {}
    assert task.episode_return[1] == rewards[1] and task.episode_length_buf[1] == 1


def test_a_tensor_of_ones_own(make_dividing):
    """What a task keeps is reported and mended once, but for integers and for what is infinite from the start."""
    task = make_dividing(WORLDS)
    task.mean[1] = math.nan
    results = steps(task, 2)
    assert [result[3].tolist() for result in results] == [[False, True, False], [False] * 3]
    assert reported(task) == {"buffer 'task.actions'": 1} and task.mean.tolist() == [0.5] * 3
    task.step(torch.tensor([0.0, math.nan, 0.0]).unsqueeze(1).expand(-1, 12))  # whose own name that is
    assert reported(task) == {"buffer 'actions'": 1}
    assert task.nearest.isinf().all() and (task.count == -1).all()


def test_bad_reward_is_no_time_out(make_dividing):
    """An episode that ends for both reasons is terminated: no value is bootstrapped."""
    task = make_dividing(WORLDS)
    task.episode_length_buf = torch.full((WORLDS,), task.max_episode_length - 1)
    task.reward_divisor[1] = 0.0
    *_, dones, time_outs = steps(task, 1)[0]
    assert dones.all() and time_outs.tolist() == [True, False, True]


def test_observation_that_divides_by_zero(make_dividing):
    """The policy sees 0 instead, and the world is reset in the step after, with its history."""
    overrides = {"env.history_length": 3}
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
    assert reported(task)["observation 'ratio'"] == 1
    assert not steps(task, 1)[0][3].any() and reported(task) == {}


@pytest.fixture
def make_runner(make_task, make_dividing):
    """Factory of trainings of such tasks, in which no learning rate changes, and the task."""

    def make(log_root, **overrides):
        settings = {"algorithm.schedule": "fixed", **overrides}
        runner = build_runner(make_task, "a1_DividingRobot", log_root=log_root, **settings)
        return runner, runner.env

    return make


def test_training_with_a_bad_world(make_runner, tmp_path, capsys):
    """Half of the worlds may diverge; there is one warning, and the number is logged in every iteration."""
    runner, task = make_runner(tmp_path)
    task.reward_divisor[2:] = 0.0
    runner.learn(PATIENCE + 1)
    lines = [line for line in capsys.readouterr().err.splitlines() if "not finite;" in line]
    assert lines == ["Warning: reward term 'ratio' was not finite; resets of worlds for it: 8."]
    for tensor in runner.alg.actor.parameters():
        assert torch.isfinite(tensor).all()
    events = EventAccumulator(runner.log_dir).Reload()
    values = {tag: [event.value for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    assert values["Loss/skipped_updates"] == [0.0] * (PATIENCE + 1)
    assert values["Health/not_finite/reward_ratio"] == values["Health/diverged_worlds"] == [8.0] * (PATIENCE + 1)
    page = (Path(__file__).parents[2] / "docs/reference/logs.md").read_text()
    assert "`Health/not_finite/<kind>_<name>`" in page
    assert {tag for tag in values if "not_finite" in tag} == {"Health/not_finite/reward_ratio"}


def stops(runner, iterations=100):
    """Train until the training ends by itself; return the reason."""
    with pytest.raises(TrainingError) as error:
        runner.learn(iterations)
    assert "\n" not in str(error.value)
    assert (Path(runner.log_dir) / f"model_{runner.current_learning_iteration}.pt").is_file()
    return str(error.value)


def test_stops_when_most_worlds_diverge(make_runner, tmp_path):
    """Three of four worlds are too many; the number of iterations in a row counts."""
    runner, task = make_runner(tmp_path, **{"runner.logger": "none"})
    update, seen = runner.alg.update, []

    def update_and_repair():
        seen.append(runner.current_learning_iteration)
        task.reward_divisor[1:] = 1.0 if len(seen) == 3 else 0.0  # the fourth iteration is a good one
        return update()

    task.reward_divisor[1:] = 0.0
    runner.alg.update = update_and_repair
    why = stops(runner)
    assert runner.current_learning_iteration == len(seen) == 4 + PATIENCE
    assert "more than half" in why and "75%" in why and "reward term 'ratio' 12" in why
    assert "skipped" not in why


def test_stops_when_all_updates_are_skipped(make_runner, tmp_path):
    """The networks are unchanged, and the reason names the learning rate."""
    runner, _ = make_runner(tmp_path, **{"runner.logger": "none", "algorithm.schedule": "adaptive"})
    before = [parameter.detach().clone() for parameter in runner.alg.actor.parameters()]
    runner.alg.learning_rate.fill_(math.nan)
    why = stops(runner)
    assert runner.current_learning_iteration == PATIENCE
    assert re.search(r"all 10 updates .* 5 iterations were skipped.*\(learning rate nan\)", why) and "half" not in why
    assert all(torch.equal(*pair) for pair in zip(before, runner.alg.actor.parameters(), strict=True))


def test_exit_status(make_dividing, tmp_path):
    """The script ends with the reason and status 1, unlike for a user's mistake, and keeps a checkpoint."""
    words = ["--task=a1_BrokenRobot", "--device=cpu", "--num_envs=2", "--set=algorithm.num_mini_batches=2"]
    status, output, error = run_here("train.py", *words, "--set=runner.num_steps_per_env=4", root=tmp_path)
    assert status == 1 and "The run is in" not in output
    warning, line = error.splitlines()
    assert warning == "Warning: reward term 'ratio' was not finite; resets of worlds for it: 8."
    assert re.fullmatch(r"error: training cannot learn: .*100%; not finite, .*: reward term 'ratio' 8", line)
    assert {file.name for file in tmp_path.glob("logs/*/*/model_*.pt")} == {"model_0.pt", f"model_{PATIENCE}.pt"}
