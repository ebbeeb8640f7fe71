"""Positions and velocities of points on a robot's bodies in all worlds."""

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged_torque.sim.engine import Engine, shared_field
from legged_torque.utils.math import quat_multiply, quat_rotate


class Fields:
    """The geometry of a robot: fields with a row per world where the engine has such, else one row for all worlds."""

    def __init__(self, sim: Engine) -> None:
        """Copy the model's fields; the engine's rows are looked up at each use."""
        names = ("body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0", "geom_pos")
        self._shared = {name: shared_field(sim, name) for name in names}
        self._per_world = sim.fields if "per_world" in sim.capabilities else {}

    def __getitem__(self, name: str) -> Tensor:
        """Return a field. Shape: (num_envs or 1, ...)."""
        return self._per_world.get(name, self._shared[name])


class Points:
    """One point on each of some bodies, all of which hang on the trunk by hinges and slides.

    Nothing is kept between calls: each one follows the joints from the trunk to all points at once, with about 100
    operations of torch per joint on the way. So it works with any engine, and can be captured and compiled.
    """

    def __init__(self, sim: Engine, fields: Fields, bodies: Sequence[int]) -> None:
        """Prepare for bodies of the engine's model."""
        model, chains = sim.mj_model, [links_to(sim.mj_model, body) for body in bodies]
        self._depth = max(map(len, chains))
        padded = [chain + [(0, 0)] * (self._depth - len(chain)) for chain in chains]  # the world's pose is the identity
        bodies_, joints = np.array(padded, np.int64).reshape(len(bodies), self._depth, 2).T  # of each link, by point
        kinds = [model.jnt_type[joints] == kind for kind in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)]
        places = (model.jnt_qposadr[joints].astype(np.int64), model.jnt_dofadr[joints].astype(np.int64))
        tables = [torch.tensor(table, device=sim.device) for table in (bodies_, joints, *places, *kinds)]
        self._bodies, self._joints, self._qpos, self._qvel, self._is_hinge, self._is_slide = tables
        self._sim, self._fields = sim, fields

    def __call__(self, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions [m] and velocities [m/s] in the world frame, for offsets in the bodies' frames [m].

        Shapes: (num_envs or 1, points, 3) to twice (num_envs, points, 3).
        """
        qpos, qvel, fields = self._sim.qpos, self._sim.qvel, self._fields
        pos, quat, vel = qpos[:, None, :3], qpos[:, None, 3:7], qvel[:, None, :3]
        spin = quat_rotate(quat, qvel[:, None, 3:6])
        for i in range(self._depth):
            body, joint, of_joint = self._bodies[i], self._joints[i], self._qpos[i]
            moved, rate = (qpos[:, of_joint] - fields["qpos0"][:, of_joint])[..., None], qvel[:, self._qvel[i], None]
            is_hinge, is_slide = self._is_hinge[i, :, None], self._is_slide[i, :, None]
            local_axis, local_anchor = fields["jnt_axis"][:, joint], fields["jnt_pos"][:, joint]
            start = pos + quat_rotate(quat, fields["body_pos"][:, body])
            quat = quat_multiply(quat, fields["body_quat"][:, body])
            axis = quat_rotate(quat, local_axis)
            anchor = start + quat_rotate(quat, local_anchor) + axis * moved * is_slide
            vel = vel + torch.linalg.cross(spin, anchor - pos) + axis * rate * is_slide
            half = 0.5 * moved * is_hinge
            quat = quat_multiply(quat, torch.cat([half.cos(), local_axis * half.sin()], dim=2))
            spin = spin + axis * rate * is_hinge
            arm = -quat_rotate(quat, local_anchor)
            pos, vel = anchor + arm, vel + torch.linalg.cross(spin, arm)
        arm = quat_rotate(quat, offsets)
        return pos + arm, vel + torch.linalg.cross(spin, arm)


def links_to(model: mujoco.MjModel, body: int) -> list[tuple[int, int]]:
    """Return the bodies below the trunk on the way to a body, with their joints; 0 stands for none.

    Each joint has an entry, of which only a body's first one names the body.
    """
    links: list[tuple[int, int]] = []
    while model.body_parentid[body]:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        joints = list(range(first, first + count)) or [0]
        links = [*zip([body, *[0] * (len(joints) - 1)], joints, strict=True), *links]
        body = int(model.body_parentid[body])
    return links
