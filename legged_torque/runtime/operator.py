"""The operator's keys, read from a terminal."""

import contextlib
import os
import select
import sys
from typing import Any

import numpy as np

from legged_torque.runtime.controller import Controller, Mode
from legged_torque.utils.errors import UserError

NAMES = ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")
STEP = 0.1  # change of a command per key press [m/s or rad/s]
MODES = {"s": Mode.STAND, "p": Mode.POLICY, "d": Mode.DAMPING, " ": Mode.DAMPING, "x": Mode.PASSIVE}
COMMANDS = {"\x1b[A": (0, STEP), "\x1b[B": (0, -STEP), ",": (1, STEP), ".": (1, -STEP), "\x1b[D": (2, STEP)}
COMMANDS |= {"\x1b[C": (2, -STEP)}
"""Index in the command and its change, by keys: up, down, comma, period, left and right."""


class Operator:
    """Turns keys into requests; without a terminal there are none.

    Attributes:
        has_ended: Whether the operator wants to end.
    """

    has_ended = False

    def __init__(self, controller: Controller, walks: bool = False) -> None:
        """Take the controller; with ``walks`` nobody needs to ask a simulated robot to stand up and walk."""
        self._controller, self._walks = controller, walks
        ranges = controller.policy.description["commands"]
        self._low, self._high = np.array([ranges[name] for name in NAMES], float).T
        self._terminal: Any = None

    def __enter__(self) -> "Operator":
        """Read single keys from now on."""
        if sys.stdin.isatty():
            import termios
            import tty

            self._terminal = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *exception: object) -> None:
        """Read lines again."""
        if self._terminal is not None:
            import termios

            with contextlib.suppress(termios.error):
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._terminal)

    def command(self, values: list[float]) -> None:
        """Set v_x, v_y [m/s] and the yaw rate [rad/s]; a UserError if the policy was not trained for them."""
        for name, value, low, high in zip(NAMES, values, self._low, self._high, strict=True):
            if not low <= value <= high:
                raise UserError(f"{name} of --command must be from {low:g} to {high:g}, as trained, not {value:g}")
        self._controller.velocity_command[:] = values

    def look(self) -> None:
        """Carry out the keys that were pressed since the last look."""
        if self._walks and not self._controller.reason:
            wanted = Mode.POLICY if self._controller.mode == Mode.STAND else Mode.STAND
            if self._controller.mode != Mode.POLICY:
                self._controller.request(wanted)
        if self._terminal is not None and select.select([sys.stdin], [], [], 0.0)[0]:
            self.press(os.read(sys.stdin.fileno(), 64).decode(errors="ignore"))

    def press(self, text: str) -> None:
        """Carry out keys as a terminal sends them."""
        while text:
            key = next((name for name in COMMANDS if text.startswith(name)), text[0])
            text = text[len(key) :]
            if key == "q":
                self.has_ended = True
            elif key in MODES:
                if refusal := self._controller.request(MODES[key]):
                    print(f"not now: {refusal}", flush=True)
            elif key == "0":
                self._controller.velocity_command[:] = 0.0
            elif key in COMMANDS:
                index, change = COMMANDS[key]
                command = self._controller.velocity_command
                command[index] = np.clip(command[index] + change, self._low[index], self._high[index])
