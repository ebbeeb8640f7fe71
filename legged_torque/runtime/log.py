"""Logs of every tick as MCAP, a format of Foxglove, with messages in JSON."""

import contextlib
import io
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from legged_torque.runtime.controller import Controller
from legged_torque.runtime.interface import MotorCommand, PolicyStep, Received, RobotState
from legged_torque.utils.errors import UserError

try:
    import orjson
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader
    from mcap.writer import Writer
except ImportError as error:
    raise UserError(f"logs need the extra: pip install 'legged_torque[robot]' ({error})") from None

TICK, POLICY, ROBOT = "tick", "policy", "robot"
"""Channels: each tick; each step of the policy. And the metadata: whose log this is.

A tick has the controller's ``mode``, ``reason`` of a stop and ``velocity_command``; ``state`` and ``command``; how many
messages were ``damaged``, ``lost`` or ``late``, and other ``problems``; whether it ``missed`` its deadline; by how much
it began after its time, ``lateness``, and the time it ``took`` until its command was sent [s]. Older logs lack
``problems``, ``lateness`` and ``took``.
"""
_NS = 1e9
_CHUNK = 2**16  # bytes that are written at a time
_Part = TypeVar("_Part")


class Log:
    """Writes what a controller does: the control loop only keeps ticks by :meth:`add`; another thread writes them.

    A log that was not closed can be read too, but for its last 64 KB. A disk that is full does not stop the robot.

    Attributes:
        problem: Why nothing is written any more; empty as long as all is well.
    """

    problem = ""

    def __init__(self, file: Path, controller: Controller, keeps_time: bool = True) -> None:
        """Begin a file; a UserError if it exists, or its folder does not.

        ``keeps_time`` says whether the robot goes on while the program is late.
        """
        try:
            self._file = file.open("xb")
        except OSError as error:
            raise UserError(f"cannot write the log '{file}': {error.strerror}") from None
        self._controller, self._waiting = controller, deque[tuple[str, float, dict[str, Any]]]()
        self._lock = threading.Lock()
        self._writer = Writer(self._file, chunk_size=_CHUNK)
        self._writer.start(profile="", library="legged_torque")
        description = controller.policy.description
        names = orjson.dumps(controller.joints.names).decode()
        about = {"joint_order": names, "sha256": description["network"]["sha256"], "task": description["task"]}
        about |= {"period": repr(controller.period), "keeps_time": str(keeps_time)}
        self._writer.add_metadata(ROBOT, about)
        schema = self._writer.register_schema("object", "jsonschema", b'{"type": "object"}')
        self._channels = {name: self._writer.register_channel(name, "json", schema) for name in (TICK, POLICY)}

    def add(self, now: float, missed: bool, received: Received, command: MotorCommand, **times: float) -> None:
        """Keep a tick that has just been made, at a time [s], the command that was sent, and further times."""
        controller, step = self._controller, self._controller.policy_step
        state = received.newest if isinstance(received.newest, RobotState) else None
        tick: dict[str, Any] = {"mode": controller.mode.value, "reason": controller.reason, "missed": missed}
        tick |= times | {"problems": received.problems}
        tick |= {"damaged": received.wrong_crc, "lost": received.lost, "late": received.late}
        tick |= {"velocity_command": controller.velocity_command.copy(), "state": state, "command": command}
        self._waiting.append((TICK, now, tick))
        if step is not None:
            self._waiting.append((POLICY, now, vars(step)))

    def write(self) -> None:
        """Write what has been added since the last call."""
        with self._lock:
            try:
                while self._waiting:
                    channel, now, message = self._waiting.popleft()
                    data = orjson.dumps(_doubles(message), option=orjson.OPT_SERIALIZE_NUMPY)
                    if not self.problem:
                        self._writer.add_message(self._channels[channel], round(now * _NS), data, round(now * _NS))
                        self._file.flush()
            except OSError as error:
                self.problem = f"the log ends here: {error.strerror or error}"

    def close(self) -> None:
        """Write the rest, and end the file."""
        self.write()
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            self.problem = f"the log has no end: {error.strerror or error}"


class RecordedLog:
    """A log that is read.

    Attributes:
        joint_order: Names of the joints.
        sha256: Of the policy's network.
        task: That the policy was trained on.
        period: Time between two ticks [s].
        keeps_time: Whether the robot went on while the program was late.
    """

    def __init__(self, file: Path) -> None:
        """Open a log; a UserError if it is none."""
        try:
            self._file, self._content = file, file.read_bytes()
            about = next(part.metadata for part in self._read(NonSeekingReader.iter_metadata) if part.name == ROBOT)
            self.joint_order: list[str] = orjson.loads(about["joint_order"])
            self.sha256, self.task, self.period = about["sha256"], about["task"], float(about["period"])
            self.keeps_time = about.get("keeps_time") != "False"
            if not 0.0 < self.period < np.inf:
                raise ValueError(f"its period is {self.period:g} s")
        except OSError as error:
            raise UserError(f"cannot read '{file}': {error.strerror}") from None
        except (StopIteration, KeyError, ValueError) as error:
            raise UserError(f"'{file}' is no log of deploy.py: {str(error) or 'it does not say whose'}") from None

    def ticks(self) -> Iterator[tuple[float, RobotState | None, MotorCommand, dict[str, Any]]]:
        """Yield time [s], state, command and the rest of each tick, see :data:`TICK`."""
        for time, message in self._messages(TICK):
            state, command = message.pop("state"), message.pop("command")
            yield time, state and RobotState(**_arrays(state)), MotorCommand(**_arrays(command)), message

    def policy_steps(self) -> Iterator[PolicyStep]:
        """Yield the steps of the policy."""
        for _, message in self._messages(POLICY):
            seen, done = (np.array(message[name], float).astype(np.float32) for name in ("observations", "actions"))
            yield PolicyStep(seen, done, message["is_first"])

    def _messages(self, channel: str) -> Iterator[tuple[float, Any]]:
        """Yield times and contents of a channel's messages."""
        for _, _, message in self._read(lambda reader: reader.iter_messages(channel, log_time_order=False)):
            yield message.log_time / _NS, orjson.loads(message.data)

    def _read(self, parts: Callable[[NonSeekingReader], Iterator[_Part]]) -> Iterator[_Part]:
        """Yield parts of the file, up to where it was cut off; a UserError if it is damaged before that."""
        try:
            with contextlib.suppress(EndOfFile, struct.error):
                yield from parts(NonSeekingReader(io.BytesIO(self._content), validate_crcs=True))
        except Exception as error:  # each kind of damage has its own
            raise UserError(f"'{self._file}' is no log of deploy.py, or damaged: {error}") from None


def _doubles(values: dict[str, Any]) -> dict[str, Any]:
    """Return values with arrays of doubles, whose text is exact, for those of float32."""
    inner = {name: vars(value) for name, value in values.items() if isinstance(value, (RobotState, MotorCommand))}
    values = values | {name: _doubles(value) for name, value in inner.items()}
    return {name: value.astype(float) if isinstance(value, np.ndarray) else value for name, value in values.items()}


def _arrays(values: dict[str, Any]) -> dict[str, Any]:
    """Return lists as arrays; null, which was no number, is NaN."""
    return {name: np.array(value, float) if isinstance(value, list) else value for name, value in values.items()}
