"""Training itself: every task learns, a checkpoint brings everything back or is refused, and nothing gets lost."""

import errno
import math
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from support.runners import build_runner, networks
from support.settings import COMBINATIONS, TASKS, error_of
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.envs import task_registry
from legged_torque.learning.training_log import WandbWriter
from legged_torque.utils.errors import UserError

WORLDS, STEPS = 4, 4
BATCH = WORLDS * STEPS

MOVING = {
    "control.mixing.update_interval": 24,
    "control.mixing.pd.t_end": 100,
    "rewards.curriculum.tracking_lin_vel.t_end": 100,
    "rewards.curriculum.tracking_ang_vel.t_end": 100,
}
"""Curricula that are under way after two iterations."""


@pytest.fixture(scope="module")
def make_runner(make_task):
    """Factory of small runners, see :func:`support.runners.build_runner`."""

    def make(name="a1_torque_multihead", **settings):
        return build_runner(make_task, name, WORLDS, **settings)

    return make


@pytest.fixture(scope="module")
def saved(make_runner, tmp_path_factory):
    """A runner after two iterations with moving curricula, and the checkpoint that it has left."""
    runner = make_runner(log_root=tmp_path_factory.mktemp("logs"), env=MOVING, **{"runner.logger": "none"})
    runner.learn(2)
    return runner, folder(runner) / "model_2.pt"


def folder(runner):
    """The run's folder."""
    return Path(runner.log_dir)


def copies(tensors):
    """A dictionary of tensors, copied."""
    return {name: value.detach().clone() for name, value in tensors.items()}


@pytest.mark.parametrize("name", [*TASKS, *COMBINATIONS, "a1_rough_position_scan"])
def test_two_iterations_of_every_task(make_runner, tmp_path, name, capsys):
    """Losses are finite, every parameter is learned, and the run's folder holds the checkpoint and the curves."""
    warmup = {"pretraining.critic_warmup_iterations": 0}
    length = 3 * (0.005 if name.endswith("two_rates") else 0.02)  # three control steps
    runner = make_runner(name, log_root=tmp_path, env={"env.episode_length_s": length}, **warmup)
    before = copies(networks(runner))
    runner.learn(2, init_at_random_ep_len=True)
    for key, value in networks(runner).items():
        assert torch.isfinite(value).all()
        assert not torch.equal(value, before[key]), f"{key} has not moved"
    assert runner.current_learning_iteration == 2
    assert int(runner.env.total_steps) == runner.logger.tot_timesteps == 2 * BATCH
    steps = {int(entry["step"]) for entry in runner.alg.optimizer.state_dict()["state"].values()}
    assert steps == {2 * 5 * 2}  # iterations, epochs, minibatches
    files = {path.name.split(".tfevents")[0] for path in tmp_path.glob("*/*") if path.is_file()}
    assert files == {"model_0.pt", "model_2.pt", "worlds_2.pt", "events.out"}
    runner.logger.writer.flush()
    events = EventAccumulator(str(folder(runner))).Reload()
    tags = events.Tags()["scalars"]
    numbers = {tag: [event.value for event in events.Scalars(tag)] for tag in tags}
    assert all(math.isfinite(number) for values in numbers.values() for number in values)
    wanted = {"Loss/value", "Loss/surrogate", "Loss/entropy", "Loss/learning_rate", "Loss/skipped_updates"}
    wanted |= {"Tracking/error_xy", "Tracking/error_yaw", "Health/diverged_worlds", "Train/mean_reward"}
    wanted |= {"Curriculum/weight_tracking_lin_vel", "Perf/total_fps", "Episode_Reward/torques"}
    wanted |= {"Curriculum/mixing_pd", "Curriculum/mixing_torque"} if name.endswith("multihead") else set()
    assert wanted <= numbers.keys()
    assert all(len(numbers[tag]) == 2 for tag in wanted)
    assert numbers["Loss/skipped_updates"] == [0.0, 0.0]
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("iteration 1 of 2, ") and last.startswith("iteration 2 of 2, ") and "; KL 0.0" in last


def test_logs_and_checkpoints_are_of_their_iterations(make_runner, tmp_path):
    """Curves have the numbers of each update at its iteration, though written later; checkpoints count all steps."""
    runner = make_runner(log_root=tmp_path, **{"runner.save_interval": 2})
    update, updates = runner.alg.update, []

    def noted_update():
        updates.append(update())
        return updates[-1]

    runner.alg.update = noted_update
    runner.learn(3)
    runner.logger.writer.flush()
    events = EventAccumulator(str(folder(runner))).Reload()
    names = {"learning_rate": "Loss/learning_rate", "action_std": "Policy/mean_std", "kl": "Loss/kl"}
    for name, tag in names.items():
        curve = [(event.step, event.value) for event in events.Scalars(tag)]
        assert curve == [(i, pytest.approx(numbers[name], rel=1e-6)) for i, numbers in enumerate(updates)]
        assert len({value for _, value in curve}) == 3
    for count in (0, 2, 3):
        infos = torch.load(folder(runner) / f"model_{count}.pt", weights_only=True)["infos"]
        assert infos["total_timesteps"] == count * BATCH


@pytest.mark.parametrize(
    ("capture", "steps", "enabled"), [(True, 4, [True] * 3), (False, 4, [False] * 3), (True, 65, [False, True, True])]
)
def test_capture_is_a_setting(make_runner, tmp_path, capture, steps, enabled):
    """It holds for rollouts, steps and updates, and after loading; rollouts too long for a graph go step by step."""
    runner = make_runner(**{"runner.capture": capture, "runner.num_steps_per_env": steps})
    path = str(tmp_path / "model_0.pt")
    runner.save(path)
    runner.load(path)
    assert [
        graph.enabled for graph in (runner.rollout_graph, runner.env.step_graph, runner.alg.update_graph)
    ] == enabled


def test_rollout_is_stored(make_runner):
    """The storage holds what the policy saw, did and got, step by step, with the value of what a time-out cut off."""
    runner = make_runner(env={"env.episode_length_s": 0.06})
    step, obs, steps_made = runner.env.step, [runner.env.get_observations()], []

    def noted_step(actions):
        result = step(actions)
        obs.append(result[0].clone())
        steps_made.append([tensor.clone() for tensor in (actions, *result[1:3], result[3]["time_outs"])])
        return result

    runner.env.step = noted_step
    runner.collect_rollout()
    storage = runner.alg.storage
    assert len(steps_made) == STEPS and any(time_outs.any() for *_, time_outs in steps_made)
    for i, (actions, rewards, dones, time_outs) in enumerate(steps_made):
        for group in ("policy", "critic"):
            assert torch.equal(storage.observations[group][i], obs[i][group])
        values = runner.alg.critic(obs[i]).detach().squeeze(-1)
        assert torch.equal(storage.actions[i], actions)
        assert torch.equal(storage.dones[i].squeeze(-1).bool(), dones)
        torch.testing.assert_close(storage.rewards[i].squeeze(-1), rewards + 0.98 * values * time_outs)
    assert not torch.equal(obs[0]["policy"], obs[1]["policy"])


def test_mixing_weights_change_between_rollouts_only(make_runner):
    """Every physics step of a rollout uses the weights of eq. 1 at its start."""
    runner = make_runner(env={**MOVING, "control.mixing.update_interval": 1})
    compute, used = runner.env._compute_torques, []

    def noted_compute(actions):
        used.append(float(runner.env.mixing[0]))
        return compute(actions)

    runner.env._compute_torques = noted_compute
    runner.learn(3)
    expected = [1.0 - BATCH * iteration / 100 for iteration in range(3) for _ in range(STEPS * 4)]
    assert used == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("interval", [1, 2, 5])
def test_checkpoints_are_saved_at_every_interval(make_runner, tmp_path, interval):
    """They carry the number of finished iterations; first and last are always there, and nothing half-written."""
    runner = make_runner(log_root=tmp_path, **{"runner.save_interval": interval, "runner.logger": "none"})
    runner.learn(3)
    files = {path.name for path in tmp_path.glob("*/*") if path.is_file()}
    assert files == {f"model_{n}.pt" for n in range(4) if n % interval == 0 or n == 3} | {"worlds_3.pt"}
    for path in tmp_path.glob("*/model_*.pt"):
        assert torch.load(path, weights_only=True)["iter"] == int(path.stem.removeprefix("model_"))


def test_without_a_folder_nothing_is_written(make_runner, tmp_path, monkeypatch):
    """A runner without a log folder trains, and leaves no file behind."""
    monkeypatch.chdir(tmp_path)
    runner = make_runner()
    runner.learn(1)
    assert runner.current_learning_iteration == 1 and not list(tmp_path.iterdir())


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("exists", [True, False])
def test_crash_while_saving(make_runner, tmp_path, monkeypatch, error, exists):
    """If saving dies half-way, the old checkpoint is as it was, and there is none where there was none."""
    runner, path = make_runner(), tmp_path / "model_1.pt"
    if exists:
        runner.save(str(path))
    old = path.read_bytes() if exists else None
    networks(runner)["actor.mlp.trunk.0.bias"].add_(1.0)

    def write_no_more(_):
        raise error

    monkeypatch.setattr(os, "fsync", write_no_more)  # all is written by then, but not yet where it belongs
    with pytest.raises(UserError if isinstance(error, OSError) else KeyboardInterrupt) as end:
        runner.save(str(path))
    if isinstance(error, OSError):
        assert str(end.value) == f"cannot write '{path}': No space left on device"
    assert (path.read_bytes() if path.exists() else None) == old
    monkeypatch.undo()
    runner.save(str(path))
    assert [file.name for file in tmp_path.iterdir()] == ["model_1.pt"]
    loaded = make_runner(seed=3)
    loaded.load(str(path))
    assert all(torch.equal(networks(loaded)[key], value) for key, value in networks(runner).items())


def test_load_brings_everything_back(make_runner, saved):
    """Counters, networks, moments, learning rate, curricula and mixing weights are exactly those of the checkpoint."""
    runner, path = saved
    loaded = make_runner(seed=5, env=MOVING)
    infos = loaded.load(str(path))
    assert infos["total_timesteps"] == loaded.logger.tot_timesteps == 2 * BATCH
    assert loaded.current_learning_iteration == 2
    assert int(loaded.env.total_steps) == 2 * BATCH
    assert all(torch.equal(networks(loaded)[key], value) for key, value in networks(runner).items())
    old, new = (each.alg.optimizer.state_dict()["state"] for each in (runner, loaded))
    assert old.keys() == new.keys() and len(new) == len(list(networks(runner)))
    for index, entry in old.items():
        assert int(new[index]["step"]) == 2 * 5 * 2  # iterations, epochs, minibatches
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(new[index][key], entry[key]) and new[index][key].abs().max() > 0.0
    assert float(loaded.alg.learning_rate) == float(runner.alg.learning_rate) != 1e-3
    assert float(loaded.alg.optimizer.param_groups[0]["lr"]) == float(runner.alg.learning_rate)
    # eq. 1 after 32 of 100 steps; mixing weights move at multiples of 24 steps
    torch.testing.assert_close(loaded.env.mixing, torch.tensor([1.0 - 24 / 100, 1.0]))
    values = {name: float(value) for name, value in loaded.env.curriculum_values().items()}
    assert values == pytest.approx(
        {
            "weight_tracking_lin_vel": 4.0 - 2.0 * 0.32,
            "weight_tracking_ang_vel": 0.1 + 0.9 * 0.32,
            "mixing_pd": 0.76,
            "mixing_torque": 1.0,
        },
        rel=1e-6,
    )


def test_time_of_training_goes_on(make_runner, saved, tmp_path):
    """The seconds that a checkpoint reports are those of all the training so far."""
    _, path = saved
    runner = make_runner(log_root=tmp_path, env=MOVING, **{"runner.logger": "none"})
    before = runner.load(str(path))["seconds"]
    assert before > 0.0
    runner.learn(1)
    assert torch.load(folder(runner) / "model_3.pt", weights_only=True)["infos"]["seconds"] > before


class Foreign:
    """An object that no checkpoint should hold."""


def cut(share):
    """A function that writes the first part of a file."""
    return lambda content, path: path.write_bytes(content[: int(share * len(content))])


BROKEN = {
    "empty": cut(0.0),
    "a tenth": cut(0.1),
    "half": cut(0.5),
    "all but the end": cut(0.9999),
    "text": lambda _, path: path.write_text("this is no checkpoint\n"),
    "foreign object": lambda _, path: torch.save(Foreign(), path),
    "a tensor": lambda _, path: torch.save(torch.zeros(3), path),
    "a number": lambda _, path: torch.save(5, path),
    "no entries": lambda _, path: torch.save({}, path),
    "a folder": lambda _, path: path.mkdir(),
    "nothing": lambda _, path: None,
}


@pytest.mark.parametrize("how", BROKEN)
def test_broken_checkpoint(make_runner, saved, tmp_path, how):
    """A file that is no checkpoint is refused in a line that names it; an unreadable one is not called a misfit."""
    path = tmp_path / "model_2.pt"
    BROKEN[how](saved[1].read_bytes(), path)
    runner = make_runner(seed=5)
    before = copies(networks(runner))
    line = error_of(runner.load, str(path))
    assert str(path) in line
    if how not in ("a tensor", "a number", "no entries"):
        assert "is not a readable checkpoint" in line
    assert all(torch.equal(networks(runner)[key], value) for key, value in before.items())


@pytest.mark.parametrize(
    ("saved_task", "task"), [("a1_position", "a1_multihead"), ("a1_torque_multihead", "a1_torque_curriculum")]
)
def test_checkpoint_of_another_kind_of_policy(make_runner, tmp_path, saved_task, task):
    """A policy with other layers is refused, and the line says that it does not fit."""
    path = tmp_path / "model_0.pt"
    make_runner(saved_task).save(str(path))
    assert error_of(make_runner(task).load, str(path)).startswith(f"checkpoint '{path}' does not fit this task: ")


def test_wandb(monkeypatch, tmp_path):
    """It gets the settings as plain values; its errors become one line."""
    uploaded = {}
    wandb = SimpleNamespace(
        Error=ArithmeticError, config=SimpleNamespace(update=uploaded.update), init=lambda **_: None
    )
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    monkeypatch.setattr("rsl_rl.utils.wandb_log_writer.wandb", wandb)
    WandbWriter(str(tmp_path), "project").store_config(task_registry.get_cfgs("a1_torque")[0], {"seed": 1})
    assert uploaded["env_cfg"]["control"]["torque_scale"] == 8.0 and uploaded["train_cfg"] == {"seed": 1}
    wandb.init = lambda **_: 1 / 0
    with pytest.raises(UserError, match="--logger wandb: division by zero"):
        WandbWriter(str(tmp_path), "project")
