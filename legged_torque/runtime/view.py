"""What the operator sees of a robot: a table that is drawn anew on a terminal, a line now and then elsewhere."""

import contextlib
import sys
import time
from collections.abc import Sequence

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from legged_torque.runtime.brakes import tilt_of
from legged_torque.runtime.controller import OPERATOR
from legged_torque.runtime.interface import RobotState
from legged_torque.runtime.loop import RealTimeLoop
from legged_torque.runtime.operator import Operator
from legged_torque.runtime.session import Session
from legged_torque.utils.display import is_terminal

REDRAW_EVERY, LINE_EVERY = 0.25, 1.0  # seconds
NEAR, BAR = 0.8, 10  # share of a limit from which a number is red; characters of a full bar


class View:
    """Shows a session, in the caller's thread: the control loop waits for none.

    Attributes:
        live: The context in which a terminal is drawn on; does nothing elsewhere.
    """

    def __init__(self, session: Session, loop: RealTimeLoop, operators: Sequence[Operator]) -> None:
        """Take what is shown."""
        self._session, self._loop, self._operators = session, loop, operators
        console = Console(emoji=False)  # loading emoji takes 12 ms without a tick
        self.live = Live(console=console, auto_refresh=False) if is_terminal(sys.stdout) else contextlib.nullcontext()
        self._identity = [0] * 4  # the last that was shown, or that of robots that do not tell theirs
        self._due, self._counted, self._rates = 0.0, np.array([time.monotonic(), 0, 0]), np.zeros(2)

    def show(self) -> None:
        """Say which robot it is, once; draw the table, or print the line, if it is time for the next one."""
        if (state := self._session.controller.state) and (identity := state.identity.tolist()) != self._identity:
            self._identity = identity
            print(f"the robot's firmware is {identity[:2]}, its serial number {identity[2:]}", flush=True)
        if (now := time.monotonic()) < self._due:
            return
        counted = np.array([now, self._loop.ticks, self._session.counts["messages"]])
        seconds, *new = counted - self._counted
        self._counted, self._rates = counted, np.array(new) / max(seconds, 1e-9)
        if isinstance(self.live, Live):
            self._due = now + REDRAW_EVERY
            self.live.update(self.table(), refresh=True)
        else:
            self._due = now + LINE_EVERY
            print(self.line(), flush=True)

    def line(self) -> str:
        """Return the state in a line: mode, command, the worst joint, rates, counts, and what there is to note."""
        controller, session, state = self._session.controller, self._session, self._session.controller.state
        parts = [controller.mode.value + (f" ({controller.reason})" if controller.reason else "")]
        parts.append("command " + " ".join(f"{part:+.2f}" for part in controller.velocity_command))
        if state is not None:
            worst = int(np.argmax(share := self._torques(state)[1]))
            parts.append(f"torque {share[worst]:.0%} of {controller.joints.names[worst]}'s limit")
            parts.append(f"motors {state.temperatures.max():.0f} deg C; tilt {tilt_of(state.quaternion):.2f} rad")
        late = 1e3 * self._loop.lateness(0.999)
        parts.append(f"ticks {self._rates[0]:.0f}/s, 99.9% within {late:.2f} ms; messages {self._rates[1]:.0f}/s")
        parts += [f"{name} {count}" for name, count in session.counts.items() if count and name != "messages"]
        notes = [session.log.problem if session.log else "", *(each.note for each in self._operators)]
        return "; ".join(parts + list(filter(None, notes)))

    def table(self) -> Group:
        """Return that line, and a row for each joint."""
        controller, state = self._session.controller, self._session.controller.state
        head = Text(self.line(), "bold red" if controller.reason not in ("", OPERATOR) else "bold")
        if state is None:
            return Group(head)
        table = Table("joint", "rad", "rad/s", "N m", "of the limit", "deg C", "error", box=None)
        torques, share = self._torques(state)
        for i, name in enumerate(controller.joints.names):
            numbers = (state.joint_positions[i], state.joint_velocities[i], torques[i])
            bar = "█" * round(BAR * min(share[i], 1.0))
            is_hot = state.temperatures[i] > NEAR * controller.brakes.max_temperature
            cells = [Text(f"{bar:{BAR}} {share[i]:4.0%}", "red" if share[i] > NEAR else "green")]
            cells.append(Text(f"{state.temperatures[i]:.0f}", "red" if is_hot else ""))
            error = f"{int(state.errors[i]):#x}" if state.errors[i] else ""
            table.add_row(name, *(f"{number:+8.3f}" for number in numbers), *cells, error)
        return Group(head, table)

    def _torques(self, state: RobotState) -> tuple[np.ndarray, np.ndarray]:
        """Return what the drives make of the last command [N m], and its shares of the limits. Shapes: (joints,)."""
        controller = self._session.controller
        torques = controller.sent.torques(state.joint_positions, state.joint_velocities)
        return torques, np.nan_to_num(np.abs(torques) / np.abs(controller.joints.torque_limits).max(axis=0))
