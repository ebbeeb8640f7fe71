"""From actions to torques inside the physics kernel: action delay, control law and motors as one Warp function."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import warp as wp
from torch import Tensor

from legged_torque.motors.action_delay import ActionDelay, Delay, age_of_actions
from legged_torque.motors.motors import Motors

Method = TypeVar("Method", bound=Callable)

_IN_KERNEL: dict[Callable, wp.Function] = {}


def in_kernel(function: Any) -> Callable[[Method], Method]:
    """Name the Warp function that does inside the physics kernel what the decorated method does in torch.

    It belongs to this method alone: one that overrides it runs in torch, unless it names a function of its own. The
    function's first argument is a struct whose fields have the names of attributes of the object: tensors, numbers, or
    structs of more of them. The others, and what it returns, are

    - of ``_compute_torques``: the actions that have reached the motors (num_actions,), the world, the joint, its
      position [rad] and velocity [rad/s]; the torque that the motor is asked for [N m],
    - of :meth:`Motors.apply`: the world, the joint, that torque, the joint's velocity; the torque that it gets [N m].
    """

    def name(method: Method) -> Method:
        _IN_KERNEL[method] = function
        return method

    return name


def find_in_kernel(method: Callable) -> wp.Function | None:
    """Return the Warp function that an object's method names, or None."""
    return _IN_KERNEL.get(getattr(method, "__func__", method))


class Drive:
    """A task's torques as one Warp function, where ``_compute_torques`` and the motors' ``apply`` name one each."""

    def __init__(self, task: Any, delay: ActionDelay, motors: Motors) -> None:
        """Keep who computes torques, and what delays actions."""
        self._task, self._delay, self._motors = task, delay, motors
        self._parts: tuple[wp.Function | None, wp.Function | None] = (None, None)
        self._made: tuple[wp.Function, Any] | None = None

    def get(self) -> tuple[wp.Function, Any] | None:
        """Return the function and the struct that it reads, as ``Simulator.drive`` takes them; None if one lacks."""
        parts = find_in_kernel(self._task._compute_torques), find_in_kernel(self._motors.apply)
        if parts != self._parts:
            self._parts, self._made = parts, None if None in parts else self._make(*parts)
        return self._made

    def _make(self, law: wp.Function, motor: wp.Function) -> tuple[wp.Function, Any]:
        """Return the function of these parts, and what it reads."""
        Reads, torque = _compose(law, motor)
        reads = Reads()
        reads.law, reads.motors = _read(_struct(law), self._task), _read(_struct(motor), self._motors)
        reads.delay = _read(Delay, self._delay)
        return torque, reads


def _struct(function: wp.Function) -> Any:
    """Return the struct that a Warp function reads."""
    return next(iter(function.input_types.values()))


def _read(struct: Any, owner: Any) -> Any:
    """Return a struct that is filled with the attributes of an object, by their names."""
    filled = struct()
    for name, field in struct.vars.items():
        value = _read(field.type, owner) if isinstance(field.type, type(struct)) else getattr(owner, name)
        setattr(filled, name, wp.from_torch(value) if isinstance(value, Tensor) else value)
    return filled


@functools.cache
def _compose(law: wp.Function, motor: wp.Function) -> tuple[Any, wp.Function]:
    """Return the struct and the function of a control law and motors, behind an action delay."""
    Law, Motor = _struct(law), _struct(motor)

    @wp.struct
    class Reads:
        """What the function reads."""

        law: Law
        motors: Motor
        delay: Delay

    @wp.func
    def torque(reads: Reads, world: int, joint: int, step: int, pos: float, vel: float) -> float:
        """Return the torque of a joint at a physics step of a control step [N m]."""
        age = age_of_actions(reads.delay, world, step)
        actions = wp.where(age > 0, reads.delay.before[world, wp.max(age, 1) - 1], reads.delay.newest[world])
        wanted = law(reads.law, actions, world, joint, pos, vel)
        return motor(reads.motors, world, joint, wanted, vel)

    return Reads, torque
