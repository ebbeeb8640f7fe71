"""Assignment of a robot's branches to the threads of its world.

On a GPU a thread has one branch, which stays in registers: functions hand it on as ``branch``. On a CPU a thread has
all branches of its world, and ``Scratch.branch`` holds those that are not in use.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from legged_torque.sim.fused.collision import PlaneContacts
from legged_torque.sim.fused.collision_map import MAX_MAP_CONTACTS, MapContacts
from legged_torque.sim.fused.collision_self import SelfContacts
from legged_torque.sim.fused.model import Model
from legged_torque.sim.fused.tree import Tree
from legged_torque.sim.fused.types import AnyBranch, branch_types


class Layout(NamedTuple):
    """A robot's structure and the threads of its world, for which kernels are compiled."""

    branches: int
    depth: int  # most joints of a branch
    points: int  # most contacts of a branch with the ground
    threads: int  # per world, a power of two; 1 on a CPU
    on_map: bool  # whether the ground is a height map, not a plane
    alike: bool  # whether all branches have ``depth`` joints; else some have fewer
    cylinders: bool  # whether any geom that can touch the ground is one
    self_kinds: tuple[tuple[int, int], ...]  # types of pairs of geoms on the robot that may touch each other

    @classmethod
    def of(
        cls, tree: Tree, on_gpu: bool, on_map: bool = False, self_kinds: tuple[tuple[int, int], ...] = ()
    ) -> "Layout":
        """Return a robot's layout: on a GPU a thread per branch, rounded up to a power of two, else one per world."""
        branches, depth = tree.joints.shape
        points = tree.most_points * (MAX_MAP_CONTACTS if on_map else 1)
        threads, alike = 1 << (branches - 1).bit_length() if on_gpu else 1, bool((tree.joints >= 0).all())
        return cls(branches, depth, points, threads, on_map, alike, tree.has_cylinders, self_kinds)

    @property
    def per_thread(self) -> int:
        """Most branches of a thread."""
        return -(-self.branches // self.threads)


class Branches(NamedTuple):
    """The parts of a layout that functions over the branches of a thread use."""

    threads: int
    per_thread: int
    collide: bool  # whether parts of the robot may touch each other
    Scratch: Any
    owns: wp.Function
    load: wp.Function
    store: wp.Function
    num_joints: wp.Function


@functools.cache
def branches_of(layout: Layout) -> Branches:
    """Return the struct ``Scratch`` of a layout, and functions on the branches of a thread.

    ``owns`` returns whether a thread has a branch number ``i``; ``load`` and ``store`` do nothing if it has only one,
    which stays in registers. ``num_joints`` is a constant if all branches are alike, so that nothing is masked.
    """
    branches, depth, _, threads, on_map, alike, _, self_kinds = layout
    per_thread, Branch = layout.per_thread, branch_types(depth).Branch
    Contacts, Selves = MapContacts if on_map else PlaneContacts, SelfContacts if self_kinds else wp.int32

    @wp.struct
    class Scratch:
        contacts: Contacts  # with the ground
        selves: Selves  # contacts between parts of the robot; 0 if there are none
        branch: wp.array(dtype=Branch)  # the branches of threads that have several

    @wp.func
    def owns(thread: int, i: int) -> bool:
        # What is known at compile time saves moves and spills: a quarter of the solver's instructions.
        return wp.static(branches == threads * per_thread) or thread + i * wp.static(threads) < wp.static(branches)

    @wp.func
    def load(scratch: Scratch, world: int, i: int, branch: AnyBranch):
        if wp.static(per_thread > 1):
            branch = scratch.branch[world * wp.static(per_thread) + i]
        return branch

    @wp.func
    def store(scratch: Scratch, world: int, i: int, branch: AnyBranch):
        if wp.static(per_thread > 1):
            scratch.branch[world * wp.static(per_thread) + i] = branch

    @wp.func
    def num_joints(model: Model, b: int) -> int:
        if wp.static(alike):
            return wp.static(depth)
        return model.joint_count[b]

    return Branches(threads, per_thread, bool(self_kinds), Scratch, owns, load, store, num_joints)
