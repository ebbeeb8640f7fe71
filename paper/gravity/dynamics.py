"""Inertia, bias forces and Jacobians of many states of one robot, from MuJoCo Warp."""

import contextlib
import functools
from collections.abc import Iterator, Sequence

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged_torque.sim.graph import prepare_device
from legged_torque.utils.errors import UserError, check_names

TRUNK = 1  # the trunk's body
TRUNK_DOFS = 6
"""Virtual joints of the trunk: linear velocity in the world frame, then angular velocity in the trunk's frame."""


class RobotDynamics:
    """The robot's nominal model, which is all that the controller knows, at ``num_states`` states at once.

    It has its own MuJoCo Warp ``Data``, because the simulator's fused step does not fill one, and because the
    controller must not know the randomized parameters of the simulated worlds. Points of contact are the lowest points
    of spheres, as on level ground. Nothing here waits for the host, and all tensors keep their addresses.

    Attributes:
        inertia: Joint space inertia A(q), armatures included. Shape: (n, nv, nv), n being the number of states.
        gravity: Generalized forces g(q): A qacc + coriolis + gravity are the applied forces. Shape: (n, nv).
        coriolis: Coriolis and centrifugal forces. Shape: (n, nv).
        contact_points: World positions of the candidate contact points [m]. Shape: (n, k, 3).
        contact_jacobians: J_c of eq. 9: point velocity in the world frame from qvel. Shape: (n, k, 3, nv).
        contact_bias: dJ_c/dt qvel: acceleration of the points at qacc = 0 [m/s^2]. Shape: (n, k, 3).
        trunk_jacobian: Trunk's linear, then angular velocity, both in the world frame. Its own rate of change times
            qvel is zero, since qacc turned into the world frame is the trunk's acceleration. Shape: (n, 6, nv).
        trunk_position: World position of the trunk's origin [m]. Shape: (n, 3).
        trunk_rotation: Turns trunk vectors into world vectors. Shape: (n, 3, 3).
        com: Centre of mass of the whole robot in the world [m]. Shape: (n, 3).
        geom_positions: World positions of all geoms [m]. Shape: (n, ngeom, 3).
        geom_rotations: Turn geom vectors into world vectors. Shape: (n, ngeom, 3, 3).
        contact_joints: Joints between the trunk and each contact point. Shape: (k, nv - 6), bool.
    """

    def __init__(self, mj_model: mujoco.MjModel, num_states: int, device: str, contact_geoms: Sequence[str]) -> None:
        """Prepare the model and all buffers, on "cpu" or "cuda:N", for contacts of spheres with these names.

        Raises:
            UserError: If a contact geom is missing or no sphere, the first body is not free, or a joint is no hinge.
        """
        names = [mj_model.geom(i).name for i in range(mj_model.ngeom)]
        _check_model(mj_model, contact_geoms, names)
        prepare_device(device)
        self.mj_model, self.num_states, self.device = mj_model, num_states, device
        with wp.ScopedDevice(device):
            self._model = mjw.put_model(mj_model)
            self._data = mjw.make_data(mj_model, nworld=num_states, nconmax=1, njmax=1)  # no contacts are sought
        geoms = [names.index(name) for name in contact_geoms]
        bodies = mj_model.geom_bodyid[geoms]
        self.contact_joints = wp.to_torch(self._model.body_isdofancestor)[bodies, TRUNK_DOFS : mj_model.nv].bool()
        self._geoms, self._bodies = (torch.tensor(ids, dtype=torch.long, device=device) for ids in (geoms, bodies))
        self._radii = torch.tensor(mj_model.geom_size[geoms, 0], dtype=torch.float32, device=device)
        self._weight_per_mass = torch.tensor(-mj_model.opt.gravity, dtype=torch.float32, device=device)
        entries, present = _dense_entries(mj_model)
        self._entries = torch.tensor(entries, device=device)
        self._present = torch.tensor(present, dtype=torch.float32, device=device)
        self._view_data()
        self._allocate(bodies)

    def update(self, qpos: Tensor, qvel: Tensor) -> None:
        """Evaluate everything at new states, as in the simulator's ``qpos`` and ``qvel`` (n, nq), (n, nv)."""
        self._qpos.copy_(qpos)
        self._qvel.copy_(qvel)
        model, data = self._model, self._data
        with wp.ScopedDevice(self.device):
            mjw.kinematics(model, data)
            mjw.com_pos(model, data)
            mjw.crb(model, data)
            mjw.com_vel(model, data)
            mjw.rne(model, data)
            self._place_contacts()
            for body, point, linear, angular in self._jacobian_jobs:
                mjw.jac(model, data, linear, angular, point, body)
        torch.mul(self._inertia_data[:, self._entries], self._present, out=self.inertia)
        # A uniform gravity field acts like an acceleration of the ground the other way.
        torch.matmul(self.inertia[:, :, :3], self._weight_per_mass, out=self.gravity)
        torch.sub(self._bias, self.gravity, out=self.coriolis)

    def _place_contacts(self) -> None:
        """Compute contact points and their accelerations at qacc = 0."""
        points = self.geom_positions[:, self._geoms]
        points[:, :, 2] -= self._radii
        self.contact_points.copy_(points)
        # Spatial motion in MuJoCo is (angular, linear) at the centre of mass; gravity is an acceleration of the world.
        velocity, acceleration = self._body_velocity[:, self._bodies], self._body_acceleration[:, self._bodies]
        arm = points - self.com.unsqueeze(1)
        spin = velocity[..., :3]
        point_velocity = velocity[..., 3:] + torch.linalg.cross(spin, arm)
        linear = acceleration[..., 3:] - self._weight_per_mass + torch.linalg.cross(acceleration[..., :3], arm)
        torch.add(linear, torch.linalg.cross(spin, point_velocity), out=self.contact_bias)

    def _view_data(self) -> None:
        """Make torch views of MuJoCo Warp's memory."""
        data = self._data
        self._qpos, self._qvel, self._bias = (wp.to_torch(a) for a in (data.qpos, data.qvel, data.qfrc_bias))
        self._inertia_data = wp.to_torch(data.M)
        self._body_velocity, self._body_acceleration = wp.to_torch(data.cvel), wp.to_torch(data.cacc)
        self.trunk_position = wp.to_torch(data.xpos)[:, TRUNK]
        self.trunk_rotation = wp.to_torch(data.xmat)[:, TRUNK]
        self.com = wp.to_torch(data.subtree_com)[:, TRUNK]
        self.geom_positions, self.geom_rotations = wp.to_torch(data.geom_xpos), wp.to_torch(data.geom_xmat)

    def _allocate(self, bodies: np.ndarray) -> None:
        """Allocate the results, Jacobians contact by contact, and list the points whose Jacobians are needed."""
        n, nv, k = self.num_states, self.mj_model.nv, len(bodies)
        zeros = functools.partial(torch.zeros, device=self.device)
        self.inertia, self.gravity, self.coriolis = zeros(n, nv, nv), zeros(n, nv), zeros(n, nv)
        self.contact_bias, self.trunk_jacobian = zeros(n, k, 3), zeros(n, 6, nv)
        points, jacobians = zeros(k, n, 3), zeros(k, n, 3, nv)
        self.contact_points, self.contact_jacobians = points.transpose(0, 1), jacobians.transpose(0, 1)
        self._jacobian_jobs: list[tuple] = [
            (self._body_ids(body), wp.from_torch(point, dtype=wp.vec3), wp.from_torch(jacobian), None)
            for body, point, jacobian in zip(bodies, points, jacobians, strict=True)
        ]
        linear, angular = (wp.from_torch(rows) for rows in (self.trunk_jacobian[:, :3], self.trunk_jacobian[:, 3:]))
        self._jacobian_jobs.append((self._body_ids(TRUNK), self._data.xpos[:, TRUNK], linear, angular))

    def _body_ids(self, body: int) -> wp.array:
        """Return one body's number for every state."""
        return wp.full(self.num_states, int(body), dtype=int, device=self.device)


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Let torch use one CPU thread inside; as a decorator, in a function.

    Factorizing many small matrices took 30 times as long with two threads as with one, on two cores with other work.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _check_model(model: mujoco.MjModel, contact_geoms: Sequence[str], names: list[str]) -> None:
    """Raise a UserError for robots to which the formulas here do not apply."""
    types = model.jnt_type
    if types[0] != mujoco.mjtJoint.mjJNT_FREE or (types[1:] != mujoco.mjtJoint.mjJNT_HINGE).any():
        raise UserError("whole-body control needs a robot with a free trunk, all other joints being hinges")
    if not contact_geoms:
        raise UserError("whole-body control needs at least one geom that may touch the ground")
    for name in contact_geoms:
        check_names("contact geom", [name], names)
        if model.geom(name).type[0] != mujoco.mjtGeom.mjGEOM_SPHERE:
            raise UserError(f"the contact geom '{name}' must be a sphere")


def _dense_entries(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of the inertia matrix's entries in MuJoCo's array, and which are present. Shapes: (nv, nv)."""
    lower, numbers = np.zeros((model.nv, model.nv)), np.arange(1.0, model.nC + 1.0)
    mujoco.mju_sparse2dense(lower, numbers, model.M_rownnz, model.M_rowadr, model.M_colind)
    numbers = (lower + np.tril(lower, -1).T).astype(np.int64)
    return (numbers - 1).clip(min=0), numbers > 0
