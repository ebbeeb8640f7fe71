"""The reward terms of Table III by hand, their weights, some of which change in a training, and their sum."""

import math

import numpy as np
import pytest
import torch
from support.rewards import TABLE_III
from support.settings import TASKS

LEGS = ("FR", "FL", "RR", "RL")
SENSED = ["trunk", *(f"{leg}_{part}" for leg in LEGS for part in ("hip", "thigh", "calf", "foot"))]
JOINTS = [f"{leg}_{link}" for leg in LEGS for link in ("hip", "thigh", "calf")]


THIGH_LOW = (4.18879 - 1.0472) / 2 - 0.9 * (4.18879 + 1.0472) / 2  # soft limits: 90% of the ranges in section 3
CALF_HIGH = (-2.69653 - 0.916298) / 2 + 0.9 * (2.69653 - 0.916298) / 2


def contact_flags(*names):
    """One world's contact flags with the named geoms on the ground."""
    return torch.tensor([1.0 if name in names else 0.0 for name in SENSED])


def joints(**values):
    """One number per joint: those given, else 0."""
    return torch.tensor([values.get(name, 0.0) for name in JOINTS])


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


CASES = {
    # an error of (0.25, -0.5) m/s, the vertical velocity does not count: exp(-4 * 0.3125)
    "tracking_lin_vel": ({"commands": [0.5, -0.25, 9.0], "base_lin_vel": [0.25, 0.25, 9.0]}, 0.2865048),
    # a yaw rate error of 0.5 rad/s, the other axes do not count: exp(-4 * 0.25)
    "tracking_ang_vel": ({"commands": [9.0, 9.0, 0.75], "base_ang_vel": [9.0, 9.0, 0.25]}, 0.3678794),
    "lin_vel_z": ({"base_lin_vel": [9.0, 9.0, -0.3]}, 0.09),
    "ang_vel_xy": ({"base_ang_vel": [3.0, -4.0, 9.0]}, 25.0),
    "orientation": ({"projected_gravity": [0.48, -0.36, -0.8]}, 0.36),
    # 0.05 above a hip's soft limit, 0.01 below another's, 0.1 below a thigh's, 0.02 above a calf's; RL_hip is within
    "dof_pos_limits": (
        {
            "FR_hip": 0.9 * 0.802851 + 0.05,
            "FL_hip": -0.9 * 0.802851 - 0.01,
            "RL_hip": 0.9 * 0.802851 - 0.05,
            "FL_thigh": THIGH_LOW - 0.1,
            "RL_calf": CALF_HIGH + 0.02,
        },
        0.18,
    ),
    # changes by 0.1 and -0.2 rad/s in 0.02 s: 5^2 + 10^2
    "dof_acc": ({"last_dof_vel": joints(FL_hip=1.0, RL_calf=2.0), "dof_vel": joints(FL_hip=1.1, RL_calf=1.8)}, 125.0),
    "torques": ({"torques": joints(FR_hip=3.0, RL_calf=-4.0)}, 25.0),
    "action_rate": (
        {"last_actions": joints(FR_hip=1.0, RR_thigh=0.25), "actions": joints(FR_hip=-1.0, RR_thigh=0.75)},
        4.25,
    ),
    # a trunk, a calf and two thighs on the ground; feet do not count
    "collision": ({"contacts": contact_flags("trunk", "FR_calf", "FL_thigh", "RL_thigh", "RL_foot", "FR_foot")}, 4.0),
    "base_height": ({"base_pos": [7.0, 8.0, 0.203]}, 0.01),
    # swings of 0.75 s and 0.3 s have ended, one foot has been down all the time, one flies: 0.25 - 0.2 - 0.5
    "feet_air_time": ({"feet_contact": [1.0, 1.0, 1.0, 0.0], "feet_air_time": [0.75, 0.3, 0.0, 0.9]}, -0.45),
    # both front feet in the air and one rear foot: one pair
    "symmetry": ({"feet_contact": [0.0, 0.0, 0.0, 1.0]}, 1.0),
    # deviations of 0.6 and 1.2 rad from -0.1 and -1.5: exp(-0.5 * 1.8)
    "nominal_position": ({"FR_hip": 0.5, "RR_calf": -2.7}, 0.4065697),
}
"""For each term a state of the task, by attributes and by angles of joints, and its value in it."""
NEUTRAL_VALUE = {"tracking_lin_vel": 1.0, "tracking_ang_vel": 1.0, "nominal_position": 1.0}


def construct(task, world, term):
    """Put a world into the state of a term."""
    for name, values in CASES[term][0].items():
        if name in JOINTS:
            task.dof_pos[world, JOINTS.index(name)] = values
        else:
            getattr(task, name)[world] = torch.as_tensor(values)


@pytest.fixture
def task(make_task):
    """The curriculum task, which has every term there is, in the neutral state."""
    task = make_task("a1_torque_curriculum", 3)
    neutral(task)
    return task


@pytest.mark.parametrize("term", CASES)
def test_term_by_hand(task, term):
    """A term has its by-hand value in the world that was put into its state, and its neutral value in the others."""
    construct(task, 1, term)
    rest = NEUTRAL_VALUE.get(term, 0.0)
    value = getattr(task, f"_reward_{term}")()
    np.testing.assert_allclose(value, [rest, CASES[term][1], rest], rtol=2e-5, atol=1e-6)


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
    values = {term: CASES[term][1] for term in TABLE_III}
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


MILLION = 1_000_000


@pytest.mark.parametrize(
    ("name", "term", "start", "end", "t_start", "t_end"),
    [
        ("a1_position", "tracking_lin_vel", 4.0, 2.0, 0, 10),
        ("a1_position", "tracking_ang_vel", 0.1, 1.0, 0, 10),
        ("a1_multihead", "tracking_lin_vel", 4.0, 2.0, 0, 10),
        ("a1_torque_curriculum", "tracking_lin_vel", 4.0, 2.0, 3, 13),
        ("a1_torque_curriculum", "tracking_ang_vel", 0.1, 1.0, 3, 13),
        ("a1_torque_curriculum", "nominal_position", 20.0, 1.0, 0, 5),
        ("a1_torque_curriculum_multihead", "tracking_lin_vel", 4.0, 2.0, 3, 13),
        ("a1_torque_curriculum_multihead", "nominal_position", 20.0, 1.0, 0, 5),
    ],
)
def test_reward_curricula(make_task, name, term, start, end, t_start, t_end):
    """A weight follows eq. 1: constant before and after its knots, on the straight line between them."""
    task = make_task(name, 1)
    index = task.reward_names.index(term)
    points = [(0, start), (t_start, start), (t_end, end), (t_end + 1, end), (110, end)]
    points += [(t_start + share * (t_end - t_start), start + share * (end - start)) for share in (0.125, 0.5, 0.75)]
    for millions, expected in points:
        task.total_steps.fill_(int(millions * MILLION))
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
