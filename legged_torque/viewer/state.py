"""What a session shows to a window or a page."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from legged_torque.viewer.reading import Reading

AS_LOADED = "as loaded"  # the perturbation of the run or of the command line

Command = tuple[float, float, float]  # commanded v_x, v_y [m/s] and yaw rate [rad/s]


@dataclass(frozen=True)
class SessionState:
    """A snapshot of a session; a new one replaces it after every step and request."""

    reading: Reading | None = None  # the last step; None before the first
    rewards: dict[str, float] = field(default_factory=dict)  # weighted terms of the followed world per second, smoothed
    time: float = 0.0  # simulated time since the start [s]
    real_time: float = 0.0  # simulated seconds per second over the last steps
    message: str = ""  # the last event in one line
    is_error: bool = False  # whether it is an error
    message_number: int = 0  # counts messages
    is_paused: bool = False
    speed: float = 1.0  # wanted simulated seconds per second
    world: int = 0  # the followed world
    command: Command | None = None  # that of all worlds; None if commands are drawn as in training
    perturbation: str = AS_LOADED
    checkpoint: int = 0  # iterations of the checkpoint that acts
    trained_steps: int = 0  # its environment steps
    checkpoints: tuple[int, ...] = ()  # all checkpoints of the run
    follows_newest: bool = False
    mixing: dict[str, float] = field(default_factory=dict)  # weights of the action terms that have one, by name
    is_mixing_set: bool = False  # whether a user has set them
    task_number: int = 0  # counts the tasks that were built
    falls: int = 0  # resets other than time-outs since the task was built
