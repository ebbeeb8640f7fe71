"""A policy on a robot: what the control loop does, and counts."""

import contextlib
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from legged_torque.runtime.controller import OPERATOR, Controller, Mode
from legged_torque.runtime.interface import Received, Transport

FAREWELL = 0.1  # seconds in which damping is sent at the end


class Session:
    """Connects a controller with a robot.

    Attributes:
        controller: The controller.
        counts: Messages, and those that were damaged, lost or late.
        stops: Reasons of all stops but the operator's, in order.
        log: Where the ticks are kept; None if nowhere.
    """

    def __init__(
        self, controller: Controller, transport: Transport, log: Any = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Prepare; nothing is sent yet. ``log``, a :class:`~legged_torque.runtime.log.Log`, gets every tick.

        ``clock`` returns the time [s] that ticks are given: a test's robot has a time of its own.
        """
        self.controller, self._transport, self.log, self._clock = controller, transport, log, clock
        self.counts: Counter[str] = Counter()
        self.stops: list[str] = []

    def tick(self, now: float, missed: bool, late: float = 0.0) -> None:
        """Listen, decide, and tell the drives; see :class:`~legged_torque.runtime.loop.RealTimeLoop`."""
        try:
            received = self._transport.receive()
        except Exception as error:  # whatever it is, the robot must be told to damp
            received = Received(problems=[f"{type(error).__name__}: {error}"])
        new = {"messages": int(received.newest is not None), "damaged": received.wrong_crc}
        self.counts.update(new | {"lost": received.lost, "late": received.late, "missed deadlines": int(missed)})
        before = self.controller.reason
        self.controller.step(received, now, missed)
        command = self.controller.command_at(self._clock())
        self._transport.send(command)
        if self.controller.reason not in ("", before, OPERATOR):
            self.stops.append(self.controller.reason)
        if self.log:
            self.log.add(now, missed, received, command, lateness=late, took=self._clock() - now)

    def close(self) -> None:
        """Leave the robot in damping, after the loop has ended; what fails meanwhile is raised at the end."""
        self.controller.stop("the program ends")
        self.controller.request(Mode.DAMPING)
        end = time.monotonic() + FAREWELL
        with contextlib.ExitStack() as parts:
            if self.log:
                parts.callback(self.log.close)
            parts.callback(self._transport.close)
            error: BaseException | None = None
            while time.monotonic() < end:
                try:
                    time.sleep(self.controller.period)
                    self.tick(self._clock(), missed=False)
                except BaseException as failure:  # the next message may arrive, also after Ctrl-C
                    error = failure
            if error:
                raise error
