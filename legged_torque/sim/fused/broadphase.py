"""The pairs of a robot's parts that may touch, found before a step, and the worlds that have some.

These worlds are stepped by a kernel of their own: what parts that touch need slows down all others.
"""

import functools

import warp as wp

from legged_torque.sim.fused.collision import BOX, CAPSULE
from legged_torque.sim.fused.collision_primitive import axis_of
from legged_torque.sim.fused.collision_self import SelfContacts, shape_of
from legged_torque.sim.fused.integrate import clear_airborne
from legged_torque.sim.fused.layout import Layout, branches_of
from legged_torque.sim.fused.math import group_sum, lowest_bit, quat_to_matrix, sum_before, sync_group
from legged_torque.sim.fused.model import Model, State, local_copy, of_world
from legged_torque.sim.fused.smooth import Pose, Poses, links_maker, make_trunk
from legged_torque.sim.fused.types import vec4

AT_ONCE = wp.constant(8)
"""Pairs whose spheres a thread reads at once."""
WORD = wp.constant(32)
"""Pairs that a thread looks at before all threads of its world say what they have found: bits of a number."""
ALL, NEAR, FAR = -1, wp.constant(0), wp.constant(1)
"""Parts of the worlds that a kernel steps, see :class:`SortedWorlds`."""


@wp.struct
class SortedWorlds:
    """Worlds in two parts: at the end those in which no parts are near each other, at the start the others.

    They are in any order, and all threads of a warp have much or little to do.
    """

    order: wp.array(dtype=wp.int32)
    number: wp.array(dtype=wp.int32)  # of worlds of each part


@wp.func
def sort_world(worlds: SortedWorlds, world: int, is_near: bool):
    """Put a world into its part."""
    if is_near:
        worlds.order[wp.atomic_add(worlds.number, NEAR, 1)] = world
    else:
        worlds.order[worlds.order.shape[0] - 1 - wp.atomic_add(worlds.number, FAR, 1)] = world


@wp.func
def world_of(worlds: SortedWorlds, part: int, place: int) -> int:
    """Return a world of a part."""
    return worlds.order[wp.where(part == NEAR, place, worlds.order.shape[0] - 1 - place)]


@wp.func
def reach_of(model: Model, world: int, geom: int) -> float:
    """Return the radius of a sphere around a geom [m]."""
    size = of_world(model.geom_size, world, geom)
    reach = size[0]
    if model.geom_type[geom] == CAPSULE:
        reach = size[0] + size[1]
    if model.geom_type[geom] == BOX:
        reach = wp.length(size)
    return reach


@wp.func
def write_parts(model: Model, selves: SelfContacts, world: int, b: int, poses: Poses):
    """Write where the geoms of a branch are, and how its bodies move, for the other threads of its world."""
    for d in range(poses.shape[0]):
        selves.lin_vel[b, d, world] = poses[d].lin_vel
        selves.ang_vel[b, d, world] = poses[d].ang_vel
    for i in range(selves.geom_start[b], selves.geom_start[b + 1]):
        geom = selves.geom[i]
        pose = poses[selves.geom_place[geom][1]]
        pos = pose.pos + pose.rot * of_world(model.geom_pos, world, geom)
        rot = pose.rot * quat_to_matrix(of_world(model.geom_quat, world, geom))
        selves.sphere[geom, world] = vec4(pos[0], pos[1], pos[2], reach_of(model, world, geom))
        selves.x_axis[geom, world] = vec4(rot[0, 0], rot[1, 0], rot[2, 0], 0.0)
        selves.z_axis[geom, world] = vec4(rot[0, 2], rot[1, 2], rot[2, 2], 0.0)


@wp.func
def are_near(selves: SelfContacts, world: int, geoms: wp.vec2i) -> bool:
    """Return whether spheres around two geoms overlap."""
    first, second = selves.sphere[geoms[0], world], selves.sphere[geoms[1], world]
    apart = wp.vec3(second[0] - first[0], second[1] - first[1], second[2] - first[2])
    reach = first[3] + second[3]
    return wp.length_sq(apart) <= reach * reach


@wp.func
def is_beside(model: Model, selves: SelfContacts, world: int, geoms: wp.vec2i) -> bool:
    """Return whether a sphere or capsule lies beyond one of the faces of a box; False for other pairs.

    A sphere counts as a capsule, which is longer if the file gives it a second size.
    """
    beside = bool(False)
    if model.geom_type[geoms[1]] == BOX and model.geom_type[geoms[0]] != BOX:
        shape, box = shape_of(model, selves, world, geoms[0]), shape_of(model, selves, world, geoms[1])
        apart, axis = wp.transpose(box.rot) * (shape.pos - box.pos), wp.transpose(box.rot) * axis_of(shape)
        outside = wp.abs(apart) - wp.abs(axis) - box.size
        beside = wp.max(outside) > shape.size[0]
    return beside


@wp.func
def write_near(model: Model, selves: SelfContacts, world: int, thread: int, threads: int) -> int:
    """Write the pairs of a world that may touch, those of each thread in order, and return their number.

    Few are near. Threads collect these before they look closer, or they would wait for each other at every pair.
    """
    end = int(0)
    for word in range(0, selves.pair.shape[0], WORD * threads):
        start = word + thread
        near, may_touch = int(0), int(0)  # a bit for each pair of this thread
        k = int(0)
        while k < WORD:
            for i in range(AT_ONCE):
                pair = start + (k + i) * threads
                if pair < selves.pair.shape[0]:
                    near |= wp.where(are_near(selves, world, selves.pair[pair]), 1 << (k + i), 0)
            k += AT_ONCE
        number = float(0.0)
        while near != 0:
            bit = lowest_bit(near)
            near ^= 1 << bit
            if not is_beside(model, selves, world, selves.pair[start + bit * threads]):
                may_touch |= 1 << bit
                number += 1.0
        found = int(group_sum(number, threads))
        if found > 0:
            place = end + int(sum_before(number, thread, threads))
            while may_touch != 0:
                bit = lowest_bit(may_touch)
                may_touch ^= 1 << bit
                selves.near[place, world] = start + bit * threads
                place += 1
            end += found
    return end


@functools.cache
def make_broadphase_kernel(layout: Layout, sorts: bool) -> wp.Kernel:
    """Return the kernel that finds pairs of a robot's parts that may touch, and maybe sorts worlds by having some."""
    own, make_links = branches_of(layout), links_maker(layout.depth)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def broadphase(
        first_world: int,
        # Model:
        model: Model,
        # Data in:
        data: State,
        # Out:
        selves: SelfContacts,
        worlds: SortedWorlds,
        sense: bool,
    ):
        place, thread = wp.tid()
        world = first_world + place
        state = local_copy(data)
        trunk = make_trunk(model, state, world)
        for i in range(wp.static(own.per_thread)):
            b = thread + i * wp.static(own.threads)
            if own.owns(thread, i):
                poses = wp.zeros(shape=wp.static(layout.depth + 1), dtype=Pose)
                make_links(model, state, world, b, own.num_joints(model, b), trunk, poses)
                write_parts(model, selves, world, b, poses)
        sync_group(wp.static(own.threads))
        near = write_near(model, selves, world, thread, wp.static(own.threads))
        if thread == 0:
            selves.number[world] = near
            if wp.static(sorts):
                sort_world(worlds, world, near > 0)
            if sense:
                clear_airborne(state, world, selves)

    return broadphase
