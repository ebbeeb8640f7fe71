"""The batched task: a legged robot that follows velocity commands."""

from __future__ import annotations

import functools
import math

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from legged_torque import resource_path
from legged_torque.envs.base.curriculum import LinearCurriculum
from legged_torque.envs.base.domain_rand import MODEL_FIELDS
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.observations import Observations
from legged_torque.envs.base.random_events import RandomEvents
from legged_torque.envs.base.rewards import RewardTerms
from legged_torque.envs.base.symmetry import Mirror
from legged_torque.envs.base.task_log import TaskLog
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.sim.graph import CudaGraph
from legged_torque.sim.model import build_model, collision_geoms, indices_matching, read_spec
from legged_torque.sim.simulator import Simulator
from legged_torque.utils.config import section_keys, to_dict
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.math import quat_rotate_inverse


class LeggedRobot(Observations, RandomEvents, RewardTerms, VecEnv):
    """A batch of robots with position control, and what all approaches share.

    An approach overrides :meth:`_compute_torques`, adds ``_reward_<term>`` methods, or overrides the curriculum hook
    :meth:`update_curriculum`. A control step is replayed as one CUDA graph on a GPU, hence the rules for everything
    that runs inside :meth:`_step`: fixed shapes, masks instead of lists of ids, nothing read back to the host, and
    what is kept from step to step is written in place (``copy_``, ``masked_fill_``), never bound to a new tensor.

    Attributes:
        base_pos: Trunk position in the world [m]. Shape: (num_envs, 3).
        base_quat: Trunk orientation (w, x, y, z). Shape: (num_envs, 4).
        base_lin_vel: Trunk velocity in its own frame [m/s]. Shape: (num_envs, 3).
        base_ang_vel: Trunk angular velocity in its own frame [rad/s]. Shape: (num_envs, 3).
        projected_gravity: Unit gravity vector in the trunk's frame. Shape: (num_envs, 3).
        dof_pos: Joint positions [rad]. Shape: (num_envs, num_dof).
        dof_vel: Joint velocities [rad/s]. Shape: (num_envs, num_dof).
        torques: Torques of the last physics step [N m]. Shape: (num_envs, num_dof).
        torque_limits: Lowest and highest torques [N m]. Shape: (2, num_dof).
        actions: Last actions. Shape: (num_envs, num_actions).
        commands: Commanded v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame. Shape: (num_envs, 3).
        contacts: 1 for each collision geom that touches the ground, else 0. Shape: (num_envs, geoms).
        feet_contact: The same for the feet. Shape: (num_envs, feet).
        total_steps: Environment steps so far over all worlds of all processes: t of eq. 1. Scalar, int64.
    """

    cfg: LeggedRobotCfg
    actions_per_dof = 1
    """Actions that :meth:`_compute_torques` takes per joint."""
    num_processes = 1
    """Processes that train together, each with as many worlds; the runner sets it."""

    def __init__(self, cfg: LeggedRobotCfg, device: str = "cpu") -> None:
        """Create the worlds and put each into a random initial state.

        Args:
            cfg: Settings of the task.
            device: "cpu" or "cuda:N".

        Raises:
            UserError: If a setting makes no sense or names something that does not exist.
        """
        check_env_cfg(cfg)
        self.cfg = cfg
        self.device = device
        self.num_envs = cfg.env.num_envs
        self.num_actions = cfg.env.num_actions
        self.dt = cfg.sim.dt * cfg.control.decimation
        self.max_episode_length = math.ceil(cfg.env.episode_length_s / self.dt)
        self._create_sim()
        self._init_buffers()
        self._prepare_reward_functions()
        self._init_random_events()
        self._init_observations()
        self.step_graph = CudaGraph(self._step, device)
        self.reset()

    # ---- what rsl_rl calls -------------------------------------------------------------------------------------------

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply actions for one control step.

        Args:
            actions: Shape: (num_envs, num_actions). Worlds with an action that is not finite are reset.

        Returns:
            Observations (a copy); rewards (num_envs,); dones (num_envs,), bool; extras with "time_outs" (num_envs,),
            bool. Rewards, dones and extras are buffers that the next step overwrites.
        """
        self._given_actions.copy_(actions)
        self.step_graph()
        return self.get_observations(), self.rew_buf, self.reset_buf, self.extras

    def get_observations(self) -> TensorDict:
        """Return a copy of the current observations: groups "policy" and "critic", each (num_envs, size)."""
        return self.obs_buf.clone()

    def reset(self) -> TensorDict:
        """Start a new episode in every world and return the observations."""
        self.reset_buf.fill_(True)
        self._reset_worlds()
        self.compute_observations()
        self._keep_last()
        return self.get_observations()

    @functools.cached_property
    def mirror(self) -> Mirror:
        """Reflects observations and actions of this robot left to right."""
        return Mirror(self)

    @property
    def episode_length_buf(self) -> Tensor:
        """Control steps since the start of each world's episode. Shape: (num_envs,), int64."""
        return self._episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        """Write the counters in place: rsl_rl sets them to random values when training starts."""
        self._episode_length_buf.copy_(value)

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a checkpoint must keep of the task: its counters, on which all curricula depend."""
        return {"total_steps": self.total_steps.clone(), "num_diverged": self.num_diverged.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from the counters of a checkpoint."""
        self.total_steps.copy_(state["total_steps"])
        self.num_diverged.copy_(state["num_diverged"])
        self.update_curriculum()

    # ---- hooks of the approaches -------------------------------------------------------------------------------------

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """Return joint torques for actions; called at every physics step. This is position control (eq. 8).

        Args:
            actions: Shape: (num_envs, num_actions).

        Returns:
            Torques before clipping to the limits [N m]. Shape: (num_envs, num_dof).
        """
        return self._pd_torques(actions)

    def _pd_torques(self, actions: Tensor) -> Tensor:
        """tau = Kp (q_nominal + scale a - q) - Kd qd (eq. 8). Shapes: (num_envs, num_dof)."""
        target = self.default_dof_pos + self.joint_offset + self.action_scale * actions
        return self.p_gains * (target - self.dof_pos) - self.d_gains * self.dof_vel

    def update_curriculum(self) -> None:
        """Curriculum hook for what may only change between rollouts; the runner calls it before each of them."""

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the scalars that curricula set, for logging: here the weights of reward terms that have one."""
        weights = self.reward_weights() / self.dt
        curricula = section_keys(self.cfg.rewards.curriculum)
        return {f"weight_{name}": weights[i] for i, name in enumerate(self.reward_names) if name in curricula}

    # ---- one control step --------------------------------------------------------------------------------------------

    def _step(self) -> None:
        """Physics, rewards, resets and observations of one control step."""
        self.sim.clear_diverged()
        self.sim.flag_diverged()
        self.sim.diverged.logical_or_(~torch.isfinite(self._given_actions).all(dim=1))
        clip = self.cfg.normalization.clip_actions
        self.action_delay.keep()
        self.actions.copy_(self._given_actions.nan_to_num().clamp(-clip, clip))
        decimation = self.cfg.control.decimation
        for i in range(decimation):
            if i == 0 or self.cfg.control.refresh_torques:
                torques = self.motor_strength * self._compute_torques(self.action_delay.actions(i))
                torch.clamp(torques, self.torque_limits[0], self.torque_limits[1], out=self.torques)
            self.sim.step(sense=i == decimation - 1)
        self.sim.flag_diverged()
        self.post_physics_step()

    def post_physics_step(self) -> None:
        """Do what follows the physics: termination, rewards, resets, commands, observations."""
        self._episode_length_buf += 1
        self.total_steps += self.num_envs * self.num_processes
        self._update_state()
        self.check_termination()
        self.compute_reward()
        self.log.add_step(self)
        self._update_feet_air_time()
        self._reset_worlds()
        self.compute_observations()
        self._keep_last()

    def _update_state(self) -> None:
        """Compute what follows from the simulator's state."""
        in_world = torch.stack([self.sim.qvel[:, :3], self._gravity])
        lin_vel, gravity = quat_rotate_inverse(self.base_quat.unsqueeze(0), in_world)
        self.base_lin_vel.copy_(lin_vel)
        self.projected_gravity.copy_(gravity)
        self.contacts.copy_(self.sim.contact_found > 0)
        self.feet_contact.copy_(self.contacts[:, self.feet_indices])

    def check_termination(self) -> None:
        """End episodes whose trunk touches the ground, whose state diverged, or whose time is over."""
        touching = self.contacts[:, self.termination_contact_indices].any(dim=1)
        torch.logical_or(touching, self.sim.diverged, out=self.reset_buf)
        torch.ge(self._episode_length_buf, self.max_episode_length, out=self.time_out_buf)
        self.time_out_buf.logical_and_(~self.reset_buf)
        self.reset_buf.logical_or_(self.time_out_buf)
        self.num_diverged += self.sim.diverged.sum()

    def compute_reward(self) -> None:
        """Compute the sum of all terms (Table III); 0 for worlds that diverged, or without terms."""
        if not self.reward_names:
            return
        terms = torch.stack([function() for function in self._reward_functions])
        terms = torch.where(self.sim.diverged, 0.0, terms)
        terms *= self.reward_weights().unsqueeze(1)
        self.episode_sums += terms
        reward = terms.sum(dim=0)
        if self.cfg.rewards.only_positive_rewards:
            reward = reward.clamp(min=0.0)
        self.rew_buf.copy_(reward)
        self.episode_return += reward

    def reward_weights(self) -> Tensor:
        """Return the weights of the terms at this moment of training, Delta t included. Shape: (terms,)."""
        return self._reward_scales * self._reward_curriculum(self.total_steps)

    def _keep_last(self) -> None:
        """Keep what the next step's rewards compare with."""
        self.last_actions.copy_(self.actions)
        self.last_dof_vel.copy_(self.dof_vel)

    def _update_feet_air_time(self) -> None:
        """Count the time of each foot since it left the ground."""
        self.feet_air_time.copy_((self.feet_air_time + self.dt) * (1.0 - self.feet_contact))

    def set_state(self, qpos: Tensor, qvel: Tensor) -> None:
        """Put all worlds into given states, with the observations that follow; episodes go on.

        Args:
            qpos: As ``sim.qpos``. Shape: (num_envs, nq).
            qvel: As ``sim.qvel``. Shape: (num_envs, nv).
        """
        self.sim.qpos.copy_(qpos)
        self.sim.qvel.copy_(qvel)
        self._update_state()
        self.compute_observations()
        self._keep_last()

    # ---- construction ------------------------------------------------------------------------------------------------

    def _create_sim(self) -> None:
        """Load the robot and build the simulator and its views."""
        asset = self.cfg.asset
        spec = read_spec(resource_path(asset.file))
        geoms = collision_geoms(spec)
        feet = indices_matching(geoms, [asset.foot_name])
        penalized = indices_matching(geoms, asset.penalize_contacts_on)
        terminating = indices_matching(geoms, asset.terminate_after_contacts_on)
        model = build_model(spec, geoms)
        model.opt.timestep = self.cfg.sim.dt
        sim = self.cfg.sim
        per_world = MODEL_FIELDS if self.cfg.domain_rand.randomize_parameters else ()
        self.sim = Simulator(
            model, self.num_envs, self.device, sim.engine, sim.solver_iterations, sim.ls_iterations, per_world
        )
        self.foot_names = [geoms[i] for i in feet]
        self.dof_names = [model.joint(i).name for i in range(1, model.njnt)]
        self.num_dof = len(self.dof_names)
        if self.num_actions != self.actions_per_dof * self.num_dof:
            expected = self.actions_per_dof * self.num_dof
            raise UserError(f"env.num_actions must be {expected} for {type(self).__name__}, not {self.num_actions}")
        self.base_pos, self.base_quat = self.sim.qpos[:, :3], self.sim.qpos[:, 3:7]
        self.dof_pos, self.dof_vel = self.sim.qpos[:, 7:], self.sim.qvel[:, 6:]
        self.base_ang_vel = self.sim.qvel[:, 3:6]
        self.torques = self.sim.ctrl
        self.torque_limits = self._tensor(model.actuator_forcerange.T)
        limits = self._tensor(model.jnt_range[1:])
        middle = limits.mean(dim=1, keepdim=True)
        self.dof_pos_limits = middle + self.cfg.rewards.soft_dof_pos_limit * (limits - middle)
        self.feet_indices, self.penalized_contact_indices, self.termination_contact_indices = (
            torch.tensor(chosen, dtype=torch.long, device=self.device) for chosen in (feet, penalized, terminating)
        )

    def _init_buffers(self) -> None:
        """Allocate everything that is written in place, and constants."""
        n, cfg = self.num_envs, self.cfg

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(*shape, dtype=dtype, device=self.device)

        self._given_actions, self.actions, self.last_actions = (zeros(n, self.num_actions) for _ in range(3))
        self.base_lin_vel, self.projected_gravity, self.commands = (zeros(n, 3) for _ in range(3))
        self.last_dof_vel = zeros(n, self.num_dof)
        control = cfg.control
        self.p_gains, self.d_gains = (
            zeros(n, self.num_dof) + control.stiffness,
            zeros(n, self.num_dof) + control.damping,
        )
        self.motor_strength, self.joint_offset = zeros(n, self.num_dof) + 1.0, zeros(n, self.num_dof)
        self.action_scale, self.torque_scale = zeros(n, 1) + control.action_scale, zeros(n, 1) + control.torque_scale
        self.contacts = zeros(*self.sim.contact_found.shape)
        self.feet_contact, self.feet_air_time = (zeros(n, len(self.feet_indices)) for _ in range(2))
        self.rew_buf, self.episode_return = zeros(n), zeros(n)
        self.reset_buf, self.time_out_buf = zeros(n, dtype=torch.bool), zeros(n, dtype=torch.bool)
        self._episode_length_buf = zeros(n, dtype=torch.long)
        self.total_steps, self.num_diverged = zeros((), dtype=torch.long), zeros((), dtype=torch.long)
        self.extras = {"time_outs": self.time_out_buf}
        angles = cfg.init_state.default_joint_angles
        for name in angles:
            if name not in self.dof_names:
                raise unknown_name("joint in init_state.default_joint_angles", name, self.dof_names)
        for name in self.dof_names:
            if name not in angles:
                raise UserError(f"init_state.default_joint_angles lacks the joint '{name}'")
        self.default_dof_pos = self._tensor([angles[name] for name in self.dof_names])
        self._gravity = self._tensor([0.0, 0.0, -1.0]).expand(n, 3)
        ranges = cfg.commands.ranges
        limits = self._tensor([ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw])
        self._command_low, self._command_span = limits[:, 0], limits[:, 1] - limits[:, 0]

    def _prepare_reward_functions(self) -> None:
        """Collect the functions of all terms with a scale that is not zero, and their weights."""
        scales = {name: scale for name, scale in to_dict(self.cfg.rewards.scales).items() if scale != 0.0}
        known = [name.removeprefix("_reward_") for name in dir(self) if name.startswith("_reward_")]
        curricula = self.cfg.rewards.curriculum
        for name in [*scales, *section_keys(curricula)]:
            if not hasattr(self, f"_reward_{name}"):
                raise unknown_name("reward term", name, known)
        self.reward_names = list(scales)
        self._reward_functions = [getattr(self, f"_reward_{name}") for name in self.reward_names]
        self._reward_scales = self._tensor(list(scales.values())) * self.dt
        self._reward_curriculum = LinearCurriculum(
            [getattr(curricula, name, None) for name in self.reward_names], self.device
        )
        self.episode_sums = torch.zeros(len(self.reward_names), self.num_envs, device=self.device)
        self.log = TaskLog(self.reward_names, self.device)

    def _tensor(self, values) -> Tensor:
        """Return values as a float tensor on the task's device."""
        return torch.as_tensor(values, dtype=torch.float32, device=self.device).clone()
