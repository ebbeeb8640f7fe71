"""The reward terms of Table III by hand, their weights, some of which change in a training, and their sum."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from support.control import JOINTS, LEGS, SENSED
from support.settings import TASKS

TABLES = yaml.safe_load(Path(__file__).with_name("rewards.yaml").read_text("utf-8"))
TABLE_III = TABLES["weights"]


def contact_flags(*names):
    """One world's contact flags with the named geoms on the ground."""
    return torch.tensor([1.0 if name in names else 0.0 for name in SENSED])


def neutral(task):
    """Put all worlds into the state in which every term is 0 but the two of tracking, which are 1."""
    for tensor in (task.commands, task.base_lin_vel, task.sim.qvel, task.last_dof_vel, task.torques, task.contacts):
        tensor.zero_()
    for tensor in (task.last_actions, task.actions):
        tensor.zero_()
    task.projected_gravity[:] = torch.tensor([0.0, 0.0, -1.0])
    task.dof_pos[:] = task.default_dof_pos
    task.base_pos[:] = torch.tensor([7.0, 8.0, 0.303])
    task.feet_contact.fill_(1.0)
    task.feet_air_time.fill_(0.5)
    task.sim.diverged.zero_()


VALUES = {term: value for term, (value, _) in TABLES["cases"].items()}
NEUTRAL_VALUE = {"tracking_lin_vel": 1.0, "tracking_ang_vel": 1.0, "nominal_position": 1.0}


def construct(task, world, term):
    """Put a world into the state of a term."""
    for name, values in TABLES["cases"][term][1].items():
        if isinstance(values, dict):
            place = task.dof_pos if name == "angles" else getattr(task, name)
            for joint, value in values.items():
                place[world, JOINTS.index(joint)] = value
        else:
            is_flags = isinstance(values[0], str)
            getattr(task, name)[world] = contact_flags(*values) if is_flags else torch.tensor(values)


@pytest.fixture
def task(make_task):
    """The curriculum task, which has every term there is, in the neutral state."""
    task = make_task("a1_torque_curriculum", 3)
    neutral(task)
    return task


@pytest.mark.parametrize("term", VALUES)
def test_term_by_hand(task, term):
    """A term has its by-hand value in the world that was put into its state, and its neutral value in the others."""
    construct(task, 1, term)
    rest = NEUTRAL_VALUE.get(term, 0.0)
    value = getattr(task, f"_reward_{term}")()
    np.testing.assert_allclose(value, [rest, VALUES[term], rest], rtol=2e-5, atol=1e-6)


def test_collision_counts_every_leg(task):
    """Each calf and each thigh counts once, each hip and foot not at all."""
    task.contacts[:] = 1.0
    assert task._reward_collision().tolist() == [9.0] * 3  # the trunk is the ninth
    task.contacts[:] = contact_flags(*(f"{leg}_{part}" for leg in LEGS for part in ("hip", "foot")))
    assert task._reward_collision().tolist() == [0.0] * 3


def test_temperatures(make_task):
    """The tracking and nominal-position temperatures are settings."""
    task = make_task(
        "a1_torque_curriculum", 1, **{"rewards.tracking_temperature": 1.0, "rewards.nominal_position_temperature": 2.0}
    )
    neutral(task)
    for term, expected in (("tracking_lin_vel", -0.3125), ("tracking_ang_vel", -0.25), ("nominal_position", -3.6)):
        neutral(task)
        construct(task, 0, term)
        assert getattr(task, f"_reward_{term}")().item() == pytest.approx(math.exp(expected), rel=1e-5)


@pytest.mark.parametrize("decimation", [4, 2])
@pytest.mark.parametrize("name", TASKS)
def test_weights_of_table_iii(make_task, name, decimation):
    """At the start, every weight is that of Table III times the control step; the curriculum task has one more."""
    task = make_task(name, 1, **{"control.decimation": decimation})
    expected = dict(TABLE_III)
    if name == "a1_torque_curriculum":
        expected["nominal_position"] = 20.0
    weights = dict(zip(task.reward_names, task.reward_weights().tolist(), strict=True))
    assert weights == pytest.approx({term: 0.005 * decimation * weight for term, weight in expected.items()}, rel=1e-6)


def test_reward_is_the_weighted_sum(make_task):
    """With all terms in action at once the reward is the sum over Table III, times Delta t = 0.02 s."""
    task = make_task("a1_position", 2)
    neutral(task)
    values = {term: VALUES[term] for term in TABLE_III}
    for term in TABLE_III:
        if term not in ("lin_vel_z", "tracking_ang_vel", "ang_vel_xy", "symmetry"):
            construct(task, 1, term)
    task.base_lin_vel[1, 2] = -0.3  # the other states of velocity, together
    task.commands[1, 2], task.sim.qvel[1, 3:6] = 0.75, torch.tensor([3.0, -4.0, 0.25])
    values["symmetry"] = 0.0  # the state of the air time has three feet on the ground
    task.compute_reward()
    np.testing.assert_allclose(task.rew_buf, [0.02 * (4.0 + 0.1), 0.0], rtol=1e-5)
    parts = {term: 0.02 * TABLE_III[term] * value for term, value in values.items()}
    assert sum(parts.values()) < -0.1
    terms = dict(zip(task.reward_names, task.rewards.terms[:, 1].tolist(), strict=True))
    assert terms == pytest.approx(parts, rel=2e-5, abs=1e-9)


@pytest.mark.parametrize(
    ("height", "clip", "expected"),
    [(0.403, True, 0.02 * (4.1 - 30 * 0.01)), (0.703, True, 0.0), (0.703, False, 0.02 * (4.1 - 30 * 0.16))],
)
def test_negative_sums_are_clipped(make_task, height, clip, expected):
    """A negative sum becomes 0 and a positive one stays, unless clipping is switched off."""
    task = make_task("a1_torque", 1, **{"rewards.only_positive_rewards": clip})
    neutral(task)
    task.base_pos[:, 2] = height
    task.compute_reward()
    assert task.rew_buf.item() == pytest.approx(expected, rel=1e-4, abs=1e-9)


@pytest.mark.parametrize(("name", "term", "start", "end", "t_start", "t_end"), TABLES["curricula"])
def test_reward_curricula(make_task, name, term, start, end, t_start, t_end):
    """A weight follows eq. 1: constant before and after its knots, on the straight line between them."""
    task = make_task(name, 1)
    index = task.reward_names.index(term)
    points = [(0, start), (t_start, start), (t_end, end), (t_end + 1, end), (110, end)]
    points += [(t_start + share * (t_end - t_start), start + share * (end - start)) for share in (0.125, 0.5, 0.75)]
    for millions, expected in points:
        task.total_steps.fill_(int(millions * 1e6))
        assert task.reward_weights()[index].item() == pytest.approx(0.02 * expected, rel=1e-6), millions
        assert task.curriculum_values()[f"weight_{term}"].item() == pytest.approx(expected, rel=1e-6), millions


def test_curricula_count_the_steps_of_all_worlds(make_task):
    """t of eq. 1 grows by the number of worlds with each step, and the step's own reward already uses it."""
    task = make_task(
        "a1_torque", 3, **{"rewards.curriculum.tracking_lin_vel.t_end": 12, "commands.resampling_probability": 0.0}
    )
    tracking = task.reward_names.index("tracking_lin_vel")
    assert task.total_steps.item() == 0
    for step, weight in enumerate((3.5, 3.0, 2.5, 2.0, 2.0), start=1):
        before = task.episode_sums[tracking].clone()
        task.step(torch.zeros(3, 12))
        assert task.total_steps.item() == 3 * step
        gained = (task.episode_sums[tracking] - before) / 0.02
        np.testing.assert_allclose(gained, weight * task._reward_tracking_lin_vel(), rtol=1e-4, atol=1e-6)
