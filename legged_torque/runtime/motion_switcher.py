"""Unitree's motion switcher: the service that must release a robot's sport mode before others drive its motors.

Topics, numbers and fields are those of Unitree's SDK (unitree_sdk2_python, ``comm/motion_switcher``, ``rpc`` and
``idl/unitree_api``).
"""

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import byte, int32, int64, sequence

CHECK_MODE, RELEASE_MODE = 1001, 1003
AGAIN = 0.2  # seconds between two requests
ABSENT = 2.0  # seconds without an answer after which a robot that need not have the service has none


def _struct(name: str, **fields: Any) -> Any:
    """Return one of Unitree's types."""
    return make_idl_struct(name, f"unitree_api.msg.dds_.{name}", fields)


Identity_ = _struct("RequestIdentity_", id=int64, api_id=int64)
Lease_ = _struct("RequestLease_", id=int64)
Policy_ = _struct("RequestPolicy_", priority=int32, noreply=bool)
RequestHeader_ = _struct("RequestHeader_", identity=Identity_, lease=Lease_, policy=Policy_)
Request_ = _struct("Request_", header=RequestHeader_, parameter=str, binary=sequence[byte])
Status_ = _struct("ResponseStatus_", code=int32)
ResponseHeader_ = _struct("ResponseHeader_", identity=Identity_, status=Status_)
Response_ = _struct("Response_", header=ResponseHeader_, data=str, binary=sequence[byte])
SERVICE = {Request_: "rt/api/motion_switcher/request", Response_: "rt/api/motion_switcher/response"}


class Release:
    """The program's end: asks for the mode, and for its release, until there is none. Nothing here waits.

    Attributes:
        problem: Why the motors must not be driven yet; empty when no mode holds them.
        mode: The mode that was found to hold them; empty if none was.
    """

    def __init__(self, write: Callable[[Any], None], is_optional: bool) -> None:
        """Take what sends a request, and whether the robot need not have the service: unitree_mujoco has none."""
        self._write, self._is_optional = write, is_optional
        self.begin()

    def begin(self) -> None:
        """Ask anew, as a robot may have been switched on again."""
        self.problem, self.mode = "the motion switcher does not answer", ""
        first, self._released, self._next, self._absent_at = time.monotonic_ns(), 0, 0.0, np.inf
        self._asked = range(first, first)  # numbers of all requests

    def look(self, responses: list[Any], now: float) -> None:
        """Take answers, and ask for what is missing, at a time [s]. An answer that cannot be read is a mode."""
        if not self._asked and self._is_optional:
            self._absent_at = now + ABSENT
        for response in responses:
            identity, code = response.header.identity, response.header.status.code
            if identity.id not in self._asked:
                continue
            self._absent_at = np.inf
            if code:
                self.problem = f"the motion switcher answers with error {code}"
            elif identity.api_id == CHECK_MODE and identity.id > self._released:  # else it tells of before
                try:
                    self.mode = json.loads(response.data)["name"]
                except (ValueError, KeyError, TypeError):
                    self.mode = response.data
                self.problem = f"the sport mode '{self.mode}' holds the motors" if self.mode else ""
                if self.mode:
                    self._ask(RELEASE_MODE, now)
        if now > self._absent_at:
            self.problem = ""
        if self.problem and now >= self._next:
            self._ask(CHECK_MODE, now)

    def _ask(self, api: int, now: float) -> None:
        """Send a request."""
        number, self._next = self._asked.stop, now + AGAIN
        self._asked = range(self._asked.start, number + 1)
        self._released = number if api == RELEASE_MODE else self._released
        self._write(Request_(RequestHeader_(Identity_(number, api), Lease_(0), Policy_(0, False)), "{}", []))


class SportMode:
    """The end of a simulated robot, whose sport mode holds the motors until it is released."""

    name = "normal"  # empty once it is released

    def answer(self, request: Any) -> Any:
        """Do what a request asks for, and return the response."""
        api = request.header.identity.api_id
        self.name = "" if api == RELEASE_MODE else self.name
        data = json.dumps({"form": "0", "name": self.name}) if api == CHECK_MODE else ""
        status = Status_(0 if api in (CHECK_MODE, RELEASE_MODE) else 3203)  # not implemented
        return Response_(ResponseHeader_(request.header.identity, status), data, [])
