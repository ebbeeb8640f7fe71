"""The batched task: a legged robot that follows velocity commands."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from legged_torque.envs.base.actions import ActionTerm, position_residual
from legged_torque.envs.base.asset import by_joint, load_asset, nominal_pose
from legged_torque.envs.base.base_task import BaseTask
from legged_torque.envs.base.commands import UniformCommands
from legged_torque.envs.base.control_laws import pd_torque, pd_torques
from legged_torque.envs.base.domain_rand import check_fields, initial_state, mirrors, parameters
from legged_torque.envs.base.health import watched
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.observations import Observations, ObservationTerm, standard_terms
from legged_torque.envs.base.random_events import RandomEvents
from legged_torque.envs.base.reward_terms import RewardTerms
from legged_torque.envs.base.rewards import Rewards
from legged_torque.envs.base.robot_checks import mirror_problem, range_notes
from legged_torque.envs.base.symmetry import Mirror, RobotSymmetry, make_mirror
from legged_torque.envs.base.task_log import TaskLog
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.motors import make_motors
from legged_torque.motors.action_delay import ActionDelay
from legged_torque.motors.drive import Drive, in_kernel
from legged_torque.sim.engine import require
from legged_torque.sim.health import Health
from legged_torque.sim.model import indices_matching
from legged_torque.sim.randomization import Parameter, changes_legs
from legged_torque.sim.registry import engine_class, make_engine
from legged_torque.terrain import make_terrain
from legged_torque.utils.config import section_keys, to_dict
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.math import quat_rotate_inverse
from legged_torque.utils.mjcf import joint_limits


class LeggedRobot(RewardTerms, BaseTask):
    """A batch of robots with position control, and what all approaches share.

    An approach overrides :meth:`_compute_torques` and :meth:`action_terms`, adds ``_reward_<term>`` methods or
    :meth:`observation_terms`, or overrides the curriculum hook :meth:`update_curriculum`. What runs inside a step obeys
    the rules of :class:`BaseTask`.

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
        motor_strength: Factor on the torques of each motor. Shape: (num_envs, num_dof).
        actions: Last actions. Shape: (num_envs, num_actions).
        commands: Commanded v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame. Shape: (num_envs, 3).
        contacts: 1 for each collision geom that touches the ground, else 0. Shape: (num_envs, geoms).
        feet_contact: The same for the feet, of which each may have several geoms. Shape: (num_envs, feet).
        notes: What a user should know of this robot with these settings, a line each.
    """

    cfg: LeggedRobotCfg

    def __init__(self, cfg: LeggedRobotCfg, device: str = "cpu") -> None:
        """Create the worlds on "cpu" or "cuda:N", each in a random initial state; ``cfg.env.num_actions`` is filled in.

        A UserError if a setting makes no sense or names something that does not exist.
        """
        check_env_cfg(cfg)
        super().__init__(cfg.env.num_envs, device)
        self.cfg = cfg
        self.dt = cfg.sim.dt * cfg.control.decimation
        self.max_episode_length = math.ceil(cfg.env.episode_length_s / self.dt)
        self._create_sim()
        self._init_buffers()
        self._init_actions()
        self._prepare_reward_functions()
        self._init_random_events()
        seen = (cfg.env.history_length, cfg.normalization.clip_observations, cfg.noise.add_noise)
        self.observations = Observations(self.observation_terms(), *seen, self.num_envs)
        self.obs_buf = self.observations.buffers
        self.health = Health(watched(self), self.sim.diverged)
        self._parts = (self._judge, self._add_up, self._end_episodes, self._finish_step)
        self.reset()

    # ---- hooks of the approaches -------------------------------------------------------------------------------------

    @in_kernel(pd_torque)
    def _compute_torques(self, actions: Tensor) -> Tensor:
        """Return the torques that motors are asked for [N m], at every physics step.

        This is position control (eq. 8). Shapes: (num_envs, num_actions) to (num_envs, num_dof). The physics kernel
        computes them itself where a Warp function is named for it, see :func:`~legged_torque.motors.drive.in_kernel`.
        """
        return pd_torques(self, actions)

    def action_terms(self) -> list[ActionTerm]:
        """Return what the actions of :meth:`_compute_torques` are, one term per action of a joint."""
        return [position_residual(self.action_scale)]

    def observation_terms(self) -> list[ObservationTerm]:
        """Return what policy and critic see."""
        return standard_terms(self)

    def random_parameters(self) -> list[Parameter]:
        """Return what ``domain_rand`` draws in each world."""
        return parameters(self)

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the scalars that curricula set, for logging: weights of reward terms that have one, and levels."""
        weights = self.reward_weights() / self.dt
        curricula = section_keys(self.cfg.rewards.curriculum)
        values = {f"weight_{name}": weights[i] for i, name in enumerate(self.reward_names) if name in curricula}
        return values | self.terrain.curriculum_values()

    # ---- one control step --------------------------------------------------------------------------------------------

    def _step(self) -> None:
        """Physics, rewards, resets and observations of one control step."""
        self.sim.clear_diverged()
        self.sim.flag_diverged()
        clip = self.cfg.normalization.clip_actions
        self.action_delay.keep()
        self.actions.copy_(self._given_actions.nan_to_num().clamp(-clip, clip))
        self.run_physics()
        self.sim.flag_diverged()
        self.post_physics_step()

    def run_physics(self) -> None:
        """Do the physics steps of a control step, with torques inside if control law and motors name Warp functions."""
        decimation, refresh = self.cfg.control.decimation, self.cfg.control.refresh_torques
        drive = self._drive.get() if refresh and "torques_in_kernel" in self.sim.capabilities else None
        if drive:
            self.sim.drive(decimation, *drive)
            return
        for i in range(decimation):
            if i == 0 or refresh:
                wanted = self._compute_torques(self.action_delay.actions(i))
                self.motors.apply(wanted, self.dof_vel, out=self.torques)
            self.sim.step(sense=i == decimation - 1)

    def post_physics_step(self) -> None:
        """Do what follows the physics: termination, rewards, resets, commands, observations."""
        judge, add_up, end_episodes, finish_step = self._parts
        judge()
        self.health.check()
        add_up()
        end_episodes()
        self._reset_worlds()
        finish_step()

    def _judge(self) -> None:
        """Count the step, look at the state, and compute ends and rewards; torch's operations only, as they compile."""
        self._episode_length_buf.add_(1)
        self.total_steps.add_(self.num_envs * self.num_processes)
        self._update_state()
        self.check_termination()
        self.compute_reward()
        self.health.begin()

    def _add_up(self) -> None:
        """End broken worlds without a reward, now that they are known, and add to sums; torch only."""
        diverged = self.sim.diverged
        self.health.end()
        self.num_diverged.add_(diverged.sum())
        self.reset_buf.logical_or_(diverged)
        self.time_out_buf.logical_and_(~diverged)
        self.rew_buf.masked_fill_(diverged, 0.0)
        self.rewards.add_to_episode(diverged)
        self.episode_return.add_(self.rew_buf)
        self.log.add_step(self)
        self.update_feet_air_time()

    def _end_episodes(self) -> None:
        """Set levels; torch only.

        This is a part by itself: with the sum over worlds of :meth:`_add_up`, it would run on one processor of a GPU.
        """
        ended = self.reset_buf & ~self.sim.diverged  # where broken worlds have got to says nothing
        self.terrain.end_episodes(ended, self.base_pos, self.commands, self.cfg.env.episode_length_s)

    def _update_state(self) -> None:
        """Compute what follows from the simulator's state."""
        in_world = torch.stack([self.sim.qvel[:, :3], self._gravity])
        lin_vel, gravity = quat_rotate_inverse(self.base_quat.unsqueeze(0), in_world)
        self.base_lin_vel.copy_(lin_vel)
        self.projected_gravity.copy_(gravity)
        self.contacts.copy_(self.sim.contact_found > 0)
        self.feet_contact.copy_(self.contacts[:, self.foot_geoms].amax(dim=2))

    def update_feet_air_time(self) -> None:
        """Count the time of each foot since it left the ground."""
        self.feet_air_time.copy_((self.feet_air_time + self.dt) * (1.0 - self.feet_contact))

    @property
    def base_height(self) -> Tensor:
        """Height of the trunk's origin above the ground under it [m]. Shape: (num_envs,)."""
        return self.terrain.height_above(self.base_pos)

    def planar_velocity(self) -> Tensor:
        """Return v_x, v_y [m/s] and yaw rate [rad/s] in the trunk's frame, as commands are. Shape: (num_envs, 3)."""
        return torch.cat([self.base_lin_vel[:, :2], self.base_ang_vel[:, 2:]], dim=1)

    def check_termination(self) -> None:
        """End episodes whose trunk touches the ground, whose state diverged, or whose time is over."""
        touching = self.contacts[:, self.termination_contact_indices].any(dim=1)
        ended = touching | self.sim.diverged
        time_out = self._episode_length_buf >= self.max_episode_length
        self.reset_buf.copy_(ended | time_out)
        self.time_out_buf.copy_(time_out & ~ended)

    def compute_reward(self) -> None:
        """Compute the sum of all terms (Table III); 0 without terms."""
        if self.reward_names:
            self.rew_buf.copy_(self.rewards.compute(self.total_steps))

    def reward_weights(self) -> Tensor:
        """Return the weights of the terms at this moment of training, Delta t included. Shape: (terms,)."""
        return self.rewards.weights(self.total_steps)

    def _reset_worlds(self) -> None:
        """Put the worlds of ``reset_buf`` where an episode starts; elsewhere draw anew what is due, and push."""
        self.events.happen(self.reset_buf)

    def compute_observations(self) -> None:
        """Write the observations of this moment."""
        self.observations.compute(self.reset_buf)

    def _finish_step(self) -> None:
        """Move new episodes to their tiles, forget those that have ended, and look at the state of all worlds."""
        self.terrain.move_to_origin(self.reset_buf, self.base_pos)
        per_world = (self.actions.T, self.feet_air_time.T, self.episode_sums, self.episode_return)
        for buffer in (*per_world, self._episode_length_buf):
            buffer.masked_fill_(self.reset_buf, 0)
        self.action_delay.reset(self.reset_buf)
        self._observe()

    def _observe(self) -> None:
        """Look at the simulator's state, compute the observations, and keep what the next rewards compare with."""
        self._update_state()
        self.command_generator.follow_headings(self.base_quat)
        self.compute_observations()
        self.last_actions.copy_(self.actions)
        self.last_dof_vel.copy_(self.dof_vel)

    def set_state(self, qpos: Tensor, qvel: Tensor) -> None:
        """Put all worlds into states as in ``sim.qpos`` and ``sim.qvel``, and observe them; episodes go on."""
        self.sim.qpos.copy_(qpos)
        self.sim.qvel.copy_(qvel)
        self._observe()

    # ---- construction ------------------------------------------------------------------------------------------------

    def _create_sim(self) -> None:
        """Load robot, ground and motors, and build the simulator and its views."""
        cfg, sim = self.cfg, self.cfg.sim
        self.terrain = make_terrain(cfg.terrain, self.num_envs, self.device)
        engine = engine_class(sim.engine)
        if cfg.domain_rand.randomize_parameters:
            require(engine, "per_world", "domain_rand.randomize_parameters")
        if cfg.asset.self_collisions:
            require(engine, "self_collision", "asset.self_collisions")
        height_map = self.terrain.map if "height_map" in engine.capabilities else None  # others find it in their model
        self.asset = load_asset(cfg, None if height_map else self.terrain)
        model = self.asset.mj_model
        limits = (sim.solver_iterations, sim.ls_iterations)
        self.sim = make_engine(sim.engine, model, self.num_envs, self.device, *limits, height_map)
        self.dof_names, self.foot_names = self.asset.dof_names, self.asset.foot_names
        self.num_dof = len(self.dof_names)
        axes = self.asset.dof_axes().tolist()
        foot_of = self.asset.foot_of
        self.symmetry = RobotSymmetry(cfg.asset.mirrored_legs, self.dof_names, axes, self.foot_names, foot_of)
        if self.symmetry.joints and self.symmetry.foot_geoms:
            problem = mirror_problem(model, self.symmetry.joints, self.symmetry.foot_geoms, self.foot_names)
            self.symmetry.refuse(problem)
        self.motors = make_motors(cfg.motors.model, self.num_envs, self._tensor(model.actuator_forcerange.T))
        self.torque_limits, self.motor_strength = self.motors.limits, self.motors.strength
        self.base_pos, self.base_quat = self.sim.qpos[:, :3], self.sim.qpos[:, 3:7]
        self.dof_pos, self.dof_vel = self.sim.qpos[:, 7:], self.sim.qvel[:, 6:]
        self.base_ang_vel = self.sim.qvel[:, 3:6]
        self.torques = self.sim.ctrl
        ranges = self._tensor(joint_limits(model)[1:])
        middle = ranges.mean(dim=1, keepdim=True).nan_to_num()  # of joints without a range
        self.dof_pos_limits = middle + cfg.rewards.soft_dof_pos_limit * (ranges - middle)
        places = (self.asset.feet, self.asset.penalized, self.asset.terminating)
        self.feet_indices, self.penalized_contact_indices, self.termination_contact_indices = (
            torch.tensor(chosen, dtype=torch.long, device=self.device) for chosen in places
        )
        geoms = [self.feet_indices[[own == foot for own in foot_of]] for foot in range(max(foot_of) + 1)]
        longest = max(len(own) for own in geoms)  # shorter rows repeat their first geom
        self.foot_geoms = torch.stack([torch.cat([own, own[:1].expand(longest - len(own))]) for own in geoms])

    def _init_buffers(self) -> None:
        """Allocate what the state, the controller and the episodes keep, and constants."""
        n, control, dof_names = self.num_envs, self.cfg.control, self.dof_names
        zeros = functools.partial(torch.zeros, device=self.device)
        self.base_lin_vel, self.projected_gravity = zeros(n, 3), zeros(n, 3)
        self._gravity = self._tensor([0.0, 0.0, -1.0]).expand(n, 3)
        self.contacts = zeros(self.sim.contact_found.shape)
        self.feet_contact, self.feet_air_time = zeros(n, len(self.foot_geoms)), zeros(n, len(self.foot_geoms))
        held = indices_matching(dof_names, self.cfg.rewards.held_joints, "joint in rewards.held_joints")
        self.held_joints = self._tensor([float(joint in held) for joint in range(self.num_dof)])
        self.last_dof_vel, self.joint_offset = zeros(n, self.num_dof), zeros(n, self.num_dof)
        self.default_dof_pos = self._tensor(nominal_pose(self.cfg.init_state.default_joint_angles, dof_names))
        self.p_gains = zeros(n, 1) + self._tensor(by_joint("control.stiffness", control.stiffness, dof_names))
        self.d_gains = zeros(n, 1) + self._tensor(by_joint("control.damping", control.damping, dof_names))
        self.action_scale, self.torque_scale = zeros(n, 1) + control.action_scale, zeros(n, 1) + control.torque_scale

    def _init_actions(self) -> None:
        """Allocate the actions, as many as their terms have."""
        rand, control, env = self.cfg.domain_rand, self.cfg.control, self.cfg.env
        self.num_actions = len(self.action_terms()) * self.num_dof
        if env.num_actions not in (None, self.num_actions):
            name = type(self).__name__
            raise UserError(f"env.num_actions must be {self.num_actions} for {name}, not {env.num_actions}")
        env.num_actions = self.num_actions
        actions = torch.zeros(3, self.num_envs, self.num_actions, device=self.device)
        self._given_actions, self.actions, self.last_actions = actions.unbind()
        self.action_delay = ActionDelay(self.actions, rand.action_delay[1], rand.action_delay_unit, control.decimation)
        self._drive = Drive(self, self.action_delay, self.motors)

    def _prepare_reward_functions(self) -> None:
        """Collect the functions of all terms with a scale that is not zero, and their weights."""
        scales = {name: scale for name, scale in to_dict(self.cfg.rewards.scales).items() if scale != 0.0}
        known = [name.removeprefix("_reward_") for name in dir(type(self)) if name.startswith("_reward_")]
        curriculum = self.cfg.rewards.curriculum
        curricula = {name: getattr(curriculum, name) for name in section_keys(curriculum)}
        for name in [*scales, *curricula]:
            if name not in known:
                raise unknown_name("reward term", name, known)
        functions = {name: getattr(self, f"_reward_{name}") for name in scales}
        only_positive = self.cfg.rewards.only_positive_rewards
        self.rewards = Rewards(functions, scales, curricula, only_positive, self.dt, self.num_envs, self.device)
        self.reward_names, self.episode_sums = self.rewards.names, self.rewards.episode_sums
        self.log = TaskLog(self.reward_names, self.num_envs, self.device)

    def _init_random_events(self) -> None:
        """Prepare commands, initial states, random parameters and pushes."""
        cfg = self.cfg
        self.command_generator = UniformCommands(cfg, self.device)
        self.commands = self.command_generator.values
        self.init_angles = torch.zeros(self.num_envs, 3, device=self.device)
        drawn = self.random_parameters()
        check_fields(self, drawn)
        self.events = RandomEvents(cfg, self.sim, self.command_generator, self.init_angles, initial_state(self), drawn)
        self.randomization = self.events.parameters
        self.parameter_mirrors = mirrors(drawn, self.randomization.sizes)
        self.notes = [*self.asset.notes, *self.sim.notes]
        if cfg.domain_rand.randomize_parameters:
            self.notes += range_notes(drawn, self.torque_limits[1].cpu().numpy())
        if cfg.domain_rand.randomize_parameters and changes_legs(drawn):
            self.sim.vary_legs()

    @functools.cached_property
    def mirror(self) -> Mirror:
        """Reflects observations and actions of this robot left to right."""
        return make_mirror(self)

    def _tensor(self, values) -> Tensor:
        """Return values as a float tensor on the task's device."""
        return torch.as_tensor(values, dtype=torch.float32, device=self.device).clone()
