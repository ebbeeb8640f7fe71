"""The state of all robots, as observations, rewards, terminations, commands, events and sensors read it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from legged_torque.sim.engine import Engine
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils.buffers import Buffers
from legged_torque.utils.math import quat_rotate_inverse


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
        self.feet_contact, self.feet_air_time = (
            self.buffer("feet_contact", num_feet),
            self.buffer("feet_air_time", num_feet),
        )
        self.episode_length = self.buffer("episode_length", dtype=torch.long)
        self.episode_return = self.buffer("episode_return")
        self.reset_buf = self.buffer("reset_buf", dtype=torch.bool)
        self.time_out_buf = self.buffer("time_out_buf", dtype=torch.bool)
        self._gravity = torch.tensor([0.0, 0.0, -1.0], device=sim.device).expand(sim.num_envs, 3)
        self.feet_indices = torch.tensor(feet, dtype=torch.long, device=sim.device)
        geoms = [self.feet_indices[[own == foot for own in foot_of]] for foot in range(num_feet)]
        longest = max(len(own) for own in geoms)
        self.foot_geoms = torch.stack([torch.cat([own, own[:1].expand(longest - len(own))]) for own in geoms])

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

    def planar_velocity(self) -> Tensor:
        """Return v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame, as commands are. Shape: (num_envs, 3)."""
        return torch.cat([self.base_lin_vel[:, :2], self.base_ang_vel[:, 2:]], dim=1)
