"""Evaluations while training: their tables, and the steps that are made in them."""

from types import SimpleNamespace

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning import evaluator

COLUMNS = "steps,iteration,seconds,track_percentage,track_xy,track_angular,collision_force,peak_force,"
COLUMNS += "cost_of_transport,mechanical_power,torque_rate,height,speed,falls_per_minute,critic_gradient_norm"


def read_rows(file):
    """The rows of a table of evaluations, None without a file."""
    if not file.exists():
        return None
    header, *lines = file.read_text().splitlines()
    assert header == COLUMNS
    return [dict(zip(COLUMNS.split(","), map(float, line.split(",")), strict=True)) for line in lines]


def note_steps(monkeypatch):
    """Note each step of each task: task, state before, actions, state after. Evaluations have no warm-up."""
    monkeypatch.setattr(evaluator, "WARM_UP_TIME", 0.0)
    steps, step = [], LeggedRobot.step

    def noted_step(task, actions):
        note = SimpleNamespace(task=task, actions=actions.clone(), total_steps=int(task.total_steps))
        note.commands, note.obs = task.commands.clone(), task.get_observations()
        note.mixing = float(task.mixing[0]) if hasattr(task, "mixing") else None
        result = step(task, actions)
        note.reset, note.height = task.reset_buf.clone(), task.base_pos[:, 2].clone()
        note.velocity = task.base_lin_vel[:, :2].clone()
        steps.append(note)
        return result

    monkeypatch.setattr(LeggedRobot, "step", noted_step)
    return steps
