"""From actions to torques as one Warp function: control law, strength and motors, folded together link by link."""

import functools
from collections.abc import Sequence
from typing import Any

import warp as wp
from torch import Tensor

Part = tuple[wp.Function, Any]
"""A Warp function, and the instance of the struct that it reads."""


def read(struct: Any, **values: Any) -> Any:
    """Return an instance of a Warp struct with these values; tensors are read where they are."""
    filled = struct()
    for name in struct.vars:
        value = values.pop(name)
        setattr(filled, name, wp.from_torch(value) if isinstance(value, Tensor) else value)
    assert not values, f"{struct.key} has no {', '.join(values)}"
    return filled


def control_law(terms: Sequence[tuple[Part, Tensor | None]], num_dof: int) -> Part:
    """Return the weighted sum of the laws of action terms [N m], each with ``num_dof`` actions of its own.

    A law is ``(reads, action, world, joint, pos, vel) -> torque [N m]``; a weight is a scalar, None is 1. The sum is
    ``(reads, actions, world, joint, pos, vel) -> torque [N m]``.
    """
    total: Part | None = None
    for place, (law, weight) in enumerate(terms):
        total = _add_law(total, law, weight, place * num_dof)
    assert total is not None, "a control law needs an action term"
    return total


def torque_kernel(law: Part, strength: Tensor, actions: Tensor | Part, links: Sequence[Part]) -> Part:
    """Return the torque of a joint as ``Engine.drive`` takes it, ``(reads, world, joint, substep, pos, vel)`` [N m].

    Args:
        law: As of :func:`control_law`.
        strength: Factors on what the law asks for. Shape: (num_envs, num_dof).
        actions: The actions (num_envs, num_actions), or a link that acts on actions.
        links: Further links, see :attr:`~legged_torque.motors.motor.Motor.kernel`.
    """
    torque = _ask(law, strength, actions)
    for link in links:
        torque = _add_link(torque, link)
    return torque


def launch_law(law: Part, actions: Tensor, pos: Tensor, vel: Tensor, out: Tensor) -> None:
    """Write what a control law asks for to ``out`` [N m]; arguments as of ``LeggedRobot._compute_torques``."""
    function, reads = law
    arrays = [wp.from_torch(tensor) for tensor in (actions, pos, vel, out)]
    wp.launch(_law_kernel(function), tuple(pos.shape), [reads, *arrays], device=arrays[0].device)


def struct_of(function: wp.Function) -> Any:
    """Return the struct that a Warp function reads: the type of its first parameter."""
    return next(iter(function.input_types.values()))


def _struct(name: str, **types: Any) -> Any:
    """Return a Warp struct with these members."""
    return wp.struct(type(name, (), {"__annotations__": types, "__module__": __name__, "__qualname__": name}))


def _add_law(total: Part | None, law: Part, weight: Tensor | None, first: int) -> Part:
    """Return a control law with one more term, whose actions begin at ``first``."""
    function, struct = _sum_of_laws(total and total[0], law[0], weight is not None)
    values = {"others": total[1]} if total else {}
    values |= {"weight": weight.view(1)} if weight is not None else {}
    return function, read(struct, term=law[1], first=first, **values)


@functools.cache
def _sum_of_laws(others: wp.Function | None, law: wp.Function, is_weighted: bool) -> tuple[wp.Function, Any]:
    """Return the sum of some terms and one more."""
    members = {"term": struct_of(law), "first": wp.int32}
    members |= {"others": struct_of(others)} if others else {}
    members |= {"weight": wp.array(dtype=wp.float32)} if is_weighted else {}
    Reads = _struct("LawReads", **members)

    @wp.func
    def law_torque(
        reads: Reads, actions: wp.array(dtype=wp.float32), world: int, joint: int, pos: float, vel: float
    ) -> float:
        torque = law(reads.term, actions[reads.first + joint], world, joint, pos, vel)
        if wp.static(is_weighted):
            torque = reads.weight[0] * torque
        if wp.static(others is not None):
            torque = others(reads.others, actions, world, joint, pos, vel) + torque
        return torque

    return law_torque, Reads


def _ask(law: Part, strength: Tensor, actions: Tensor | Part) -> Part:
    """Return what the control law asks of the motors, times their strength."""
    link = None if isinstance(actions, Tensor) else actions[0]
    function, struct = _asked(law[0], link)
    source = actions if isinstance(actions, Tensor) else actions[1]
    return function, read(struct, law=law[1], strength=strength, actions=source)


@functools.cache
def _asked(law: wp.Function, link: wp.Function | None) -> tuple[wp.Function, Any]:
    """Return the function of a control law behind a link that acts on actions, if there is one."""
    source = struct_of(link) if link else wp.array2d(dtype=wp.float32)
    Reads = _struct("AskReads", law=struct_of(law), strength=wp.array2d(dtype=wp.float32), actions=source)

    @wp.func
    def asked_torque(reads: Reads, world: int, joint: int, substep: int, pos: float, vel: float) -> float:
        if wp.static(link is None):
            wanted = law(reads.law, reads.actions[world], world, joint, pos, vel)
        else:
            wanted = law(reads.law, link(reads.actions, world, substep), world, joint, pos, vel)
        return reads.strength[world, joint] * wanted

    return asked_torque, Reads


def _add_link(torque: Part, link: Part) -> Part:
    """Return torques behind one more link."""
    function, struct = _behind(torque[0], link[0])
    return function, read(struct, before=torque[1], link=link[1])


@functools.cache
def _behind(before: wp.Function, link: wp.Function) -> tuple[wp.Function, Any]:
    """Return the function of a link behind others."""
    Reads = _struct("LinkReads", before=struct_of(before), link=struct_of(link))

    @wp.func
    def link_torque(reads: Reads, world: int, joint: int, substep: int, pos: float, vel: float) -> float:
        wanted = before(reads.before, world, joint, substep, pos, vel)
        return link(reads.link, world, joint, substep, wanted, pos, vel)

    return link_torque, Reads


@functools.cache
def _law_kernel(law: wp.Function) -> wp.Kernel:
    """Return the kernel that evaluates a control law for all joints."""
    Reads = struct_of(law)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate_law(
        # In:
        reads: Reads,
        actions: wp.array2d(dtype=wp.float32),
        pos: wp.array2d(dtype=wp.float32),
        vel: wp.array2d(dtype=wp.float32),
        # Out:
        torques: wp.array2d(dtype=wp.float32),
    ):
        world, joint = wp.tid()
        torques[world, joint] = law(reads, actions[world], world, joint, pos[world, joint], vel[world, joint])

    return evaluate_law
