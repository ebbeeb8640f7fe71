"""Weights of rewards that change while a task is trained."""

import numpy as np
import pytest
import torch

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
