"""A broken world is reset and counted, and nobody else notices; counters and curricula survive a checkpoint."""

import math

import pytest
import torch
from support.bad_worlds import TASK, WORLDS, Run, check

BAD_VALUES = [math.nan, math.inf, 1e30]


@pytest.fixture(scope="module")
def healthy(make_task):
    """The run in which nothing is broken."""
    run = Run(make_task)
    assert torch.stack([record["contacts"] for record in run.records]).any(dim=0).any(dim=1).all()
    assert run.task.num_diverged.item() == 0
    return run


@pytest.mark.parametrize("value", BAD_VALUES)
@pytest.mark.parametrize(
    ("field", "world", "entries"),
    [
        ("qpos", 0, 4),  # of the quaternion
        ("qpos", 2, slice(None)),
        ("qvel", 1, 17),
        ("qacc_warmstart", 2, 2),
        ("qacc_warmstart", 0, slice(None)),
    ],
)
def test_bad_state(make_task, healthy, field, world, entries, value):
    """Bad numbers in one world's state cost that world its episode and change no bit of the others."""

    def break_state(task):
        getattr(task.sim, field)[world, entries] = value

    check(Run(make_task, break_state=break_state), healthy, [world])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_bad_action(make_task, healthy, value):
    """An action that is not finite resets its world, and is counted like a bad state."""

    def break_action(actions):
        actions[1, 4] = value

    check(Run(make_task, break_action=break_action), healthy, [1])


def test_all_worlds_bad(make_task, healthy):
    """With every world broken in its own way, all start anew."""

    def break_state(task):
        task.sim.qpos[0] = math.nan
        task.sim.qvel[1] = math.inf
        task.sim.qacc_warmstart[2] = -1e30

    check(Run(make_task, break_state=break_state), healthy, [0, 1, 2])


def test_huge_finite_action_is_no_divergence(make_task, healthy):
    """A finite action, however large, is clipped, not taken for divergence."""

    def break_action(actions):
        actions[1] = 1e30

    run = Run(make_task, break_action=break_action)
    assert run.task.num_diverged.item() == 0
    for record, expected in zip(run.records, healthy.records, strict=True):
        assert all(torch.isfinite(value).all() for value in record.values())
        assert torch.equal(record["state"][[0, 2]], expected["state"][[0, 2]])


def test_divergence_during_the_physics(make_task):
    """A state that looks sane and explodes within the step is caught at its end."""
    task = make_task(TASK, WORLDS)
    task.sim.qvel[1, 3:6] = 9e3  # each number is below the limit of what is believed, their effect is not
    task.sim.qvel[1, 6:] = -9e3
    obs, rewards, dones, _ = task.step(torch.zeros(WORLDS, 12))
    assert dones.tolist() == [False, True, False] and task.num_diverged.item() == 1
    assert torch.isfinite(obs["critic"]).all() and torch.isfinite(rewards).all() and rewards[1] == 0.0
    assert torch.isfinite(task.sim.qpos).all() and (task.sim.qvel[1] == 0).all()


# --------------------------------------------------------------------------------------------------- checkpoints


@pytest.mark.parametrize("name", ["a1_torque_curriculum", "a1_torque_multihead", "a1_multihead"])
def test_state_dict_round_trip(make_task, name):
    """A task that loads another's state has its counters, weights and mixing, and counts on from there."""
    task = make_task(name, 2)
    task.total_steps.fill_(4_321_098)
    task.sim.qpos[1, 0] = math.nan
    task.step(torch.zeros(2, task.num_actions))
    task.update_curriculum()
    state = task.state_dict()
    task.step(torch.zeros(2, task.num_actions))  # must not change what was saved
    other = make_task(name, 3)
    other.load_state_dict(state)
    assert other.total_steps.item() == 4_321_100 and other.num_diverged.item() == 1
    share = 4_321_100 / 10e6
    expected = {"weight_tracking_lin_vel": 4 - 2 * share, "weight_tracking_ang_vel": 0.1 + 0.9 * share}
    if name == "a1_torque_curriculum":
        share = 1_321_100 / 10e6
        expected = {
            "weight_tracking_lin_vel": 4 - 2 * share,
            "weight_tracking_ang_vel": 0.1 + 0.9 * share,
            "weight_nominal_position": 20 - 19 * 4_321_100 / 5e6,
        }
    else:
        end = {"a1_torque_multihead": 0.0, "a1_multihead": 0.1}[name]
        expected |= {"mixing_pd": 1 + (end - 1) * 67 * 64_000 / 50e6, "mixing_torque": 1.0}
    values = {key: value.item() for key, value in other.curriculum_values().items()}
    assert values == pytest.approx(expected, rel=1e-6)
    other.step(torch.zeros(3, other.num_actions))
    assert other.total_steps.item() == 4_321_103


def test_state_dict_survives_a_file(make_task, tmp_path):
    """The state is tensors only: it can be loaded from a checkpoint that may hold nothing else."""
    task = make_task("a1_multihead", 1)
    task.total_steps.fill_(123_456_789_012)
    torch.save(task.state_dict(), tmp_path / "state.pt")
    other = make_task("a1_multihead", 1)
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert other.total_steps.item() == 123_456_789_012
    assert other.mixing.tolist() == pytest.approx([0.1, 1.0])
