"""The state of all robots, as observations, rewards, terminations, commands, events and sensors read it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from legged_torque.sim.engine import Engine
from legged_torque.sim.kinematics import Fields, Points
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils.buffers import Buffers
from legged_torque.utils.errors import check_names
from legged_torque.utils.math import quat_rotate_inverse

_TRUNK = 1  # its body


class RobotState(Buffers):
    """Named tensors of all worlds, written in place. Frames: the world's, the trunk's, the joints'.

    Attributes:
        dt: Control step [s].
        ground: The ground.
        qpos, qvel: Positions and velocities of the simulator. Shapes: (num_envs, nq), (num_envs, nv).
        base_pos: Trunk position in the world [m]. Shape: (num_envs, 3).
        base_quat: Trunk orientation (w, x, y, z). Shape: (num_envs, 4).
        base_lin_vel: Trunk velocity in its own frame [m/s]. Shape: (num_envs, 3).
        base_ang_vel: Trunk angular velocity in its own frame [rad/s]. Shape: (num_envs, 3).
        projected_gravity: Unit gravity vector in the trunk's frame. Shape: (num_envs, 3).
        dof_pos: Joint positions [rad]. Shape: (num_envs, num_dof).
        dof_vel: Joint velocities [rad/s]. Shape: (num_envs, num_dof).
        last_dof_vel: Joint velocities at the last control step [rad/s]. Shape: (num_envs, num_dof).
        torques: Torques of the last physics step [N m]. Shape: (num_envs, num_dof).
        actions: Last actions. Shape: (num_envs, num_actions).
        last_actions: Actions of the step before. Shape: (num_envs, num_actions).
        commands: Commanded v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame. Shape: (num_envs, 3).
        contacts: 1 for each collision geom that touches the ground or, with ``asset.self_collisions``, another part of
            the robot, else 0: a foot on another leg counts as stance. Shape: (num_envs, geoms).
        contact_force: Net contact force on each collision geom in the world frame [N]. Shape: (num_envs, geoms, 3).
        feet_contact: 1 for each foot on the ground, which may have several geoms. Shape: (num_envs, feet).
        feet_air_time: Time since each foot left the ground [s]. Shape: (num_envs, feet).
        feet_indices: Places of the feet's geoms among the collision geoms. Shape: (feet's geoms,), int64.
        foot_geoms: The same for each foot; shorter rows repeat their first geom. Shape: (feet, geoms), int64.
        episode_length: Control steps since the start of the episode. Shape: (num_envs,), int64.
        episode_return: Sum of the rewards of the episode so far. Shape: (num_envs,).
        reset_buf: Worlds whose episode has ended with the last step. Shape: (num_envs,), bool.
        time_out_buf: Those of them whose time was over. Shape: (num_envs,), bool.
        diverged: Worlds whose numbers are not finite. Shape: (num_envs,), bool.
    """

    def __init__(
        self, sim: Engine, ground: Terrain, feet: Sequence[int], foot_of: Sequence[int], num_actions: int, dt: float
    ) -> None:
        """Allocate what the simulator does not have.

        ``feet`` are places of the feet's geoms among those that are sensed; ``foot_of`` are their feet.
        """
        super().__init__(sim.num_envs, sim.device)
        self.dt, self.ground = dt, ground
        self.qpos, self.qvel, self.torques, self.diverged = sim.qpos, sim.qvel, sim.ctrl, sim.diverged
        self.contact_force, self._contact_found = sim.contact_force, sim.contact_found
        self.base_pos, self.base_quat, self.dof_pos = sim.qpos[:, :3], sim.qpos[:, 3:7], sim.qpos[:, 7:]
        self.base_ang_vel, self.dof_vel = sim.qvel[:, 3:6], sim.qvel[:, 6:]
        num_dof, num_feet = self.dof_vel.shape[1], max(foot_of) + 1
        self.base_lin_vel, self.projected_gravity = self.buffer("base_lin_vel", 3), self.buffer("projected_gravity", 3)
        self.last_dof_vel, self.commands = self.buffer("last_dof_vel", num_dof), self.buffer("commands", 3)
        self.actions, self.last_actions = self.buffer("actions", num_actions), self.buffer("last_actions", num_actions)
        self.contacts = self.buffer("contacts", self._contact_found.shape[1])
        self.feet_contact = self.buffer("feet_contact", num_feet)
        self.feet_air_time = self.buffer("feet_air_time", num_feet)
        self.episode_length = self.buffer("episode_length", dtype=torch.long)
        self.episode_return = self.buffer("episode_return")
        self.reset_buf = self.buffer("reset_buf", dtype=torch.bool)
        self.time_out_buf = self.buffer("time_out_buf", dtype=torch.bool)
        self._gravity = torch.tensor([0.0, 0.0, -1.0], device=sim.device).expand(sim.num_envs, 3)
        self.feet_indices = torch.tensor(feet, dtype=torch.long, device=sim.device)
        geoms = [self.feet_indices[[own == foot for own in foot_of]] for foot in range(num_feet)]
        longest = max(len(own) for own in geoms)
        self.foot_geoms = torch.stack([torch.cat([own, own[:1].expand(longest - len(own))]) for own in geoms])
        counts = torch.tensor([len(own) for own in geoms], device=sim.device).view(-1, 1, 1)
        self._is_own = torch.arange(longest, device=sim.device).view(1, -1, 1) < counts  # not a repetition
        self._init_points(sim)

    def _init_points(self, sim: Engine) -> None:
        """Prepare the kinematics of feet and bodies; nothing is computed before it is asked for."""
        model, self._fields = sim.mj_model, Fields(sim)
        sensed = torch.tensor(model.sensor_refid, dtype=torch.long, device=sim.device)
        self._foot_geom_ids = sensed[self.foot_geoms]
        self._feet = Points(sim, self._fields, model.geom_bodyid[self._foot_geom_ids[:, 0].cpu().numpy()])
        bodies = [model.body(body) for body in range(_TRUNK, model.nbody) if model.body_rootid[body] == _TRUNK]
        self._bodies = {body.name: Points(sim, self._fields, [body.id]) for body in bodies if body.name}
        self._origin = torch.zeros(1, 1, 3, device=sim.device)

    def place(self, qpos: Tensor, qvel: Tensor) -> None:
        """Put all worlds into states; nothing has touched anything there yet, as after a reset."""
        self.qpos.copy_(qpos)
        self.qvel.copy_(qvel)
        self._contact_found.zero_()
        self.contact_force.zero_()
        self.update()

    def update(self) -> None:
        """Compute what follows from the simulator's state."""
        in_world = torch.stack([self.qvel[:, :3], self._gravity])
        lin_vel, gravity = quat_rotate_inverse(self.base_quat.unsqueeze(0), in_world)
        self.base_lin_vel.copy_(lin_vel)
        self.projected_gravity.copy_(gravity)
        self.contacts.copy_(self._contact_found > 0)
        self.feet_contact.copy_(self.contacts[:, self.foot_geoms].amax(dim=2))

    def update_feet_air_time(self) -> None:
        """Count the time of each foot since it left the ground."""
        self.feet_air_time.copy_((self.feet_air_time + self.dt) * (1.0 - self.feet_contact))

    @property
    def base_height(self) -> Tensor:
        """Height of the trunk's origin above the ground under it [m]. Shape: (num_envs,)."""
        return self.ground.height_above(self.base_pos)

    @property
    def foot_pos(self) -> Tensor:
        """Middle of the geoms of each foot in the world frame [m]. Shape: (num_envs, feet, 3).

        On flat ground, that of a sphere is its radius high. Feet are in the order of ``feet_contact``. Each use follows
        all joints between trunk and feet; a task without one pays nothing. A GPU compiles them into the step; on a CPU,
        each takes a tenth of the step of 1024 A1s.
        """
        return self._feet(self._foot_offsets())[0]

    @property
    def foot_vel(self) -> Tensor:
        """Velocity of :attr:`foot_pos` in the world frame [m/s]. Shape: (num_envs, feet, 3). It costs the same."""
        return self._feet(self._foot_offsets())[1]

    @property
    def foot_contact_force(self) -> Tensor:
        """Net contact force on each foot in the world frame [N], the sum over its geoms. Shape: (num_envs, feet, 3).

        Like ``contact_force``, it is of the start of the last physics step, and 0 after a reset.
        """
        return (self.contact_force[:, self.foot_geoms] * self._is_own).sum(dim=2)

    def body_pos(self, name: str) -> Tensor:
        """Return the position of a body's frame in the world [m]. Shape: (num_envs, 3).

        Each call follows the joints between the trunk and the body. A UserError for an unknown body; bodies without
        joints are parts of their parents, see ``build_model``.
        """
        return self._body(name)(self._origin)[0].squeeze(1)

    def body_vel(self, name: str) -> Tensor:
        """Return the velocity of a body's frame in the world [m/s], see :meth:`body_pos`. Shape: (num_envs, 3)."""
        return self._body(name)(self._origin)[1].squeeze(1)

    def _body(self, name: str) -> Points:
        """Return the origin of a body; a UserError if there is none of this name."""
        check_names("body of the robot", [name], self._bodies)
        return self._bodies[name]

    def _foot_offsets(self) -> Tensor:
        """Return the middle of the feet's geoms in the frames of their bodies [m]. Shape: (num_envs or 1, feet, 3)."""
        places = self._fields["geom_pos"][:, self._foot_geom_ids] * self._is_own
        return places.sum(dim=2) / self._is_own.sum(dim=1)

    def planar_velocity(self) -> Tensor:
        """Return v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame, as commands are. Shape: (num_envs, 3)."""
        return torch.cat([self.base_lin_vel[:, :2], self.base_ang_vel[:, 2:]], dim=1)


def _of_state(name: str) -> Any:
    """Return a property of tasks that is a member of their state."""
    return property(lambda task: getattr(task.state, name), doc=getattr(RobotState, name).__doc__)


class StateAccess:
    """What tasks compute of their :class:`RobotState` only where it is asked for, under the same names."""

    base_height, foot_pos, foot_vel, foot_contact_force, body_pos, body_vel = map(
        _of_state, ("base_height", "foot_pos", "foot_vel", "foot_contact_force", "body_pos", "body_vel")
    )
