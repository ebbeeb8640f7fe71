"""What a session shows to a window or a page."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from legged_torque.viewer.reading import Reading

AS_LOADED = "as loaded"
"""The perturbation of the run or of the command line."""

Command = tuple[float, float, float]
"""Commanded v_x, v_y [m/s] and yaw rate [rad/s]."""


@dataclass(frozen=True)
class SessionState:
    """A snapshot of a session; a new one replaces it after every step and request.

    Attributes:
        reading: The last step; None before the first.
        rewards: Weighted reward terms of the followed world per second, smoothed.
        time: Simulated time since the start [s].
        real_time: Simulated seconds per second over the last steps.
        message: The last event in one line; ``is_error`` says whether it is an error, ``message_number`` counts them.
        world: The followed world.
        command: The command in all worlds; None if commands are drawn as in training.
        checkpoint: Iterations of the checkpoint that acts; ``trained_steps`` are its environment steps.
        checkpoints: All checkpoints of the run.
        mixing: Weights of the action terms that have one, by name; ``is_mixing_set`` says whether a user has set them.
        task_number: Counts the tasks that were built.
        falls: Resets other than time-outs since the task was built.
    """

    reading: Reading | None = None
    rewards: dict[str, float] = field(default_factory=dict)
    time: float = 0.0
    real_time: float = 0.0
    message: str = ""
    is_error: bool = False
    message_number: int = 0
    is_paused: bool = False
    speed: float = 1.0
    world: int = 0
    command: Command | None = None
    perturbation: str = AS_LOADED
    checkpoint: int = 0
    trained_steps: int = 0
    checkpoints: tuple[int, ...] = ()
    follows_newest: bool = False
    mixing: dict[str, float] = field(default_factory=dict)
    is_mixing_set: bool = False
    task_number: int = 0
    falls: int = 0
