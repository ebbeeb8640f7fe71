"""What may be asked of a session, from any thread."""

from __future__ import annotations

import functools
import queue
from collections.abc import Callable
from typing import Any


class Requests:
    """Requests to :class:`~legged_torque.viewer.session.Session`, of which this is a part.

    Each method only leaves a note; the session's thread reads the notes between two steps and does what stands in the
    method of the same name with an underscore.
    """

    def __init__(self) -> None:
        """Start without any notes."""
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()

    def set_command(self, command: tuple[float, float, float] | None) -> None:
        """Command v_x, v_y [m/s] and a yaw rate [rad/s] in all worlds; None draws commands as in training."""
        self._ask(self._set_command, command)

    def push(self, angle: float, speed: float) -> None:
        """Add a velocity to every trunk at once.

        Args:
            angle: Direction from the robot's front, to its left [rad].
            speed: [m/s].
        """
        self._ask(self._push, angle, speed)

    def set_paused(self, is_paused: bool) -> None:
        """Stop or go on."""
        self._ask(self._set_paused, is_paused)

    def reset(self) -> None:
        """Start a new episode in every world."""
        self._ask(self._reset)

    def set_speed(self, speed: float) -> None:
        """Set the simulated seconds per second, from :data:`SLOWEST` to :data:`FASTEST`."""
        self._ask(self._set_speed, speed)

    def follow_world(self, world: int) -> None:
        """Choose the world that history, torques and reward terms are of."""
        self._ask(self._follow_world, world)

    def set_mixing(self, mixing: tuple[float, float] | None) -> None:
        """Set the weights of PD control and torque actions of a multi-head task; None sets them as in training."""
        self._ask(self._set_mixing, mixing)

    def load_checkpoint(self, number: int) -> None:
        """Let another checkpoint of the run act."""
        self._ask(self._switch_checkpoint, number)

    def follow_newest(self, is_on: bool) -> None:
        """Load each new checkpoint as soon as it is there, or no longer."""
        self._ask(self._follow_newest, is_on)

    def set_perturbation(self, name: str) -> None:
        """Rebuild the task with one of its perturbations, or :data:`AS_LOADED`."""
        self._ask(self._set_perturbation, name)

    def _ask(self, function: Callable[..., None], *args: Any) -> None:
        """Leave a note for the stepping thread."""
        self._requests.put(functools.partial(function, *args))
