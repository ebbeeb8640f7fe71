"""Collision between parts of a robot; ``constraint_self`` has its effect in the solver."""

import functools

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from legged_torque.sim.fused.collision import BOX, CAPSULE, contact_tangent
from legged_torque.sim.fused.collision_primitive import (
    BoxContacts,
    PairContacts,
    Shape,
    between_capsule_and_box,
    between_capsules,
    box_box,
    capsule_box,
    capsule_capsule,
    sphere_box,
    sphere_capsule,
    sphere_sphere,
)
from legged_torque.sim.fused.constraint import Contact, ContactParams, contact_params
from legged_torque.sim.fused.math import column, group_sum, lowest_bit, quat_to_matrix, sum_before, sync_group
from legged_torque.sim.fused.model import Model, of_world
from legged_torque.sim.fused.smooth import Poses
from legged_torque.sim.fused.tree import Tree
from legged_torque.sim.fused.types import vec4, vec5
from legged_torque.utils.mjcf import self_pairs

MAX_SELF_CONTACTS = wp.constant(24)
"""Most contacts of a world between parts of its robot. Further ones are dropped and reported in ``overflow``."""
AT_ONCE = wp.constant(8)
"""Pairs whose spheres a thread reads at once."""
WORD = wp.constant(32)
"""Pairs that a thread looks at before all threads of its world say what they have found: bits of a number."""
SPHERE = wp.constant(2)
"""MuJoCo's mjGEOM_SPHERE."""
REACH, X_AXIS, Z_AXIS = wp.constant(3), wp.constant(4), wp.constant(7)
"""Where a geom's numbers have the radius of a sphere around it, and two of its axes; its position is first."""
OVERFLOW = wp.constant(int(mjw.OverflowType.NARROWPHASE))


@wp.struct
class SelfContacts:
    """The pairs of geoms that may touch, and the contacts between them."""

    # Model:
    pair: wp.array(dtype=wp.vec2i)  # its geoms, first that of the simpler type
    named: wp.array(dtype=wp.int32)  # of each pair: number of the MJCF's <pair>, -1 of others
    pair_friction: wp.array2d(dtype=vec5)  # of each <pair>, fields of MuJoCo Warp's model
    pair_solref: wp.array2d(dtype=wp.vec2)
    pair_solimp: wp.array2d(dtype=vec5)
    geom: wp.array(dtype=wp.int32)  # all geoms of pairs, branch by branch; the trunk's are in the first one
    geom_start: wp.array(dtype=wp.int32)  # of each branch, and the end
    geom_place: wp.array(dtype=wp.vec2i)  # of each geom: branch, and depth of its body; 0 is the trunk
    airborne: wp.array(dtype=wp.int32)  # addresses of the sensors of those geoms that the ground lets through
    # Scratch; worlds are last where threads read and write neighbours:
    place: wp.array3d(dtype=wp.float32)  # (geom, 10, world): position from the trunk's origin, see REACH and the axes
    near: wp.array2d(dtype=wp.int32)  # (place, world): the pairs that may touch, those of each thread in order
    found: wp.array(dtype=Contact)  # MAX_SELF_CONTACTS for each world; the next three as in PlaneContacts
    residual: wp.array(dtype=vec4)
    pushing: wp.array(dtype=vec4)
    change: wp.array(dtype=vec4)
    of_pair: wp.array(dtype=wp.int32)  # of each contact: its pair
    dist: wp.array(dtype=wp.float32)  # of each contact, negative [m]
    normal: wp.array(dtype=wp.vec3)  # of each contact, from the first geom to the second
    jacobian: wp.array2d(dtype=wp.vec3)  # (contact, joint): motion of the second body less that of the first
    pushed: wp.array2d(dtype=wp.vec3)  # (contact, joint): its stiffness times that motion
    joints: wp.array2d(dtype=wp.float32)  # (world, joint): a step
    matrix: wp.array3d(dtype=wp.float32)  # (world, row, column): the whole Newton system, see ``constraint_self``
    # Out:
    overflow: wp.array(dtype=wp.int32)  # MuJoCo Warp's, of each world


@wp.struct
class Touching:
    """The contacts of a thread's world; apart from the arrays, since writing into a struct copies all of it."""

    first: wp.int32
    end: wp.int32
    coupled: wp.bool  # whether one between two branches pushes


def ordered_pairs(model: mujoco.MjModel) -> np.ndarray:
    """Return the pairs of geoms that may touch on a robot, in MuJoCo's order: the simpler type first. Shape: (n, 2)."""
    pairs = self_pairs(model)
    return np.take_along_axis(pairs, model.geom_type[pairs].argsort(axis=1, kind="stable"), axis=1)


def pair_kinds(model: mujoco.MjModel) -> tuple[tuple[int, int], ...]:
    """Return the pairs of types of these geoms, each once."""
    return tuple(sorted({(int(a), int(b)) for a, b in model.geom_type[ordered_pairs(model)]}))


def make_self_contacts(model: mujoco.MjModel, warp_model: mjw.Model, tree: Tree, data: mjw.Data) -> SelfContacts:
    """Return the pairs of a robot and room for their contacts, on the current device."""
    branches, worlds, joints = len(tree.joints), data.nworld, model.nv - 6
    out, pairs = SelfContacts(), ordered_pairs(model)
    out.pair = wp.array(pairs, dtype=wp.vec2i)
    named = {frozenset(pair): i for i, pair in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))}
    out.named = wp.array([named.get(frozenset(pair), -1) for pair in pairs.tolist()], dtype=wp.int32)
    for name in ("pair_friction", "pair_solref", "pair_solimp"):
        setattr(out, name, getattr(warp_model, name))
    on_ground = [point[0] for points in tree.points for point in points]
    airborne = np.setdiff1d(pairs, on_ground)
    out.airborne = wp.array(model.sensor_adr[np.isin(model.sensor_refid, airborne)], dtype=wp.int32)
    out.geom_place = wp.array(tree.geom_places, dtype=wp.vec2i)
    geoms = sorted(np.unique(pairs).tolist(), key=lambda geom: tree.geom_places[geom])
    owners = [tree.geom_places[geom][0] for geom in geoms]
    out.geom = wp.array(geoms, dtype=wp.int32)
    out.geom_start = wp.array(np.searchsorted(owners, range(branches + 1)), dtype=wp.int32)
    out.place = wp.empty((model.ngeom, Z_AXIS + 3, worlds), dtype=wp.float32)
    out.near = wp.empty((len(pairs), worlds), dtype=wp.int32)
    room = worlds * MAX_SELF_CONTACTS
    out.found, out.of_pair = (wp.empty(room, dtype=dtype) for dtype in (Contact, wp.int32))
    out.normal, out.dist = (wp.empty(room, dtype=dtype) for dtype in (wp.vec3, wp.float32))
    out.residual, out.pushing, out.change = (wp.empty(room, dtype=vec4) for _ in range(3))
    out.jacobian, out.pushed = (wp.empty((room, joints), dtype=wp.vec3) for _ in range(2))
    out.joints = wp.empty((worlds, joints), dtype=wp.float32)
    out.matrix = wp.empty((worlds, model.nv + 1, model.nv), dtype=wp.float32)
    out.overflow = data.overflow
    return out


@wp.func
def read_place(selves: SelfContacts, world: int, geom: int, first: int) -> wp.vec3:
    """Return three of the numbers that say where a geom is, from one on."""
    x, y = selves.place[geom, first, world], selves.place[geom, first + 1, world]
    return wp.vec3(x, y, selves.place[geom, first + 2, world])


@wp.func
def write_place(selves: SelfContacts, world: int, geom: int, first: int, value: wp.vec3):
    """Write three of these numbers."""
    for k in range(3):
        selves.place[geom, first + k, world] = value[k]


@wp.func
def shape_of(model: Model, selves: SelfContacts, world: int, geom: int) -> Shape:
    """Return a geom in the world."""
    x_axis, z_axis = read_place(selves, world, geom, X_AXIS), read_place(selves, world, geom, Z_AXIS)
    rot = wp.matrix_from_cols(x_axis, wp.cross(z_axis, x_axis), z_axis)
    return Shape(read_place(selves, world, geom, 0), rot, of_world(model.geom_size, world, geom))


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
    """Write where the geoms of a branch are, for the other threads of its world."""
    for i in range(selves.geom_start[b], selves.geom_start[b + 1]):
        geom = selves.geom[i]
        pose = poses[selves.geom_place[geom][1]]
        rot = pose.rot * quat_to_matrix(of_world(model.geom_quat, world, geom))
        write_place(selves, world, geom, 0, pose.pos + pose.rot * of_world(model.geom_pos, world, geom))
        selves.place[geom, REACH, world] = reach_of(model, world, geom)
        write_place(selves, world, geom, X_AXIS, column(rot, 0))
        write_place(selves, world, geom, Z_AXIS, column(rot, 2))


@wp.func
def are_near(selves: SelfContacts, world: int, geoms: wp.vec2i) -> bool:
    """Return whether spheres around two geoms overlap."""
    apart = read_place(selves, world, geoms[1], 0) - read_place(selves, world, geoms[0], 0)
    reach = selves.place[geoms[0], REACH, world] + selves.place[geoms[1], REACH, world]
    return wp.length_sq(apart) <= reach * reach


@wp.func
def are_separate(model: Model, selves: SelfContacts, world: int, geoms: wp.vec2i) -> bool:
    """Return whether a plane is between two geoms; False if none of a few is. Not for two boxes.

    A sphere counts as a capsule, which is longer if the file gives it a second size.
    """
    separate = bool(False)
    if model.geom_type[geoms[0]] != BOX:
        a, b = shape_of(model, selves, world, geoms[0]), shape_of(model, selves, world, geoms[1])
        if model.geom_type[geoms[1]] == BOX:
            separate = between_capsule_and_box(a, b)
        else:
            separate = between_capsules(a, b)
    return separate


@wp.func
def write_near(model: Model, selves: SelfContacts, world: int, thread: int, threads: int) -> int:
    """Write the pairs of a world that may touch, those of each thread in order, and return their number.

    Few are near. Threads collect these before they look closer, or they would wait for each other at every pair.
    """
    end, pairs = int(0), selves.pair.shape[0]
    for word in range(0, pairs, WORD * threads):
        start = word + thread
        near, may_touch = int(0), int(0)  # a bit for each pair of this thread
        k = int(0)
        while k < WORD:
            for i in range(AT_ONCE):  # a condition on the pair would keep their reads apart
                pair = start + (k + i) * threads
                is_near = are_near(selves, world, selves.pair[wp.min(pair, pairs - 1)])
                near |= wp.where(pair < pairs, wp.where(is_near, 1 << (k + i), 0), 0)
            k += AT_ONCE
        number = float(0.0)
        while near != 0:
            bit = lowest_bit(near)
            near ^= 1 << bit
            if not are_separate(model, selves, world, selves.pair[start + bit * threads]):
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


_COLLIDE: dict[tuple[int, int], wp.Function] = {
    (SPHERE, SPHERE): sphere_sphere,
    (SPHERE, CAPSULE): sphere_capsule,
    (SPHERE, BOX): sphere_box,
    (CAPSULE, CAPSULE): capsule_capsule,
    (CAPSULE, BOX): capsule_box,
    (BOX, BOX): box_box,
}


@wp.func
def pair_params(model: Model, selves: SelfContacts, world: int, pair: int) -> ContactParams:
    """Return friction and softness of a pair's contacts: its own, or those of its geoms."""
    params = contact_params(model, world, selves.pair[pair][0], selves.pair[pair][1])
    named = selves.named[pair]
    if named >= 0:
        friction = of_world(selves.pair_friction, world, named)[0]
        solref, solimp = of_world(selves.pair_solref, world, named), of_world(selves.pair_solimp, world, named)
        params = ContactParams(friction, solref, solimp)
    return params


@functools.cache
def self_contact_finder(kinds: tuple[tuple[int, int], ...], threads: int) -> wp.Function:
    """Return ``find_self_contacts`` for a number of threads per world; it has no code for other pairs of types."""
    Contacts = BoxContacts if (BOX, BOX) in kinds else PairContacts

    @wp.func
    def find_self_contacts(model: Model, selves: SelfContacts, world: int, thread: int) -> Touching:
        """Write a world's contacts between parts of the robot, in the order of near pairs, and return their range.

        Each thread collides one pair at a time, after all parts have been written. Their rows are not written yet.
        """
        first_contact = world * MAX_SELF_CONTACTS
        last = first_contact + MAX_SELF_CONTACTS
        end = first_contact + 0
        near = write_near(model, selves, world, thread, wp.static(threads))
        sync_group(wp.static(threads))
        for start in range(0, near, wp.static(threads)):
            touch = Contacts()
            pair = int(0)
            if start + thread < near:
                pair = selves.near[start + thread, world]
                geoms = selves.pair[pair]
                first, second = model.geom_type[geoms[0]], model.geom_type[geoms[1]]
                a, b = shape_of(model, selves, world, geoms[0]), shape_of(model, selves, world, geoms[1])
                for i in range(wp.static(len(kinds))):
                    if first == wp.static(kinds[i][0]) and second == wp.static(kinds[i][1]):
                        touch = wp.static(_COLLIDE[kinds[i]])(touch, a, b)
            new = int(group_sum(float(touch.count), wp.static(threads)))
            if new > 0:
                place = end + int(sum_before(float(touch.count), thread, wp.static(threads)))
                for i in range(touch.count):
                    if place + i < last:
                        contact = Contact()
                        contact.pos = touch.pos[i]
                        contact.tangent = contact_tangent(touch.normal[i], wp.vec3(0.0), False)
                        selves.found[place + i] = contact
                        selves.of_pair[place + i] = pair
                        selves.normal[place + i] = touch.normal[i]
                        selves.dist[place + i] = touch.dist[i]
                end += new
        if end > last and thread == 0:
            selves.overflow[world] = selves.overflow[world] | OVERFLOW
        return Touching(first_contact, wp.min(end, last), False)

    return find_self_contacts
