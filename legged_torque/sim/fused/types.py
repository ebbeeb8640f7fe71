"""Structs that kernels hold in registers; those of a branch exist once per number of joints.

Functions on branches are generic: their parameters are annotated with the names below, and Warp makes one version per
number of joints. Loops over ``len(vector)`` are unrolled.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

vec4 = wp.types.vector(length=4, dtype=wp.float32)
vec5 = wp.types.vector(length=5, dtype=wp.float32)
vec6 = wp.types.vector(length=6, dtype=wp.float32)
vec8 = wp.types.vector(length=8, dtype=wp.float32)
mat66 = wp.types.matrix(shape=(6, 6), dtype=wp.float32)
mat23 = wp.types.matrix(shape=(2, 3), dtype=wp.float32)
mat83 = wp.types.matrix(shape=(8, 3), dtype=wp.float32)

AnyVector = AnyMatrix = AnyColumns = Any
"""A number per joint of a branch; a square matrix; a vector in space per joint."""
AnyBranch = AnyLinks = AnyRows = Any
"""``Branch``, ``Links`` and ``JointRows`` of :func:`branch_types`."""
AnyContacts = Any
"""``PlaneContacts`` with a plane, ``MapContacts`` with a height map."""
AnyPairContacts = Any
"""``PairContacts``, or ``BoxContacts`` if two boxes may touch."""


@wp.struct
class Body:
    """Inertia of a body, and the wrench that its gravity and velocity require, about the trunk's origin."""

    mass: wp.float32
    moment: wp.vec3
    inertia: wp.mat33
    force: wp.vec3
    torque: wp.vec3


@wp.struct
class Trunk:
    """State and inertia of the trunk."""

    pos: wp.vec3  # in the world [m]
    quat: wp.quat
    rot: wp.mat33  # from the trunk's axes to the world's
    lin_vel: wp.vec3
    ang_vel: wp.vec3  # in world axes
    body: Body


class BranchTypes(NamedTuple):
    """The structs of branches with the same number of joints."""

    Branch: Any
    Links: Any
    Smooth: Any


@functools.cache
def branch_types(n: int) -> BranchTypes:
    """Return the structs of branches of ``n`` joints."""
    vector = wp.types.vector(length=n, dtype=wp.float32)
    matrix = wp.types.matrix(shape=(n, n), dtype=wp.float32)
    columns = wp.types.matrix(shape=(3, n), dtype=wp.float32)

    @wp.struct
    class Links:
        """The bodies of a branch, each as in :class:`Body`."""

        mass: vector
        moment: columns
        inertia_diagonal: columns  # xx, yy, zz
        inertia_rest: columns  # xy, xz, yz
        force: columns
        torque: columns

    @wp.struct
    class Smooth:
        """Equations of motion of a branch without constraints, and its terms in the trunk's."""

        axis: columns  # of each joint, in the world
        lever: columns  # velocity at the trunk's origin per unit of joint velocity
        mass: matrix
        mass_lin: columns  # coupling with the trunk's translation
        mass_ang: columns  # and with its rotation, in the trunk's axes
        force: vector  # torques, springs and dampers less the bias [N m]
        damping: vector
        total: Body

    @wp.struct
    class JointRows:
        """Friction rows, one per joint, and limit rows, at most one per joint."""

        friction_mass: vector  # D, 0 without dry friction
        friction_loss: vector
        friction_reference: vector
        limit_mass: vector  # D, 0 inside the range
        limit_sign: vector  # +1 at the lower limit, -1 at the upper one
        limit_reference: vector

    @wp.struct
    class Residuals:
        """J a - a_ref of the joint rows, or J times a direction."""

        friction: vector
        limit: vector

    @wp.struct
    class Branch:
        """A branch in the solver: its equations, its accelerations, and the solver's step."""

        smooth: Smooth
        rows: JointRows
        first_contact: int  # its contacts' indices
        num_contacts: int
        acc: vector
        residuals: Residuals
        step: vector
        change: Residuals  # of the residuals per unit of the step
        factor: matrix  # Cholesky factor of the Hessian's block
        coupling_lin: columns  # Hessian's blocks with the trunk
        coupling_ang: columns
        gradient: vector
        trunk_gradient_lin: wp.vec3  # this branch's part
        trunk_gradient_ang: wp.vec3

    return BranchTypes(Branch, Links, Smooth)
