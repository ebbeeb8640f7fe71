"""What a session shows to whoever watches it."""

from __future__ import annotations

from dataclasses import dataclass, field

from legged_torque.viewer.recording import Reading

AS_LOADED = "as loaded"
"""The perturbation that the run or the command line has chosen."""


@dataclass(frozen=True)
class State:
    """What a session shows; a new one replaces the old one after every step and request.

    Attributes:
        reading: The last step; None before the first.
        rewards: Weighted reward terms of the followed world per second, smoothed.
        time: Simulated time since the start [s].
        real_time: Simulated seconds per second of late.
        message: What happened last, in one line, and whether it is an error; ``message_number`` counts them.
        checkpoint: Iterations of the checkpoint that acts; ``trained_steps`` are its environment steps.
        checkpoints: All checkpoints of the run.
        mixing: Weights of PD control and torque actions; None for a task without them.
        task_number: Counts the tasks that were built.
        falls: Resets that were not time-outs since the task was built.
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
    command: tuple[float, float, float] | None = None
    perturbation: str = AS_LOADED
    checkpoint: int = 0
    trained_steps: int = 0
    checkpoints: tuple[int, ...] = ()
    follows_newest: bool = False
    mixing: tuple[float, float] | None = None
    is_mixing_set: bool = False
    task_number: int = 0
    falls: int = 0
