"""The settings of a task and of its training, with legged_gym's names. A variant inherits and overrides.

Values that belong to a robot are placeholders here, see :mod:`legged_torque.envs.robots`.
"""

from typing import Annotated, Any, Literal

from legged_torque.envs.base.clocks import set_clocks
from legged_torque.envs.base.commands_config import CommandsCfg
from legged_torque.envs.base.distillation_config import DistillationCfg
from legged_torque.envs.base.flashsac_config import FlashSACCfg
from legged_torque.envs.base.linear_change import LinearChange
from legged_torque.envs.base.older_runs import converted, is_older
from legged_torque.envs.base.presets import standard_presets
from legged_torque.envs.base.training_config import TrainingCfg
from legged_torque.motors.config import DelayCfg, LatencyCfg, PerturbationCfg
from legged_torque.motors.model_config import MotorsCfg
from legged_torque.utils.config import BaseConfig, to_dict
from legged_torque.utils.limits import (
    Activation,
    Count,
    Fraction,
    Interval,
    Limits,
    NotNegative,
    Number,
    Positive,
    Ranges,
    Share,
    Sizes,
    Worlds,
)

Place = Annotated[list[float], Limits(-1e3, 1e3, length=3)]
Scan = Annotated[list[float], Limits(-10, 10, nonempty=True)]
Gains = Annotated[float | dict[str, float], Limits(lowest=0)]


class LeggedRobotCfg(BaseConfig):
    """Settings of :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`."""

    class env:  # worlds and episodes
        num_envs: Worlds = 4096  # worlds of each process
        num_envs_cpu: Worlds = 64  # default on a CPU, where a world-step costs up to 0.3 ms
        num_actions: Count | None = None  # None: those of the approach for each joint of the robot
        history_length: Annotated[int, Limits(1, 1000)] = 1  # control steps that the policy sees, the newest first
        episode_length_s: Annotated[float, Limits(above=0, highest=1e6)] = 20.0  # [s]

    class asset:  # the robot, and which of its geoms mean what
        file: str = ""  # MJCF, absolute or below resources/
        foot_name: str = "foot"  # collision geoms whose name contains this are feet, those of one body a single one
        penalize_contacts_on: list[str] = []  # parts of the names of geoms whose contacts the collision term counts
        terminate_after_contacts_on: list[str] = []  # parts of the names of geoms whose contacts end an episode
        mirrored_legs: list[list[str]] = []  # pairs [right, left] of names of legs, with which names of parts begin
        max_dof_vel: NotNegative = 0.0  # [rad/s] highest speed of the joints
        self_collisions: bool = False  # whether parts of the robot collide with each other, where its file lets them

    class sim:  # physics
        dt: Annotated[float, Limits(above=0, highest=0.1)] = 0.005  # [s] physics step
        engine: str = "fused"  # for legged robots; mujoco_warp is for any robot
        solver_iterations: Annotated[int, Limits(1, 1000)] = 30  # at most
        ls_iterations: Annotated[int, Limits(1, 1000)] = 20  # line search, at most

    class terrain:  # the ground
        mesh_type: str = "plane"  # or heightfield: a map of tiles, to which all that follows belongs
        seed: Number = 1  # of the map
        num_rows: Annotated[int, Limits(1, 100)] = 10  # levels: rows of tiles along x, the first is the easiest
        num_cols: Annotated[int, Limits(1, 100)] = 20  # tiles of each level, along y; a column is of one kind
        difficulty_range: Annotated[list[float], Limits(0, 1, ordered=True)] = [0.0, 1.0]  # rows divide it evenly
        difficulties: Annotated[list[float], Limits(0, 1)] = []  # of each row, in place of difficulty_range
        tile_size: Annotated[float, Limits(6, 100)] = 8.0  # [m] side of a tile
        border_size: Annotated[float, Limits(0, 100)] = 25.0  # [m] level ground around all tiles
        horizontal_scale: Annotated[float, Limits(0.01, 0.5)] = 0.05  # [m] from sample to sample
        curriculum: bool = True  # whether robots change levels; if not, they are spread evenly over all
        max_init_terrain_level: Number = 5  # with the curriculum, highest level on which robots start
        measure_heights: bool = False  # whether the policy sees the height scan, too; the critic always does
        measure_delay: Annotated[int, Limits(0, 100)] = 0  # control steps by which what the policy sees of it is late
        measured_points_x: Scan = [x / 10 for x in range(-8, 9)]  # [m] where the height scan measures: ahead
        measured_points_y: Scan = [y / 10 for y in range(-5, 6)]  # [m] and to the left

        class terrain_proportions:  # share of the columns of each kind; together 1
            flat: Share = 0.0  # level
            smooth_slope_up: Share = 0.05  # up to 0.4
            smooth_slope_down: Share = 0.05  # down to -0.4
            rough_slope: Share = 0.1  # the same, and random heights
            stairs_up: Share = 0.35  # steps of 0.05 to 0.23 m
            stairs_down: Share = 0.25  # the same, downwards
            discrete_obstacles: Share = 0.2  # blocks and hollows of up to 0.25 m
            waves: Share = 0.0  # crests of up to 0.3 m
            stepping_stones: Share = 0.0  # of 1.58 to 0.08 m, with holes between them
            gaps: Share = 0.0  # of up to 1 m
            pits: Share = 0.0  # up to 1 m deep

    class motors(MotorsCfg):  # from actions to the torques that joints get: a link is a section with a method ``build``
        chain: list[str] = ["delay", "ideal"]  # links in order: those of actions, then those of torques

        class delay(DelayCfg):  # time from the policy to the motors
            range, unit = [0, 0], "physics_steps"  # drawn at every reset; the unit of all times
            jitter, loss = 0, 0.0  # of each control step: longest further time, and share that is lost

        class perturbation(PerturbationCfg):  # random torques that depend on the state, if the chain names it
            most = 2.0  # [N m] largest torque; ours, as are
            offset = 1.0  # the largest weights, either way: of a constant,
            of_pos = 1.0  # [1/rad] of the joint position,
            of_vel = 0.1  # [s/rad] and of the joint velocity

    class sensing:  # from the robot's own sensors, joint encoders and IMU, to the policy
        class delay(LatencyCfg):  # of the measurement of each physics step; the critic sees the present
            range, unit = [0, 0], "physics_steps"  # as of ``motors.delay``
            jitter, loss = 0, 0.0  # of each measurement

    class sensors:  # sensors by name: a sensor is a section with a method ``build``
        pass

    class init_state:  # where episodes start, and the nominal pose
        pos: Place = [0.0, 0.0, 1.0]  # [m] of the trunk at a reset: high enough for stretched legs
        default_joint_angles: dict[str, float] = {}  # [rad] q_nominal, by joint name, in the order that policies see

    class domain_rand:
        """Uniform ranges [lowest, highest] of all that is drawn at random. See ``perturbations``, ``parameter_ranges``.

        A parameter has ranges by operation: "set" replaces the robot's own value, "add" is added to it, "scale" and
        "scale_per_joint" multiply it; {} leaves it alone. Of several operations, they follow in this order.
        """

        # initial state, at every reset
        init_place: Annotated[list[float], Limits(-1, 1, ordered=True)] = [0.0, 0.0]  # [m] of the trunk, on x and y
        init_roll: Interval = [-0.19635, 0.19635]  # [rad]
        init_pitch: Interval = [-0.19635, 0.19635]  # [rad]
        init_yaw: Interval = [-3.14159, 3.14159]  # [rad]
        init_dof_pos_scale: Interval = [0.5, 1.5]  # times q_nominal, then inside the joint limits
        init_dof_vel: Interval = [0.0, 0.0]  # [rad/s]
        init_lin_vel: Interval = [0.0, 0.0]  # [m/s] of the trunk, per axis
        init_ang_vel: Interval = [0.0, 0.0]  # [rad/s] of the trunk, per axis

        # parameters, resampled at resets and at random; one value per world unless noted
        randomize_parameters: bool = False  # whether parameters are drawn at all
        keep_fixed: list[str] = []  # names of parameters below that are not drawn after all
        _swept: tuple[str, ...] = ()  # if set, only these are drawn, those of tasks and motors included
        keep_probability: Share = 0.0  # of draws in which the joints keep their own values of dof_*
        resampling_probability: Share = 0.002  # per control step and world
        trunk_mass: Ranges = {"scale": [0.8, 1.2]}  # [kg]; inertia in proportion
        trunk_com: Ranges = {"add": [-0.003, 0.003]}  # [m] the same on all three axes
        foot_radius: Ranges = {"scale": [0.95, 1.05]}  # [m]; a scale is for round feet only
        foot_pos: Ranges = {"add": [-0.0025, 0.0025]}  # [m] per foot and axis
        dof_damping: Ranges = {"add": [0.0, 0.4]}  # [N m s/rad] per joint; add: in units of Kd
        dof_armature: Ranges = {"scale": [0.8, 2.0]}  # [kg m^2] per joint
        dof_stiffness: Ranges = {"add": [0.0, 0.01]}  # [N m/rad] per joint, of a spring; add: in units of Kp
        dof_frictionloss: Ranges = {"add": [0.0, 0.012]}  # [N m] per joint; add: in units of the torque limit
        ground_friction: Ranges = {"set": [0.8, 1.2]}  # tangential; torsional and rolling in proportion
        contact_stiffness: Ranges = {"set": [900.0, 1100.0]}  # of MuJoCo's direct solref
        contact_damping: Ranges = {"set": [72.0, 88.0]}  # low where the stiffness is low
        gravity: Ranges = {"set": [9.51, 10.11]}  # [m/s^2]
        motor_strength: Ranges = {"scale": [0.9, 1.1], "scale_per_joint": [0.98, 1.02]}  # on what the control law wants
        joint_offset: Ranges = {"add": [-0.01, 0.01]}  # [rad] on the target angle, per joint
        action_scale: Ranges = {}  # [rad] per unit of a position action; torques in proportion
        stiffness: Ranges = {"scale": [0.9, 1.1], "scale_per_joint": [0.98, 1.02]}  # [N m/rad] Kp
        damping: Ranges = {"scale": [0.9, 1.1], "scale_per_joint": [0.98, 1.02]}  # [N m s/rad] Kd

        # pushes: half of them add to the trunk's velocity, half set it
        push_robots: bool = False  # whether robots are pushed
        push_probability: Share = 0.002  # per control step and world
        push_velocity: Interval = [-0.3, 0.3]  # [m/s] on each axis
        push_set_factor: NotNegative = 1.1  # times the draw, where it sets the velocity

    class noise:  # errors of the policy's sensors: uniform, at most this much either way
        add_noise: bool = False  # whether sensors have errors

        class noise_scales:  # by group of observations
            dof_pos: NotNegative = 0.01  # [rad]
            dof_vel: NotNegative = 0.5  # [rad/s]
            ang_vel: NotNegative = 0.1  # [rad/s]
            gravity: NotNegative = 0.05  # of the unit vector
            height_measurements: NotNegative = 0.1  # [m] of each point of the height scan

    class commands(CommandsCfg):  # commanded velocities: what they are drawn from, and ``build``
        pass

    class terminations:  # early ends of episodes: methods ``_termination_<term>``; false or 0: not in use
        contact: bool = True  # geoms of asset.terminate_after_contacts_on touch the ground
        tilt: Annotated[float, Limits(0, 3.14160)] = 0.0  # [rad] the trunk leans more than this
        base_height: NotNegative = 0.0  # [m] the trunk is lower than this above the ground

    class control:  # from actions to torques
        decimation: Annotated[int, Limits(1, 1000)] = 4  # physics steps per control step: 50 Hz
        refresh_torques: bool = True  # whether torques are computed anew at every physics step
        stiffness: Gains = 0.0  # [N m/rad] Kp; of all joints, or by a part of their names
        damping: Gains = 0.0  # [N m s/rad] Kd; of all joints, or by a part of their names
        action_scale: Positive = 0.25  # [rad] per unit of a position action
        torque_scale: Positive = 1.0  # [N m] per unit of a torque action
        copper_loss: Gains = 0.0  # [W/(N m)^2] of the electrical metrics; of all joints, or by a part of their names

    class rewards:  # the terms of Table III; each is a method ``_reward_<term>``
        only_positive_rewards: bool = True  # clip the sum at 0 from below
        tracking_temperature: Positive = 4.0  # gamma of both tracking terms
        soft_dof_pos_limit: Fraction = 0.9  # share of a joint's range, beyond which dof_pos_limits acts
        base_height_target: NotNegative = 0.0  # [m] of the trunk above the ground, in the nominal pose
        feet_air_time_target: NotNegative = 0.5  # [s] feet_air_time rewards swings beyond it, single_stance up to it
        held_joints: list[str] = []  # parts of the names of joints that dof_deviation holds

        class scales:  # weights of Table III; each times the control step and its factor of ``curriculum``
            tracking_lin_vel: float = 1.0  # following commanded v_x and v_y
            tracking_ang_vel: float = 1.0  # following the commanded yaw rate
            lin_vel_z: float = -2.0  # vertical velocity of the trunk
            ang_vel_xy: float = -0.05  # roll and pitch rates
            orientation: float = -0.2  # tilt
            dof_pos_limits: float = -10.0  # joints beyond their soft limits
            dof_acc: float = -2.5e-7  # joint accelerations
            torques: float = -2e-4  # applied torques
            action_rate: float = -1e-6  # changes of actions
            collision: float = -1.0  # contacts of asset.penalize_contacts_on
            base_height: float = -30.0  # distance from base_height_target
            feet_air_time: float = 0.1  # long swings
            symmetry: float = -0.5  # right and left foot of a pair both in the air
            stumble: float = 0.0  # feet pushed against walls
            single_stance: float = 0.0  # swings of one foot of a pair while the other stands
            dof_deviation: float = 0.0  # rewards.held_joints away from the nominal pose
            alive: float = 0.0  # every step

        class curriculum:  # factors on the scales: linear from start to end between two total step counts (eq. 1)
            class tracking_lin_vel(LinearChange):
                start, end = 4.0, 2.0
                t_start, t_end = 0, 10_000_000

            class tracking_ang_vel(LinearChange):
                start, end = 0.1, 1.0
                t_start, t_end = 0, 10_000_000

    class normalization:  # scales and limits of what the networks see and say
        clip_observations: Positive = 100.0  # largest absolute value, after scaling
        clip_actions: Positive = 100.0  # largest absolute value

        class obs_scales:  # factors on observations
            lin_vel: NotNegative = 2.0  # of velocities in m/s, commands included
            ang_vel: NotNegative = 0.25  # of angular velocities in rad/s, commands included
            dof_pos: NotNegative = 1.0  # of joint angles in rad
            dof_vel: NotNegative = 0.05  # of joint velocities in rad/s
            height_measurements: NotNegative = 5.0  # of the height scan in m

    def perturbations(self) -> dict[str, dict]:
        """Return the named changes that ``--perturbation`` chooses from (paper, IV-A)."""

        def environment(on: bool, velocity: float = 0.0, probability: float = 0.0) -> dict:
            """Return the changes of one environment; pushes in m/s and per 0.02 s."""
            probability *= self.sim.dt * self.control.decimation / 0.02
            speeds = {"init_dof_vel": 0.5 * self.asset.max_dof_vel, "init_lin_vel": 0.5, "init_ang_vel": 0.5}
            states = {name: [-speed, speed] if on else [0.0, 0.0] for name, speed in speeds.items()}
            pushes = {"push_robots": on, "push_velocity": [-velocity, velocity], "push_probability": probability}
            return {"domain_rand": {"randomize_parameters": on, **states, **pushes}, "noise": {"add_noise": on}}

        return {
            "none": environment(False),
            "low": environment(True, 0.3, 0.002),
            "high": environment(True, 1.0, 0.002),
            "high_frequency": environment(True, 1.0, 0.006),
            "doubled": environment(True, 1.0, 0.012),
        }

    def hard_ranges(self) -> dict[str, dict[str, Any]]:
        """Return the published set ``hard`` where it differs from this class, for :meth:`parameter_ranges`."""
        control = {"scale": [0.5, 1.5], "scale_per_joint": [0.95, 1.05]}
        draws = {
            "trunk_mass": {"scale": [0.6, 1.4]},
            "trunk_com": {"add": [-0.01, 0.01]},
            "dof_damping": {"add": [0.0, 4.0]},
            "dof_armature": {"scale": [0.8, 5.0]},
            "dof_stiffness": {"add": [0.0, 0.025]},
            "dof_frictionloss": {"add": [0.0, 0.03]},
            "ground_friction": {"set": [0.001, 2.0]},
            "contact_stiffness": {"set": [500.0, 1500.0]},
            "contact_damping": {"set": [30.0, 130.0]},
            "gravity": {"set": [8.81, 10.81]},
            "motor_strength": control,
            "joint_offset": {"add": [-0.05, 0.05]},
            "stiffness": control,
            "damping": control,
        }
        errors = {"dof_vel": 1.5, "ang_vel": 0.2, "gravity": 0.1}
        return {"domain_rand": {**draws, "push_set_factor": 1.5}, "noise_scales": errors}

    def parameter_ranges(self) -> dict[str, dict]:
        """Return the named sets that ``--ranges`` chooses from: that of this class, and the hard one."""
        own, hard = type(self)(), self.hard_ranges()
        rand, errors = to_dict(own.domain_rand), to_dict(own.noise.noise_scales)
        default = {name: rand[name] for name in (*own.random_parameters(), "keep_probability", "push_set_factor")}
        harder = {name: _replaced(rand[name], value) for name, value in hard["domain_rand"].items()}
        return {
            "default": {"domain_rand": default, "noise": {"noise_scales": errors}},
            "hard": {"domain_rand": default | harder, "noise": {"noise_scales": errors | hard["noise_scales"]}},
        }

    def set_clocks(self, policy_hz: float | None, physics_hz: float | None) -> float:
        """Set the rates of policy and physics, see :func:`~legged_torque.envs.base.clocks.set_clocks`."""
        return set_clocks(self, policy_hz, physics_hz)

    def upgraded(self, values: dict[str, Any]) -> dict[str, Any]:
        """Return the settings of a run of commit d8439d6 in today's layout."""
        return converted(values) if is_older(values) else values

    def random_parameters(self) -> dict[str, dict[str, list[float]]]:
        """Return the ranges of all parameters of ``domain_rand``, by name."""
        return {name: value for name, value in to_dict(self.domain_rand).items() if isinstance(value, dict)}


def _replaced(own: Any, hard: Any) -> Any:
    """Return a parameter's ranges with harder ones; numbers of a robot are not replaced by units of any robot."""
    if not isinstance(own, dict) or "set" in hard:
        return hard
    return own if "set" in own else own | hard


class LeggedRobotCfgPPO(TrainingCfg):
    """Settings of the training: the ``parallel`` preset, made for thousands of worlds."""

    seed: Annotated[int, Limits(lowest=0)] = 1  # of all random numbers of a training

    class runner:  # rollouts, checkpoints and logs
        class_name: str = "legged_torque.learning.runner:OnPolicyRunner"  # what trains
        capture: bool = True  # on a GPU, replay steps, rollouts and updates as CUDA graphs; False runs the same without
        num_steps_per_env: Annotated[int, Limits(1, 1e6)] = 24  # control steps of a rollout
        total_steps: Count = 110_000_000  # over all worlds of all processes; --max_iterations overrides it
        walks_after: Number = 0  # steps after which an A1 tracked 70%, in 256 worlds on a plane; 0: unknown
        save_interval: Count = 50  # iterations between checkpoints
        experiment_name: str = ""  # folder of the runs; empty: the name of the task
        run_name: str = ""  # added to the name of the run's folder
        logger: Literal["tensorboard", "wandb", "none"] = "tensorboard"  # where to
        wandb_project: str = "legged_torque"  # where wandb keeps the runs

    class evaluation:  # measuring the policy while it learns: mean actions, in worlds of their own, between rollouts
        interval: Number = 128_000  # environment steps from one evaluation to the next; 0: none
        at_end: bool = True  # whether to evaluate at the end of a training, too, if only for a while
        num_samples: Count = 32_000  # world steps of one evaluation: the paper's 16 worlds x 2000 steps
        num_envs: Worlds = 4000  # worlds, at most as many as train
        perturbation: str = ""  # environment, one of ``perturbations``; empty: that of the training
        also: list[str] = []  # further environments, measured in worlds of their own into evaluations_<name>.csv
        also_from: Number = 90_000_000  # environment steps from which those are measured, as in the paper's Table I

    class pretraining:  # a policy that is made by supervision before training starts, and from which it starts
        function: str = ""  # what makes it: "module:function"; empty: training starts from random networks
        file: str = ""  # where it is kept; empty: pretrained/<task>.pt in the folder of all experiments
        critic_warmup_iterations: Number = 0  # iterations in which only the critic learns

    class obs_groups:  # which observations which network reads
        actor: list[str] = ["policy"]  # groups of the policy
        critic: list[str] = ["critic"]  # groups of the value function

    class actor:  # the policy's network, an rsl_rl model
        class_name: str = "MLPModel"  # an rsl_rl model
        hidden_dims: Sizes = [512, 256, 128]  # sizes of the hidden layers
        activation: Activation = "elu"  # after every hidden layer

        class distribution_cfg:  # the distribution of its actions
            class_name: str = "legged_torque.learning.distribution:GaussianDistribution"  # rsl_rl's, made for graphs
            init_std: Positive = 1.0  # standard deviation of actions at the start
            std_type: Literal["log", "scalar"] = "log"  # what is learned: its logarithm, or itself

    class critic:  # the value function's network
        class_name: str = "MLPModel"  # an rsl_rl model
        hidden_dims: Sizes = [512, 256, 128]  # sizes of the hidden layers
        activation: Activation = "elu"  # after every hidden layer

    class algorithm:  # PPO, with rsl_rl's names
        class_name: str = "legged_torque.learning.ppo:OnDevicePPO"  # rsl_rl's PPO without waiting for the host
        num_learning_epochs: Annotated[int, Limits(1, 1e4)] = 5  # times that each rollout is learned from
        num_mini_batches: Count = 4  # gradient steps per epoch
        clip_param: Positive = 0.2  # range of the probability ratio around 1, and of value changes
        gamma: Share = 0.98  # discount per control step
        lam: Share = 0.95  # lambda of GAE
        value_loss_coef: NotNegative = 1.0  # weight of the value loss
        entropy_coef: NotNegative = 5e-3  # weight of the entropy bonus
        learning_rate: Fraction = 1e-3  # of Adam; the first one if it adapts
        max_grad_norm: Positive = 1.0  # gradients of actor and critic are clipped to this norm
        schedule: Literal["adaptive", "fixed"] = "adaptive"  # adaptive: steered by the KL divergence
        desired_kl: Positive = 0.02  # of the policy before and after an update
        max_learning_rate: Fraction = 2e-3  # upper bound of an adaptive learning rate
        annealing_start: Share = 0.5  # of the training; then the rate (or desired_kl) and the entropy bonus fall to 0
        use_clipped_value_loss: bool = True  # whether value changes are clipped too
        use_mixed_precision: bool = True  # on a GPU with Triton, matrix products of bfloat16 numbers instead of TF32

        class symmetry_cfg:  # learning from mirror images as well, mostly with rsl_rl's names
            use_data_augmentation: bool = False  # whether minibatches hold mirror images as well
            use_equivariant_networks: bool = True  # instead, where known: networks that mirror actions
            use_mirror_loss: bool = False  # whether actions that are not mirror images cost
            mirror_loss_coeff: NotNegative = 0.1  # weight of that loss
            data_augmentation_func: str = "legged_torque.envs.base.symmetry:with_mirror_images"  # what makes them

    class flashsac(FlashSACCfg):  # FlashSAC, the learner of the preset of that name
        pass

    class distillation(DistillationCfg):  # a student of other policies, the learner of the preset ``student``
        pass

    def presets(self) -> dict[str, dict]:
        """Return the named changes to the settings of task and training that ``--preset`` chooses from."""
        return standard_presets()
