"""Whoever tells a robot what to do: keys of a terminal, UDP datagrams, a gamepad."""

import contextlib
import json
import os
import re
import select
import socket
import struct
import sys
import termios
import time
import tty
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from legged_torque.runtime.controller import Controller, Mode
from legged_torque.utils.errors import UserError

NAMES = ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")
KEY_MODES = {"s": Mode.STAND, "p": Mode.POLICY, "d": Mode.DAMPING, " ": Mode.DAMPING, "x": Mode.PASSIVE}
KEY_MODES |= {"\x1a": Mode.DAMPING, "\x1c": Mode.DAMPING}  # Ctrl-Z, Ctrl-\
KEYS = {"\x1b[A": (0, 0.1), "\x1b[B": (0, -0.1), ",": (1, 0.1), ".": (1, -0.1), "\x1b[D": (2, 0.1), "\x1b[C": (2, -0.1)}
"""Index in the command and its change [m/s or rad/s], by keys: up, down, comma, period, left and right."""
PRESSED = re.compile(r"\x1b+([O[][0-?]*[!-~]?|[!-ce-~])?|.", re.DOTALL)
"""A key, or all that a terminal sends for one of no character, or with Alt; after Escape, d and space still count."""
NUMBERS = ("forward", "sideways", "turn")  # of a datagram: v_x, v_y [m/s] and yaw rate [rad/s]
LONGEST, AT_ONCE = 256, 100  # bytes of a datagram, and datagrams of a look
SILENCE = 1.0  # seconds without datagrams after which the command is 0
EVENT = struct.Struct("<IhBB")  # of a gamepad: time [ms], value, kind, number of the button or axis
BUTTON, AXIS, NOT_NEW = 1, 2, 0x80  # kinds, and the bit of states told at first, and again after lost events
BUTTONS = {0: Mode.STAND, 1: Mode.DAMPING, 2: Mode.POLICY}
AXES = {1: 0, 0: 1, 3: 2}  # index in the command by number; values are negative forwards and to the left
DEAD, FULL = 0.1, 32767  # an axis' zone around its middle, as a share; its largest value


class Operator(contextlib.AbstractContextManager["Operator"]):
    """Turns what comes from one device into requests to a controller. A new device is one class.

    Attributes:
        has_ended: Whether the operator wants to end.
        note: Why the last request was refused, or what else the operator should know; empty if nothing.
    """

    has_ended, note = False, ""

    def __init__(self, controller: Controller) -> None:
        """Take the controller that obeys."""
        self._controller = controller
        low, high = np.array([controller.policy.description["commands"][name] for name in NAMES], float).T
        self._low, self._high = np.minimum(low, 0.0), np.maximum(high, 0.0)  # any robot may be told to stand

    def __exit__(self, *exception: object) -> None:
        """Give the device back."""

    def look(self) -> None:
        """Carry out what has come since the last look; never waits."""

    def ask(self, mode: Mode) -> None:
        """Request a mode, and note why it is refused."""
        refusal = self._controller.request(mode)
        self.note = f"no {mode.value} now: {refusal}" if refusal else ""

    def move(self, velocity: ArrayLike) -> None:
        """Command v_x, v_y [m/s] and the yaw rate [rad/s], as far as the policy was trained for. Shape: (3,)."""
        self._controller.velocity_command[:] = np.clip(velocity, self._low, self._high)

    def begin_with(self, values: list[float]) -> None:
        """Command v_x, v_y [m/s] and the yaw rate [rad/s]; a UserError if the policy was not trained for them."""
        self.move(values)
        for name, value, low, high in zip(NAMES, values, self._low, self._high, strict=True):
            if not low <= value <= high:
                raise UserError(f"{name} of --command must be from {low:g} to {high:g}, as trained, not {value:g}")


class Unattended(Operator):
    """Has a simulated robot stand up and walk, once: a fault or another operator ends that."""

    _mode = Mode.DAMPING  # the last one that was reached

    def look(self) -> None:
        """Ask for the next mode, until one is not as it was left."""
        following = {Mode.DAMPING: Mode.STAND, Mode.STAND: Mode.POLICY}.get(self._mode)
        if following and self._controller.mode != self._mode:
            self._mode, self.note = Mode.PASSIVE, ""  # after which nothing follows
        elif following:
            self.ask(following)
            self._mode = self._mode if self.note else following


class Keyboard(Operator):
    """Keys of a terminal; without one there are none."""

    _terminal: Any = None

    def __enter__(self) -> "Keyboard":
        """Read single keys from now on."""
        if sys.stdin.isatty():
            flags, *others, keys = self._terminal = termios.tcgetattr(sys.stdin)
            keys = [b"\0" if place in (termios.VSUSP, termios.VQUIT) else key for place, key in enumerate(keys)]
            settings = [flags & ~termios.IXON, *others, keys]  # Ctrl-S stops no output, Ctrl-Z and Ctrl-\ no program
            termios.tcsetattr(sys.stdin, termios.TCSANOW, settings)
            tty.setcbreak(sys.stdin)
        return self

    def __exit__(self, *exception: object) -> None:
        """Read lines again."""
        if self._terminal is not None:
            with contextlib.suppress(termios.error):
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._terminal)

    def look(self) -> None:
        """Carry out the keys that were pressed since the last look, as a terminal sends them."""
        is_pressed = self._terminal is not None and select.select([sys.stdin], [], [], 0.0)[0]
        text = os.read(sys.stdin.fileno(), 4096).decode(errors="ignore") if is_pressed else ""  # a terminal's buffer
        for key in (found[0] for found in PRESSED.finditer(text)):
            self.has_ended |= key == "q"
            if key in KEY_MODES:
                self.ask(KEY_MODES[key])
            elif key == "0":
                self._controller.velocity_command[:] = 0.0
            elif key in KEYS:
                index, change = KEYS[key]
                self.move(self._controller.velocity_command + change * np.eye(3)[index])


class Datagrams(Operator):
    """JSON datagrams over UDP, such as ``{"forward": 0.5, "sideways": 0, "turn": 0.2, "mode": "policy"}``.

    A number that is left out is 0. A mode other than damping is asked for if the datagram before had another one, or
    none, so that a stream of the same does not raise a robot after a fault or a refusal.
    """

    _bad, _heard, _mode = 0, np.inf, ""

    def __init__(self, controller: Controller, address: str) -> None:
        """Listen on ``[ADDRESS:]PORT``, by default on 127.0.0.1; a UserError if that cannot be."""
        super().__init__(controller)
        host, _, port = address.rpartition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            if not 1 <= int(port) <= 65535:
                raise ValueError("ports are from 1 to 65535")
            self._socket.bind((host or "127.0.0.1", int(port)))
        except (OSError, ValueError) as error:
            raise UserError(f"--udp is a free PORT or ADDRESS:PORT of this machine, not {address} ({error})") from None

    def __exit__(self, *exception: object) -> None:
        """Close the port."""
        self._socket.close()

    def look(self) -> None:
        """Obey the datagrams since the last look; bad ones are counted."""
        with contextlib.suppress(BlockingIOError):
            for _ in range(AT_ONCE):
                self._obey(self._socket.recv(LONGEST + 1))
        if time.monotonic() - self._heard > SILENCE:
            self._heard = np.inf
            self._controller.velocity_command[:] = 0.0

    def _obey(self, datagram: bytes) -> None:
        """Carry out a datagram, or count it."""
        try:
            said = json.loads(datagram)
            velocity, name = [said.pop(each, 0.0) for each in NUMBERS], said.pop("mode", "")
            mode = Mode(name) if name else None
            if said or not all(type(part) in (int, float) and abs(part) < FULL for part in velocity):
                raise ValueError
        except (ValueError, AttributeError, TypeError):
            self._bad, self.note = self._bad + 1, f"{self._bad + 1} bad datagrams"
            return
        self._heard = time.monotonic()
        self.move(velocity)
        if mode and (name != self._mode or mode == Mode.DAMPING != self._controller.mode):
            self.ask(mode)
        self._mode = name


class Gamepad(Operator):
    """A gamepad of Linux's joystick interface; numbers as of the drivers xpad and hid-playstation.

    The left stick walks, the right one turns. A or cross stands up, X or triangle starts the policy, B or circle damps.
    A gamepad that is gone damps, too.
    """

    def __init__(self, controller: Controller, device: str) -> None:
        """Open a device such as ``/dev/input/js0``; a UserError if that cannot be."""
        super().__init__(controller)
        self._sticks = np.zeros(3)
        try:
            self._file = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
            os.read(self._file, 512 * EVENT.size)  # how things are at first: no command
        except OSError as error:
            raise UserError(f"cannot open the gamepad '{device}': {error.strerror}") from None

    def __exit__(self, *exception: object) -> None:
        """Close the device."""
        os.close(self._file)

    def look(self) -> None:
        """Obey sticks and buttons that were moved since the last look."""
        events = b""
        with contextlib.suppress(OSError):  # the device is gone
            if not select.select([self._file], [], [], 0.0)[0]:
                return
            events = os.read(self._file, 64 * EVENT.size)
        if not events and "gone" not in self.note:
            self.ask(Mode.DAMPING)
            self._sticks[:] = self._controller.velocity_command[:] = 0.0
            self.note = "the gamepad is gone"
        for _, value, kind, number in EVENT.iter_unpack(events):
            mode = BUTTONS.get(number) if kind & ~NOT_NEW == BUTTON and value else None
            if mode and (kind == BUTTON or mode == Mode.DAMPING):
                self.ask(mode)
            elif kind & ~NOT_NEW == AXIS and number in AXES:
                self._sticks[AXES[number]] = -value / FULL
                beyond = np.maximum(np.abs(self._sticks) - DEAD, 0.0) / (1.0 - DEAD)
                self.move(beyond * np.where(self._sticks > 0.0, self._high, self._low))
