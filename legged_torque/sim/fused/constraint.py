"""Friction and limits of joints: MuJoCo's constraint rows with their masses and references."""

import warp as wp

from legged_torque.sim.fused.tables import Tables, Worlds, dof, of_world, qadr
from legged_torque.sim.fused.types import AnyRows, vec5

MIN_VALUE = wp.constant(1.0e-15)
MIN_IMPEDANCE = wp.constant(1.0e-4)
MAX_IMPEDANCE = wp.constant(0.9999)
"""MuJoCo's mjMINVAL, mjMINIMP and mjMAXIMP."""


@wp.func
def reference_dynamics(solref: wp.vec2, solimp: vec5, pos: float, timestep: float) -> wp.vec3:
    """Return stiffness, damping and impedance of a constraint at a violation (MuJoCo, solver parameters)."""
    low = wp.clamp(solimp[0], MIN_IMPEDANCE, MAX_IMPEDANCE)
    high = wp.clamp(solimp[1], MIN_IMPEDANCE, MAX_IMPEDANCE)
    mid = wp.clamp(solimp[3], MIN_IMPEDANCE, MAX_IMPEDANCE)
    power = wp.max(1.0, solimp[4])
    stiffness = -solref[0] / (high * high)
    damping = -solref[1] / high
    if solref[0] > 0.0:
        time = wp.max(solref[0], 2.0 * timestep)
        stiffness = 1.0 / wp.max(MIN_VALUE, high * high * time * time * solref[1] * solref[1])
        damping = 2.0 / wp.max(MIN_VALUE, high * time)
    x = wp.abs(pos) / wp.max(MIN_VALUE, solimp[2])
    share = float(1.0)
    if solimp[2] <= MIN_VALUE:
        share = 0.5
    elif x < mid:
        share = wp.pow(x, power) / wp.pow(mid, power - 1.0)
    elif x < 1.0:
        share = 1.0 - wp.pow(1.0 - x, power) / wp.pow(1.0 - mid, power - 1.0)
    return wp.vec3(stiffness, damping, low + share * (high - low))


@wp.func
def constraint_mass(invweight: float, impedance: float) -> float:
    """Return D, the inverse of the regularized diagonal of J M^-1 J^T."""
    return 1.0 / wp.max(MIN_VALUE, invweight * (1.0 - impedance) / impedance)


@wp.func
def friction_force(mass: float, loss: float, x: float) -> float:
    """Return the force of a dry friction row: as its spring says, up to the loss."""
    return wp.clamp(-mass * x, -loss, loss)


@wp.func
def friction_state(force: float, loss: float) -> float:
    """Return in which of its three states a dry friction row is: -1, 0 or 1."""
    return wp.where(force <= -loss, -1.0, wp.where(force >= loss, 1.0, 0.0))


@wp.func
def row_force(mass: float, x: float) -> float:
    """Return the force of a one-sided row: it only pushes."""
    return wp.max(0.0, -mass * x)


@wp.func
def make_joint_rows(rows: AnyRows, tables: Tables, worlds: Worlds, world: int, b: int, joints: int):
    """Return the friction and limit rows of a branch, given ones that are all zero."""
    for j in range(len(rows.limit_mass)):
        if j < joints:
            joint = tables.branch_joint[b, j]
            vel = worlds.qvel[world, dof(joint)]
            invweight = of_world(tables.dof_invweight0, world, dof(joint))
            loss = of_world(tables.dof_frictionloss, world, dof(joint))
            if loss > 0.0:
                solref = of_world(tables.dof_solref, world, dof(joint))
                solimp = of_world(tables.dof_solimp, world, dof(joint))
                params = reference_dynamics(solref, solimp, 0.0, tables.timestep)
                rows.friction_loss[j] = loss
                rows.friction_mass[j] = constraint_mass(invweight, params[2])
                rows.friction_reference[j] = -params[1] * vel
            limits = of_world(tables.jnt_range, world, joint)
            pos = worlds.qpos[world, qadr(joint)]
            below, above = pos - limits[0], limits[1] - pos
            dist = wp.min(below, above)
            if dist < 0.0:
                sign = wp.where(below < above, 1.0, -1.0)
                solref = of_world(tables.jnt_solref, world, joint)
                solimp = of_world(tables.jnt_solimp, world, joint)
                params = reference_dynamics(solref, solimp, dist, tables.timestep)
                rows.limit_sign[j] = sign
                rows.limit_mass[j] = constraint_mass(invweight, params[2])
                rows.limit_reference[j] = -params[0] * params[2] * dist - params[1] * sign * vel
    return rows
