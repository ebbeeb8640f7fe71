"""Training itself: every task learns, a checkpoint brings everything back or is refused, and nothing gets lost."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from rsl_rl.models import MLPModel
from support.settings import COMBINATIONS, TASKS, build_runner, error_of, get_cfgs, networks
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from legged_torque.envs import task_registry
from legged_torque.learning import checkpoint

WORLDS, STEPS = 4, 4
BATCH = WORLDS * STEPS


@pytest.fixture(scope="module")
def make_runner(make_task):
    """Factory of small runners, see :func:`support.settings.build_runner`."""

    def make(name="a1_torque_multihead", **settings):
        return build_runner(make_task, name, WORLDS, **settings)

    return make


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
    length = 3 * (0.005 if name.endswith(("two_rates", "sata")) else 0.02)  # three control steps
    env = {"env.episode_length_s": length}
    if name in ("a1_decap", "a1_variable_stiffness"):
        env["control.refresh_torques"] = False  # with the kernel that others have compiled
    runner = make_runner(name, log_root=tmp_path, env=env, **warmup)
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
    *_, first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("iteration 1 of 2, ") and last.startswith("iteration 2 of 2, ") and "; KL 0.0" in last


def test_logs_and_checkpoints_are_of_their_iterations(make_runner, tmp_path):
    """Curves have each update's numbers at its iteration; checkpoints count all steps and seconds so far."""
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
    runner.learn(2)
    assert {path.name for path in folder(runner).glob("*.pt")} == {
        "worlds_5.pt",
        *(f"model_{i}.pt" for i in (0, 2, 3, 4, 5)),
    }
    states = [torch.load(folder(runner) / f"model_{i}.pt", weights_only=True) for i in (0, 2, 3, 4, 5)]
    assert [state["iter"] for state in states] == [0, 2, 3, 4, 5]
    assert [state["infos"]["total_timesteps"] for state in states] == [BATCH * state["iter"] for state in states]
    assert all(one["infos"]["seconds"] < next_one["infos"]["seconds"] for one, next_one in pairwise(states))


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


class Gained(MLPModel):
    """An actor that takes no further settings."""


def with_images_alone(env, obs, actions):
    """Observations and their images, without images of actions."""
    return torch.cat([obs, obs]), actions


def test_classes_that_do_not_fit(make_task, make_runner, tmp_path):
    """Settings that a class does not take, and functions that mirror observations alone, are refused by name."""
    _, cfg = get_cfgs("--task=a1_position")

    class Actor(type(cfg.actor)):
        class_name = f"{__name__}:Gained"
        gain: float = 1.0

    cfg.actor = Actor()
    line = error_of(task_registry.make_alg_runner, make_task("a1_position", 4), train_cfg=cfg, log_root=None)
    assert line.startswith("algorithm, actor or critic: ") and "'gain'" in line
    images = {
        "use_data_augmentation": True,
        "use_equivariant_networks": False,
        "data_augmentation_func": f"{__name__}:with_images_alone",
    }
    images = {f"algorithm.symmetry_cfg.{name}": value for name, value in images.items()}
    line = error_of(make_runner, "a1_position", log_root=tmp_path, **images)
    assert line == "symmetry_cfg.data_augmentation_func must return as many actions as observations"
    assert not list(tmp_path.iterdir())


def test_what_no_checkpoint_may_hold(tmp_path):
    """A file that would not load again is not written."""
    for other in (np.float64(0.5), np.zeros(2), {1, 2}, object()):
        line = error_of(checkpoint.write, tmp_path / "model.pt", {"state": [torch.zeros(2), {"loss": other}]})
        assert line.endswith(f"takes tensors and plain values only, not {type(other).__name__}")
    assert not list(tmp_path.iterdir())


def test_checkpoints_that_do_not_fit(make_runner, tmp_path):
    """A policy with other layers, and a file without one, are refused, and no network changes."""
    path, runner = tmp_path / "model_0.pt", make_runner("a1_multihead")
    before = copies(networks(runner))
    for save in (make_runner("a1_position").save, lambda file: torch.save({}, file)):
        save(str(path))
        assert str(path) in error_of(runner.load, str(path))
    assert all(torch.equal(networks(runner)[key], value) for key, value in before.items())
