"""The batched task: a legged robot that follows velocity commands."""

import functools
import math
from typing import Any

import torch
from torch import Tensor

from legged_torque.envs.base.actions import ActionTerm, ControlLaw, ControlParameters, position_residual
from legged_torque.envs.base.asset import load_asset, nominal_pose
from legged_torque.envs.base.base_task import BaseTask
from legged_torque.envs.base.commands import make_commands
from legged_torque.envs.base.health import watched
from legged_torque.envs.base.hooks import check_methods
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.base.observations import Observations, ObservationTerm, standard_terms
from legged_torque.envs.base.random_events import RandomEvents
from legged_torque.envs.base.random_parameters import (
    control_parameters,
    ground_parameters,
    initial_place,
    initial_state,
    mirrors,
    robot_parameters,
    with_settings,
)
from legged_torque.envs.base.reward_terms import RewardTerms
from legged_torque.envs.base.rewards import Rewards
from legged_torque.envs.base.robot_checks import control_problem, range_notes
from legged_torque.envs.base.state import RobotState, StateAccess
from legged_torque.envs.base.step_meter import StepMeter
from legged_torque.envs.base.symmetry import Mirror
from legged_torque.envs.base.task_log import TaskLog
from legged_torque.envs.base.terminations import Terminations
from legged_torque.envs.base.validation import check_env_cfg, notes_on
from legged_torque.motors.chain import MotorChain
from legged_torque.motors.motor import Joints
from legged_torque.sensors.sensors import Sensors
from legged_torque.sim.health import Health
from legged_torque.sim.randomization import RandomParameter
from legged_torque.sim.registry import engine_class, make_engine
from legged_torque.terrain.rough import make_terrain
from legged_torque.utils.config import section_keys
from legged_torque.utils.errors import UserError

IN_TORCH = "torques are computed in torch, not in one kernel: training on an H100 is up to 6% slower"
"""Note of tasks that override ``_compute_torques`` or have motors without a Warp function."""


class LeggedRobot(RewardTerms, Terminations, StateAccess, BaseTask):
    """A batch of robots with position control, and what all approaches share.

    An approach overrides :meth:`action_terms`, or :meth:`_compute_torques` in torch, adds ``_reward_<term>`` methods or
    :meth:`observation_terms`, or overrides the hook :meth:`update_curriculum`, by the rules of :class:`BaseTask`.

    The attributes with legged_gym's names are tensors of :attr:`state` and :attr:`control`, see
    :class:`~legged_torque.envs.base.state.RobotState` and :class:`~legged_torque.envs.base.actions.ControlParameters`.

    Attributes:
        state: The state of the robots.
        control: Constants of the control laws.
        motors: The chain of motors.
        sensors: Sensors by name.
        torque_limits: Lowest and highest torques [N m]. Shape: (2, num_dof).
        notes: What a user should know of this robot with these settings, a line each.
    """

    cfg: LeggedRobotCfg
    base_pos: Tensor
    base_quat: Tensor
    base_lin_vel: Tensor
    base_ang_vel: Tensor
    projected_gravity: Tensor
    dof_pos: Tensor
    dof_vel: Tensor
    last_dof_vel: Tensor
    torques: Tensor
    actions: Tensor
    last_actions: Tensor
    commands: Tensor
    contacts: Tensor
    feet_contact: Tensor
    feet_air_time: Tensor
    reset_buf: Tensor
    time_out_buf: Tensor
    default_dof_pos: Tensor
    p_gains: Tensor
    d_gains: Tensor
    motor_strength: Tensor

    def __init__(self, cfg: LeggedRobotCfg, device: str = "cpu") -> None:
        """Create the worlds on "cpu" or "cuda:N", each in a random initial state; ``cfg.env.num_actions`` is filled in.

        A UserError if a setting makes no sense or names something that does not exist.
        """
        check_env_cfg(cfg)
        check_methods(type(self), LeggedRobot, cfg)
        super().__init__(cfg.env.num_envs, device)
        self.cfg = cfg
        self.dt = cfg.sim.dt * cfg.control.decimation
        self.max_episode_length = math.ceil(cfg.env.episode_length_s / self.dt)
        self._create_sim()
        self._init_buffers()
        self._init_state()
        self._prepare_reward_functions()
        self._init_random_events()
        self._init_observations()
        kept = {"actions": self._given_actions, **self.randomization.fields, **self.motors.watched()}
        kept |= {"random_parameters": self.randomization.values, **self.sensors.watched()}
        kept |= {f"task.{name}": values for name, values in self._world_state.items()}
        self.health = Health(watched(self.state, kept, self.rewards, self.observations), self.sim.diverged)
        self._parts = [self._compute_rewards_and_dones, self._update_sums, self._end_episodes]
        self._parts += [self._finish_step, self._begin_episodes, self._observe]
        self.hold_tensors()
        self.reset()

    # ---- hooks of the approaches -------------------------------------------------------------------------------------

    def action_terms(self) -> list[ActionTerm]:
        """Return the terms whose weighted torques the motors are asked for, one action of each term per joint.

        This is position control (eq. 8).
        """
        return [position_residual(self.control)]

    def _compute_torques(self, actions: Tensor) -> Tensor:
        """Return the torques that motors are asked for [N m], at every physics step: those of :meth:`action_terms`.

        Override it to compute them in torch; no kernel does it then. ``motors.measured`` returns what joint encoders
        measure. Shapes: (num_envs, num_actions) to (num_envs, num_dof).
        """
        measured = self.motors.measured(self.dof_pos, self.dof_vel)
        return self.control_law.torques(actions, *measured, out=self._wanted_torques)

    def observation_terms(self) -> list[ObservationTerm]:
        """Return the terms of all groups of observations."""
        drawn = (self.randomization.values, self.parameter_mirrors)
        robot = (self.cfg, self.state, self.control, self.control_law)
        return standard_terms(*robot, *drawn, self.symmetry, self.sensors)

    def random_parameters(self) -> list[RandomParameter]:
        """Return what ``domain_rand`` draws in each world."""
        draws, model = self.cfg.random_parameters(), self.asset.mj_model
        return [
            *robot_parameters(draws, model, self.foot_names, self.control, self.torque_limits[1], self.symmetry),
            *ground_parameters(draws, model),
            *control_parameters(draws, self.control, self.motors.strength, self.symmetry),
        ]

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the scalars that curricula set, for logging: weights of reward terms that have one, and levels."""
        weights = self.reward_weights() / self.dt
        curricula = section_keys(self.cfg.rewards.curriculum)
        values = {f"weight_{name}": weights[i] for i, name in enumerate(self.reward_names) if name in curricula}
        return values | self.terrain.curriculum_values() | self.command_generator.curriculum_values()

    # ---- one control step --------------------------------------------------------------------------------------------

    def _step(self) -> None:
        """Physics, rewards, resets and observations of one control step."""
        self.sim.diverged.zero_()
        self.sim.flag_diverged()
        clip = self.cfg.normalization.clip_actions
        self.actions.copy_(self._given_actions.nan_to_num().clamp(-clip, clip))
        self.run_physics()
        self.sim.flag_diverged()
        self.post_physics_step()

    def run_physics(self) -> None:
        """Do the physics steps of a control step, with torques of one kernel where that is possible."""
        self.motors.send(self.actions)
        decimation, pos, vel = self.cfg.control.decimation, self.dof_pos, self.dof_vel
        after_step = self.meter.begin() + self.sensors.begin_step()
        for i in range(decimation):
            if self._torque_kernel and not self._is_overridden():
                self._torque_kernel.launch(i)
            else:
                if i == 0 or self.cfg.control.refresh_torques:
                    wanted = self._compute_torques(self.motors.actions(pos, vel, i))
                self.torques.copy_(self.motors.apply(wanted, pos, vel, i))
            self.sim.step(sense=i == decimation - 1 or self.meter.is_on)
            for look in after_step:
                look()

    def _is_overridden(self) -> bool:
        """Return whether torques are computed by another method than that of this class."""
        return getattr(self._compute_torques, "__func__", None) is not LeggedRobot._compute_torques

    def post_physics_step(self) -> None:
        """Do what follows the physics: termination, rewards, resets, commands, observations."""
        compute_rewards_and_dones, update_sums, end_episodes, finish_step, begin_episodes, observe = self._parts
        compute_rewards_and_dones()
        self.health.check()
        update_sums()
        if self.keep_final_observations:
            self._keep_final_observations()
        end_episodes()
        self._reset_worlds()
        if self.sensors.has_kernels:
            begin_episodes()
            self.sensors.update_all(self.state.reset_buf, compilable=False)
            observe()
        else:
            finish_step()

    def _compute_rewards_and_dones(self) -> None:
        """Count the step, look at the state, and compute ends and rewards; torch only, so that it can be compiled."""
        self.state.episode_length.add_(1)
        self.total_steps.add_(self.num_envs * self.num_processes)
        self.motors.finish_step()
        self.state.update()
        self._post_physics_step_callback()
        self.check_termination()
        self.compute_reward()
        self.health.begin()

    def _update_sums(self) -> None:
        """End broken worlds without a reward, now that they are known, and add to sums; torch only."""
        state, diverged = self.state, self.state.diverged
        self.health.end()
        self.num_diverged.add_(diverged.sum())
        state.reset_buf.logical_or_(diverged)
        state.time_out_buf.logical_and_(~diverged)
        self.rew_buf.masked_fill_(diverged, 0.0)
        self.rewards.add_to_episode(diverged)
        state.episode_return.add_(self.rew_buf)
        self.command_generator.add_step()
        self.log.add_step(state, self.episode_sums)
        state.update_feet_air_time()

    def _end_episodes(self) -> None:
        """Set levels; torch only. Compiled with the sums over worlds, it would run on one processor of a GPU."""
        ended = self.state.reset_buf & ~self.state.diverged  # where broken worlds have got to says nothing
        self.terrain.end_episodes(ended, self.base_pos, self.commands, self.cfg.env.episode_length_s)

    def compute_reward(self) -> None:
        """Compute the sum of all terms (Table III); 0 without terms."""
        if self.reward_names:
            self.rew_buf.copy_(self.rewards.compute(self.total_steps))

    def reward_weights(self) -> Tensor:
        """Return the weights of the terms at this moment of training, Delta t included. Shape: (terms,)."""
        return self.rewards.weights(self.total_steps)

    def _reset_worlds(self) -> None:
        """Put the worlds of ``reset_buf`` where an episode starts; elsewhere draw anew what is due, and push."""
        self.events.apply(self.state.reset_buf)

    def compute_observations(self) -> None:
        """Write the observations of this moment."""
        self.observations.compute(self.state.reset_buf)

    def _finish_step(self) -> None:
        """Begin new episodes, and observe all worlds."""
        self._begin_episodes()
        self.sensors.update_all(self.state.reset_buf, compilable=False)
        self._observe()

    def _begin_episodes(self) -> None:
        """Move new episodes to their tiles, forget those that have ended, and look at the state of all worlds."""
        state = self.state
        self.terrain.move_to_origin(state.reset_buf, state.base_pos)
        per_world = (state.actions.T, state.feet_air_time.T, self.episode_sums, state.episode_return)
        for buffer in (*per_world, state.episode_length):
            buffer.masked_fill_(state.reset_buf, 0)
        self.motors.reset(state.reset_buf)
        self.sensors.begin_episodes(state.reset_buf)
        state.update()
        self.command_generator.update(self.command_generator.is_new)

    def _observe(self) -> None:
        """Measure, compute the observations, and keep what the next rewards compare with."""
        self.sensors.update_all(self.state.reset_buf, compilable=True)
        self.compute_observations()
        self.last_actions.copy_(self.actions)
        self.last_dof_vel.copy_(self.dof_vel)

    def _keep_final_observations(self) -> None:
        """Write the observations of all worlds before any reset; sensors go on as if nothing had been read."""
        with self.sensors.looking_ahead():
            for name, values in self.observations.look().items():
                self._final.setdefault(name, torch.zeros_like(values)).copy_(values)

    def set_state(self, qpos: Tensor, qvel: Tensor) -> None:
        """Put all worlds into states as in ``sim.qpos`` and ``sim.qvel``, without contacts yet; episodes go on."""
        self.state.place(qpos, qvel)
        self.command_generator.update()
        self.sensors.begin_episodes(self.state.reset_buf)
        self.sensors.update_all(self.state.reset_buf, compilable=False)
        self._observe()

    def world_state_dict(self) -> dict[str, Any]:
        """Return all that worlds keep from step to step, by owner."""
        owners: dict[str, Any] = {"sim": self.sim, "state": self.state, "rewards": self.rewards, "log": self.log}
        owners |= {"motors": self.motors, "meter": self.meter, "events": self.events, "sensors": self.sensors}
        owners |= {"commands": self.command_generator, "terrain": self.terrain, "observations": self.observations}
        return {name: owner.state_dict() for name, owner in owners.items()} | {"task": self._world_state}

    # ---- construction, in this order ---------------------------------------------------------------------------------

    def _create_sim(self) -> None:
        """Load robot and ground, and build the simulator."""
        cfg, sim = self.cfg, self.cfg.sim
        self.terrain = make_terrain(cfg.terrain, self.num_envs, self.device)
        has_map = "height_map" in engine_class(sim.engine).capabilities
        height_map = self.terrain.map if has_map else None  # other engines find it in their model
        self.asset = load_asset(cfg, None if height_map else self.terrain)
        worlds, limits = (self.num_envs, self.device), (sim.solver_iterations, sim.ls_iterations)
        self.sim = make_engine(sim.engine, self.asset.mj_model, *worlds, *limits, height_map)
        self.dof_names, self.foot_names = self.asset.dof_names, self.asset.foot_names
        self.num_dof = len(self.dof_names)
        self.symmetry = self.asset.symmetry(cfg.asset.mirrored_legs)
        self.notes = [*self.asset.notes, *self.sim.notes, *notes_on(cfg)]

    def _init_buffers(self) -> None:
        """Allocate constants of the controller and of the rewards; approaches add their own."""
        pose = nominal_pose(self.cfg.init_state.default_joint_angles, self.dof_names)
        self.control = ControlParameters(self.cfg.control, self.dof_names, pose, self.num_envs, self.device)
        limits = self.asset.mj_model.actuator_forcerange.T
        self.torque_limits = torch.tensor(limits, dtype=torch.float32, device=self.device)
        self.symmetry.refuse(control_problem(self.symmetry.joints, self.dof_names, self.control, self.cfg.motors))
        self._init_terminations(self.asset.terminating, self.device)
        self._init_reward_buffers(self.asset, self.device)

    def _init_state(self) -> None:
        """Build control law, state, motors and sensors."""
        cfg, asset = self.cfg, self.asset
        self._use_attributes_of(self.control)
        self.control_law = ControlLaw(self.action_terms(), self.num_dof)
        self.num_actions = self.control_law.num_actions
        if cfg.env.num_actions not in (None, self.num_actions):
            expected = f"{self.num_actions} for {type(self).__name__}"
            raise UserError(f"env.num_actions must be {expected}, not {cfg.env.num_actions}")
        cfg.env.num_actions = self.num_actions
        self.state = RobotState(self.sim, self.terrain, asset.feet, asset.foot_of, self.num_actions, self.dt)
        self._use_attributes_of(self.state)
        self._given_actions, self._wanted_torques = torch.zeros_like(self.actions), torch.zeros_like(self.dof_vel)
        armature = torch.tensor(asset.mj_model.dof_armature[6:], dtype=torch.float32, device=self.device)
        clock = (cfg.sim.dt, cfg.control.decimation)
        constants, control = (self.dof_names, self.torque_limits, armature), self.control
        targets = (control.default_dof_pos, (control.p_gains, control.d_gains))
        self.motors = MotorChain(cfg.motors, Joints(*constants, self.actions, *clock, *targets))
        self.motor_strength = self.motors.strength
        self.meter = StepMeter(self.state, self.motors, cfg.control, self.dof_names)
        self._torque_kernel = None
        if cfg.control.refresh_torques:
            self._torque_kernel = self.motors.kernel(self.control_law.kernel, self.dof_pos, self.dof_vel, self.torques)
            if self._is_overridden() or not self._torque_kernel:
                self.notes.append(f"{type(self).__name__}: {IN_TORCH}")
        self.sensors = Sensors(cfg, self.state, self.motors)

    def _prepare_reward_functions(self) -> None:
        """Collect the functions of all terms with a scale that is not zero, and their weights."""
        names = [name for name in dir(type(self)) if name.startswith("_reward_")]
        functions = {name.removeprefix("_reward_"): getattr(self, name) for name in names}
        self.rewards = Rewards(functions, self.cfg.rewards, self.dt, self.num_envs, self.device)
        self.reward_names, self.episode_sums = self.rewards.names, self.rewards.episode_sums
        self.log = TaskLog(self.reward_names, self.num_envs, self.device)

    def _init_random_events(self) -> None:
        """Prepare commands, initial states, random parameters and pushes."""
        cfg, model, rand = self.cfg, self.asset.mj_model, self.cfg.domain_rand
        self.command_generator = make_commands(self)
        angles = torch.zeros(self.num_envs, 3, device=self.device)
        of_robot = self.motors.random_parameters() + self.sensors.random_parameters()
        pose, state = self.default_dof_pos.tolist(), (self.sim.qpos, self.sim.qvel)
        at_reset = initial_state(cfg, model, *state, angles, pose)
        at_reset += [*(drawn for drawn in of_robot if drawn.at_reset_only), initial_place(cfg, self.sim.qpos)]
        declared = [*self.random_parameters(), *(drawn for drawn in of_robot if not drawn.at_reset_only)]
        drawn = with_settings(declared, rand, cfg.random_parameters())
        self.events = RandomEvents(cfg, self.sim, self.command_generator, angles, at_reset, drawn)
        self.randomization = self.events.parameters
        self.parameter_mirrors = mirrors(self.randomization, rand.randomize_parameters)
        if rand.randomize_parameters:
            self.notes += range_notes(drawn, self.randomization.fields, self.torque_limits[1].cpu().numpy())

    def _init_observations(self) -> None:
        """Prepare the observations."""
        cfg = self.cfg
        seen = (cfg.env.history_length, cfg.normalization.clip_observations, cfg.noise.add_noise)
        self.observations = Observations(self.observation_terms(), *seen, self.num_envs)
        self.obs_buf = self.observations.buffers

    @functools.cached_property
    def mirror(self) -> Mirror:
        """Reflects observations and actions of this robot left to right.

        A UserError if the robot is not symmetric, or the mirror image of a term or of a random parameter is not known.
        """
        unknown = [name for name, mirroring in self.parameter_mirrors.items() if mirroring is None]
        image = f"the mirror image of the random parameter '{unknown[0]}'" if unknown else ""
        problem = f"{image} is not known, or leaves its range" if unknown else ""
        mirrors = self.observations.mirrors() | {"actions": self.control_law.mirrors(self.symmetry.joints)}
        return Mirror(mirrors, self.symmetry.problem or problem, self.device)

    def _use_attributes_of(self, owner: RobotState | ControlParameters) -> None:
        """Have the tensors of an object as attributes, too."""
        tensors = {name: value for name, value in vars(owner).items() if isinstance(value, Tensor)}
        self.__dict__.update({name: value for name, value in tensors.items() if not name.startswith("_")})
