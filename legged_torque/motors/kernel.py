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
    for place, ((law, law_reads), weight) in enumerate(terms):
        function, struct = _sum_of_laws(total and total[0], law, weight is not None)
        values = {"others": total[1]} if total else {}
        values |= {"weight": weight.view(1)} if weight is not None else {}
        total = function, read(struct, term=law_reads, first=place * num_dof, **values)
    assert total is not None, "a control law needs an action term"
    return total


def joint_torque(law: Part, strength: Tensor, actions: Part, links: Sequence[tuple[str, Part]]) -> Part:
    """Return the torque of a joint in a physics step, ``(reads, world, joint, substep, pos, vel) -> torque [N m]``.

    Args:
        law: As of :func:`control_law`.
        strength: Factors on what the law asks for. Shape: (num_envs, num_dof).
        actions: A link that acts on actions, or :func:`newest_actions` with the actions (num_envs, num_actions).
        links: What further links act on and their kernels, see :class:`~legged_torque.motors.motor.Motor`.
    """
    function, struct = _strengthened(law[0], actions[0])
    reads = read(struct, law=law[1], strength=strength, actions=actions[1])
    for acts_on, (link, link_reads) in links:
        function, struct = (_through if acts_on == "measurements" else _behind)(function, link)
        reads = read(struct, before=reads, link=link_reads)
    return function, reads


class TorqueKernel:
    """The torques of all joints as one kernel, which runs before each physics step."""

    def __init__(self, torque: Part, pos: Tensor, vel: Tensor, out: Tensor) -> None:
        """Take a function as of :func:`joint_torque`, the tensors that it reads, and where it writes torques [N m].

        Joint positions [rad] and velocities [rad/s]. Shapes: (num_envs, num_dof).
        """
        self._torque, self._arrays = torque, [wp.from_torch(tensor) for tensor in (pos, vel, out)]
        self._launches: dict[int, wp.Launch] = {}

    def launch(self, substep: int) -> None:
        """Write the torques of a physics step, by its number in the control step."""
        if substep not in self._launches:
            (function, reads), (*state, out) = self._torque, self._arrays
            inputs, where = [reads, substep, *state, out], {"device": out.device, "record_cmd": True}
            self._launches[substep] = wp.launch(_torque_kernel(function), out.shape, inputs, **where)
        self._launches[substep].launch()


@wp.func
def newest_actions(actions: wp.array2d(dtype=wp.float32), world: int, substep: int) -> wp.array(dtype=wp.float32):
    """Return the actions of a world, which reach its motors at once."""
    return actions[world]


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


@functools.cache
def _strengthened(law: wp.Function, link: wp.Function) -> tuple[wp.Function, Any]:
    """Return what a control law asks for, behind a link that acts on actions, times the strength."""
    Reads = _struct("StrengthReads", law=struct_of(law), strength=wp.array2d(dtype=wp.float32), actions=struct_of(link))

    @wp.func
    def strengthened_torque(reads: Reads, world: int, joint: int, substep: int, pos: float, vel: float) -> float:
        wanted = law(reads.law, link(reads.actions, world, substep), world, joint, pos, vel)
        return reads.strength[world, joint] * wanted

    return strengthened_torque, Reads


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
def _through(before: wp.Function, link: wp.Function) -> tuple[wp.Function, Any]:
    """Return the function of links that have positions and velocities from another one."""
    Reads = _struct("MeasuredReads", before=struct_of(before), link=struct_of(link))

    @wp.func
    def measured_torque(reads: Reads, world: int, joint: int, substep: int, pos: float, vel: float) -> float:
        state = link(reads.link, world, joint, pos, vel)
        return before(reads.before, world, joint, substep, state[0], state[1])

    return measured_torque, Reads


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


@functools.cache
def _torque_kernel(torque: wp.Function) -> wp.Kernel:
    """Return the kernel that evaluates a function as of :func:`joint_torque` for all joints."""
    Reads = struct_of(torque)

    @wp.kernel(module="unique", enable_backward=False, module_options={"fast_math": True})
    def evaluate_torques(
        # In:
        reads: Reads,
        substep: int,
        pos: wp.array2d(dtype=wp.float32),
        vel: wp.array2d(dtype=wp.float32),
        # Out:
        torques: wp.array2d(dtype=wp.float32),
    ):
        world, joint = wp.tid()
        torques[world, joint] = torque(reads, world, joint, substep, pos[world, joint], vel[world, joint])

    return evaluate_torques
