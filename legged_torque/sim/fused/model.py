"""The structs Model and State of the kernels, on MuJoCo Warp's own arrays."""

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from legged_torque.sim.fused.tree import Tree
from legged_torque.sim.fused.types import vec5

UNLIMITED = 1e10
"""Bound of a range that does not limit: MuJoCo's mjMAXVAL, beyond which a state has diverged."""
MIN_TOLERANCE = 1e-9
"""Least ``opt.tolerance``: float32 resolves no smaller decrease of the cost."""


@wp.struct
class Model:
    """A robot: fields of MuJoCo Warp's model, and the structure of its tree.

    The model's fields with two axes have one row per world, or one for all; :func:`of_world` reads both.
    """

    # Model:
    gravity: wp.array(dtype=wp.vec3)
    qpos0: wp.array2d(dtype=wp.float32)
    qpos_spring: wp.array2d(dtype=wp.float32)
    body_pos: wp.array2d(dtype=wp.vec3)
    body_quat: wp.array2d(dtype=wp.quat)
    body_ipos: wp.array2d(dtype=wp.vec3)
    body_iquat: wp.array2d(dtype=wp.quat)
    body_mass: wp.array2d(dtype=wp.float32)
    body_inertia: wp.array2d(dtype=wp.vec3)
    body_invweight0: wp.array2d(dtype=wp.vec2)
    jnt_pos: wp.array2d(dtype=wp.vec3)
    jnt_axis: wp.array2d(dtype=wp.vec3)
    jnt_stiffness: wp.array2d(dtype=wp.float32)
    jnt_range: wp.array2d(dtype=wp.vec2)
    jnt_solref: wp.array2d(dtype=wp.vec2)
    jnt_solimp: wp.array2d(dtype=vec5)
    dof_damping: wp.array2d(dtype=wp.float32)
    dof_armature: wp.array2d(dtype=wp.float32)
    dof_frictionloss: wp.array2d(dtype=wp.float32)
    dof_invweight0: wp.array2d(dtype=wp.float32)
    dof_solref: wp.array2d(dtype=wp.vec2)
    dof_solimp: wp.array2d(dtype=vec5)
    geom_pos: wp.array2d(dtype=wp.vec3)
    geom_quat: wp.array2d(dtype=wp.quat)
    geom_size: wp.array2d(dtype=wp.vec3)
    geom_friction: wp.array2d(dtype=wp.vec3)
    geom_solmix: wp.array2d(dtype=wp.float32)
    geom_solref: wp.array2d(dtype=wp.vec2)
    geom_solimp: wp.array2d(dtype=vec5)
    actuator_gear: wp.array2d(dtype=wp.spatial_vector)
    actuator_ctrlrange: wp.array2d(dtype=wp.vec2)
    actuator_forcerange: wp.array2d(dtype=wp.vec2)
    geom_type: wp.array(dtype=wp.int32)
    geom_bodyid: wp.array(dtype=wp.int32)
    geom_priority: wp.array(dtype=wp.int32)
    # Structure:
    geom_sensor: wp.array(dtype=wp.int32)  # address of the geom's contact sensor, -1 without
    joint_count: wp.array(dtype=wp.int32)  # (branch)
    branch_joint: wp.array2d(dtype=wp.int32)  # (branch, depth)
    branch_actuator: wp.array2d(dtype=wp.int32)  # (branch, depth), -1 without
    point_geom: wp.array2d(dtype=wp.int32)  # (branch, point)
    point_depth: wp.array2d(dtype=wp.int32)  # (branch, point), 0 is the trunk
    point_offset: wp.array2d(dtype=wp.vec3)  # (branch, point), in half sizes of the geom
    point_radius: wp.array2d(dtype=wp.float32)  # (branch, point), in first sizes of the geom
    point_parts: wp.array2d(dtype=wp.int32)  # (branch, point), the first one of its geom's parts
    point_next: wp.array2d(dtype=wp.int32)  # (branch, point), the first one of the next geom
    point_half: wp.array2d(dtype=wp.vec3)  # (branch, point), of the part, in half sizes of the geom
    point_count: wp.array(dtype=wp.int32)  # (branch)
    floor: wp.int32  # its geom
    # Options:
    timestep: wp.float32
    impratio: wp.float32
    iterations: wp.int32  # of the solver, at most
    ls_iterations: wp.int32  # of its line search, at most
    cost_scale: wp.float32  # from the cost to MuJoCo's units for its decrease
    tolerance: wp.float32  # the solver stops when a step promises less decrease, in these units


def unread_columns(name: str) -> int:
    """Return how many of the first entries of a field belong to the free joint, and are never read."""
    return {"dof_": 6, "jnt_": 1, "qpos": 7}.get(name[:4], 0)


@wp.struct
class State:
    """The worlds: fields of MuJoCo Warp's data, one row per world."""

    # In:
    ctrl: wp.array2d(dtype=wp.float32)
    # In and out:
    qpos: wp.array2d(dtype=wp.float32)
    qvel: wp.array2d(dtype=wp.float32)
    qacc_warmstart: wp.array2d(dtype=wp.float32)
    # Out:
    sensordata: wp.array2d(dtype=wp.float32)
    solver_niter: wp.array(dtype=wp.int32)
    # In, for kernels with forces that a user applies:
    xfrc_applied: wp.array2d(dtype=wp.spatial_vector)
    qfrc_applied: wp.array2d(dtype=wp.float32)


@wp.func
def local_copy(data: State) -> State:
    """Return the same arrays: with a copy of a kernel's argument, a GPU computes addresses once."""
    return State(
        data.ctrl,
        data.qpos,
        data.qvel,
        data.qacc_warmstart,
        data.sensordata,
        data.solver_niter,
        data.xfrc_applied,
        data.qfrc_applied,
    )


@wp.func
def row(world: int, rows: int) -> int:
    """Return the row of a world in a table with one row per world or one for all."""
    return wp.where(rows == 1, 0, world)


@wp.func
def of_world(field: wp.array2d(dtype=Any), world: int, i: int):
    """Return column ``i`` of a world's row of a field of the model."""
    return field[row(world, field.shape[0]), i]


@wp.func
def dof(joint: int) -> int:
    """Return the degree of freedom of a hinge; joint 0 is the trunk's and has six."""
    return joint + 5


@wp.func
def qadr(joint: int) -> int:
    """Return the index of a hinge's angle in ``qpos``; joint 0 has seven numbers."""
    return joint + 6


_RANGES = {
    "jnt_range": "jnt_limited",
    "actuator_ctrlrange": "actuator_ctrllimited",
    "actuator_forcerange": "actuator_forcelimited",
}
"""Fields that are ranges, and the flags that switch them on."""


def make_model(mj_model: mujoco.MjModel, warp_model: mjw.Model, tree: Tree) -> Model:
    """Return a robot's model on the current device. Its parameters are the arrays of MuJoCo Warp's model, not copies.

    Ranges there that do not limit become infinitely wide.
    """
    for name, limited in _RANGES.items():
        ranges = getattr(warp_model, name).numpy()
        ranges[:, getattr(mj_model, limited) == 0] = -UNLIMITED, UNLIMITED
        getattr(warp_model, name).assign(ranges)
    model = Model()
    for name in Model.vars:
        if hasattr(warp_model, name):
            setattr(model, name, getattr(warp_model, name))
    model.gravity = warp_model.opt.gravity
    model.floor = tree.floor
    model.timestep = mj_model.opt.timestep
    model.impratio = mj_model.opt.impratio
    model.iterations, model.ls_iterations = mj_model.opt.iterations, mj_model.opt.ls_iterations
    model.cost_scale = 1.0 / (mj_model.stat.meaninertia * mj_model.nv)
    model.tolerance = max(mj_model.opt.tolerance, MIN_TOLERANCE)
    sensors = np.full(mj_model.ngeom, -1, np.int32)
    sensors[mj_model.sensor_refid] = mj_model.sensor_adr
    model.geom_sensor = wp.array(sensors, dtype=wp.int32)
    actuator_of = {int(mj_model.actuator_trnid[i, 0]): i for i in range(mj_model.nu)}
    model.joint_count = wp.array((tree.joints >= 0).sum(axis=1), dtype=wp.int32)
    model.branch_joint = wp.array(tree.joints, dtype=wp.int32)
    model.branch_actuator = wp.array(np.vectorize(lambda j: actuator_of.get(j, -1))(tree.joints), dtype=wp.int32)
    none = (0, 0, (0.0, 0.0, 0.0), 0.0, 0, 0, (0.0, 0.0, 0.0))
    padded = [points + [none] * (tree.most_points - len(points)) for points in tree.points]
    dtypes = {"geom": wp.int32, "depth": wp.int32, "offset": wp.vec3, "radius": wp.float32}
    dtypes |= {"parts": wp.int32, "next": wp.int32, "half": wp.vec3}
    for place, (name, dtype) in enumerate(dtypes.items()):
        values = [[point[place] for point in points] for points in padded]
        setattr(model, f"point_{name}", wp.array(values, dtype=dtype))
    model.point_count = wp.array([len(points) for points in tree.points], dtype=wp.int32)
    return model
