"""The settings of a task and of its training, with legged_gym's names. A variant inherits and overrides.

Values that belong to a robot are placeholders here, see :mod:`legged_torque.envs.robots`.
"""

from __future__ import annotations

from legged_torque.utils.config import BaseConfig, Section


class LinearChange(Section):
    """A value that changes linearly with the total number of environment steps (paper, eq. 1)."""

    start = 1.0  # value up to t_start
    end = 1.0  # value from t_end on
    t_start = 0  # [total steps]
    t_end = 1  # [total steps]


class LeggedRobotCfg(BaseConfig):
    """Settings of :class:`~legged_torque.envs.base.legged_robot.LeggedRobot`."""

    class env:  # worlds and episodes
        num_envs = 4096  # worlds of each process
        num_envs_cpu = 64  # default on a CPU, where a world-step costs about a millisecond
        num_actions: int | None = None  # None: those of the approach for each joint of the robot
        history_length = 1  # control steps whose observations the policy sees, the newest first
        episode_length_s = 20.0  # [s]

    class asset:  # the robot, and which of its geoms mean what
        file = ""  # MJCF, absolute or below resources/
        foot_name = "foot"  # collision geoms whose name contains this are feet
        penalize_contacts_on: list[str] = []  # likewise: those of the collision term
        terminate_after_contacts_on: list[str] = []  # likewise: those that end an episode
        mirrored_legs: list[list[str]] = []  # pairs [right, left] of names of legs, with which names of parts begin
        max_dof_vel = 0.0  # [rad/s] highest speed of the joints

    class sim:  # physics
        dt = 0.005  # [s] physics step
        engine = "fused"  # one kernel per physics step, for legged robots on a plane; or "mujoco_warp" for any robot
        solver_iterations = 30  # at most
        ls_iterations = 20  # line search, at most

    class terrain:  # the ground
        mesh_type = "plane"  # the only one so far

    class motors:  # what joints get of the torques that actions ask for
        model = "ideal"  # any torque within the limits, at once

    class init_state:  # where episodes start, and the nominal pose
        pos = [0.0, 0.0, 1.0]  # [m] of the trunk at a reset: high enough for stretched legs
        default_joint_angles: dict[str, float] = {}  # [rad] q_nominal, by joint name, in the order of the MJCF

    class domain_rand:
        """What is drawn at random: uniform ranges [lowest, highest]. See ``perturbations`` and ``parameter_ranges``.

        Of a parameter without a range, every world has the robot's own value.
        """

        # initial state, at every reset
        init_roll = [-0.19635, 0.19635]  # [rad] +-pi/16
        init_pitch = [-0.19635, 0.19635]  # [rad] +-pi/16
        init_yaw = [-3.14159, 3.14159]  # [rad]
        init_dof_pos_scale = [0.5, 1.5]  # times q_nominal, then inside the joint limits
        init_dof_vel = [0.0, 0.0]  # [rad/s]
        init_lin_vel = [0.0, 0.0]  # [m/s] of the trunk, per axis
        init_ang_vel = [0.0, 0.0]  # [rad/s] of the trunk, per axis

        # time from the policy to the motors, at every reset
        action_delay = [0, 0]  # [lowest, highest], whole numbers in action_delay_unit
        action_delay_unit = "physics_steps"  # or "control_steps"

        # parameters, resampled at resets and at random; one value per world unless noted
        randomize_parameters = False  # whether parameters are drawn at all
        keep_fixed: list[str] = []  # names of ranges below that are not drawn after all
        resampling_probability = 0.002  # per control step and world
        trunk_mass_offset = [0.0, 0.0]  # [kg], then
        trunk_mass_scale = [0.75, 1.25]  # times the mass; inertia in proportion
        trunk_com_offset = [-0.0025, 0.0025]  # [m] per axis
        foot_radius: list[float] | None = None  # [m]
        foot_offset = [-0.0025, 0.0025]  # [m] per foot and axis
        keep_probability = 0.3  # share of draws in which the joints keep their own values of the next four
        dof_damping: list[float] | None = None  # [N m s/rad] per joint
        dof_armature: list[float] | None = None  # [kg m^2] per joint
        dof_stiffness: list[float] | None = None  # [N m/rad] per joint, of a spring towards angle 0
        dof_frictionloss: list[float] | None = None  # [N m] per joint
        ground_friction = [0.001, 2.0]  # tangential; torsional and rolling in proportion
        contact_stiffness = [500.0, 1500.0]  # of MuJoCo's direct solref
        contact_damping = [30.0, 130.0]  # low where the stiffness is low
        gravity = [8.81, 10.81]  # [m/s^2]
        motor_strength = [0.75, 1.25]  # times the torques
        joint_offset = [-0.05, 0.05]  # [rad] on the target angle, per joint
        action_scale_offset = [0.0, 0.0]  # [rad] per unit of a position action; torques in proportion
        stiffness_offset = [0.0, 0.0]  # [N m/rad] on Kp, then
        stiffness_scale = [0.75, 1.25]  # times Kp
        damping_offset = [0.0, 0.0]  # [N m s/rad] on Kd, then
        damping_scale = [0.75, 1.25]  # times Kd

        # pushes: half of them set the trunk's velocity, half are added to it
        push_robots = False  # whether robots are pushed
        push_probability = 0.002  # per control step and world
        push_velocity = [-0.3, 0.3]  # [m/s] on each axis

    class noise:  # errors of the policy's sensors: uniform, at most this much either way
        add_noise = False  # whether sensors have errors

        class noise_scales:  # by group of observations
            dof_pos = 0.01  # [rad]
            dof_vel = 1.5  # [rad/s]
            ang_vel = 0.2  # [rad/s]
            gravity = 0.05  # of the unit vector

    class commands:  # commanded velocities, in the trunk's frame
        resampling_probability = 0.002  # per control step: about every 10 s at 50 Hz

        class ranges:  # drawn uniformly
            lin_vel_x = [-1.0, 1.0]  # [m/s]
            lin_vel_y = [-1.0, 1.0]  # [m/s]
            ang_vel_yaw = [-1.0, 1.0]  # [rad/s]

    class control:  # from actions to torques
        decimation = 4  # physics steps per control step: 50 Hz
        refresh_torques = True  # whether torques are computed anew at every physics step
        stiffness: float | dict[str, float] = 0.0  # [N m/rad] Kp; of all joints, or by a part of their names
        damping: float | dict[str, float] = 0.0  # [N m s/rad] Kd, likewise
        action_scale = 0.25  # [rad] per unit of a position action
        torque_scale = 1.0  # [N m] per unit of a torque action

    class rewards:  # the terms of Table III; each is a method ``_reward_<term>``
        only_positive_rewards = True  # clip the sum at 0 from below
        tracking_temperature = 4.0  # gamma of both tracking terms
        soft_dof_pos_limit = 0.9  # share of a joint's range, beyond which dof_pos_limits acts
        base_height_target = 0.0  # [m] of the trunk above the ground, in the nominal pose
        feet_air_time_target = 0.5  # [s] swings are rewarded for what they last beyond this

        class scales:  # weights of Table III; each times the control step and its factor of ``curriculum``
            tracking_lin_vel = 1.0  # following commanded v_x and v_y
            tracking_ang_vel = 1.0  # following the commanded yaw rate
            lin_vel_z = -2.0  # vertical velocity of the trunk
            ang_vel_xy = -0.05  # roll and pitch rates
            orientation = -0.2  # tilt
            dof_pos_limits = -10.0  # joints beyond their soft limits
            dof_acc = -2.5e-7  # joint accelerations
            torques = -2e-4  # applied torques
            action_rate = -1e-6  # changes of actions
            collision = -1.0  # contacts of asset.penalize_contacts_on
            base_height = -30.0  # distance from base_height_target
            feet_air_time = 0.1  # long swings
            symmetry = -0.5  # right and left foot of a pair both in the air

        class curriculum:  # factors on the scales: linear from start to end between two total step counts (eq. 1)
            class tracking_lin_vel(LinearChange):
                start, end = 4.0, 2.0
                t_start, t_end = 0, 10_000_000

            class tracking_ang_vel(LinearChange):
                start, end = 0.1, 1.0
                t_start, t_end = 0, 10_000_000

    class normalization:  # scales and limits of what the networks see and say
        clip_observations = 100.0  # largest absolute value, after scaling
        clip_actions = 100.0  # largest absolute value

        class obs_scales:  # factors on observations
            lin_vel = 2.0  # of velocities in m/s, commands included
            ang_vel = 0.25  # of angular velocities in rad/s, commands included
            dof_pos = 1.0  # of joint angles in rad
            dof_vel = 0.05  # of joint velocities in rad/s

    def perturbations(self) -> dict[str, dict]:
        """Return the named changes that ``--perturbation`` chooses from (paper, IV-A)."""

        def environment(on: bool, velocity: float = 0.0, probability: float = 0.0) -> dict:
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

    def parameter_ranges(self) -> dict[str, dict]:
        """Return the named changes that ``--ranges`` chooses from: those of this class, and narrower ones."""
        ground = {"ground_friction": [0.8, 1.2], "contact_stiffness": [900.0, 1100.0], "contact_damping": [72.0, 88.0]}
        scales = {name: [0.9, 1.1] for name in ("motor_strength", "stiffness_scale", "damping_scale")}
        offsets = {name: [0.0, 0.0] for name in ("action_scale_offset", "stiffness_offset", "damping_offset")}
        narrow = {"gravity": [9.51, 10.11], "joint_offset": [-0.01, 0.01], **ground, **scales, **offsets}
        wide = {name: list(getattr(type(self).domain_rand, name)) for name in narrow}
        return {"wide": {"domain_rand": wide}, "narrow": {"domain_rand": narrow}}


class LeggedRobotCfgPPO(BaseConfig):
    """Settings of the training: the ``parallel`` preset, made for thousands of worlds."""

    seed = 1  # of all random numbers of a training

    class runner:  # rollouts, checkpoints and logs
        class_name = "legged_torque.learning.runner:OnPolicyRunner"  # what trains
        capture = True  # on a GPU, replay steps, rollouts and updates as CUDA graphs; False runs the same without
        num_steps_per_env = 24  # control steps of a rollout
        total_steps = 110_000_000  # over all worlds of all processes; --max_iterations overrides it
        save_interval = 50  # iterations between checkpoints
        experiment_name = ""  # folder of the runs; empty: the name of the task
        run_name = ""  # added to the name of the run's folder
        logger = "tensorboard"  # or "wandb" or "none"
        wandb_project = "legged_torque"  # where wandb keeps the runs

    class evaluation:  # measuring the policy while it learns: mean actions, in worlds of their own, between rollouts
        interval = 128_000  # environment steps from one evaluation to the next; 0: none
        num_samples = 32_000  # world steps of one evaluation: the paper's 16 worlds x 2000 steps
        num_envs = 4000  # worlds, at most as many as train
        perturbation = ""  # environment, one of ``perturbations``; empty: that of the training

    class pretraining:  # a policy that is made by supervision before training starts, and from which it starts
        function = ""  # what makes it: "module:function"; empty: training starts from random networks
        file = ""  # where it is kept; empty: pretrained/<task>.pt in the folder of all experiments
        critic_warmup_iterations = 0  # iterations in which only the critic learns

    class obs_groups:  # which observations which network reads
        actor = ["policy"]  # groups of the policy
        critic = ["critic"]  # groups of the value function

    class actor:  # the policy's network, an rsl_rl model
        class_name = "MLPModel"  # an rsl_rl model
        hidden_dims = [512, 256, 128]  # sizes of the hidden layers
        activation = "elu"  # after every hidden layer

        class distribution_cfg:  # the distribution of its actions
            class_name = "legged_torque.learning.distribution:GaussianDistribution"  # rsl_rl's, made for graphs
            init_std = 1.0  # standard deviation of actions at the start
            std_type = "log"  # what is learned: its logarithm, or "scalar"

    class critic:  # the value function's network
        class_name = "MLPModel"  # an rsl_rl model
        hidden_dims = [512, 256, 128]  # sizes of the hidden layers
        activation = "elu"  # after every hidden layer

    class algorithm:  # PPO, with rsl_rl's names
        class_name = "legged_torque.learning.ppo:OnDevicePPO"  # rsl_rl's PPO without waiting for the host
        num_learning_epochs = 5  # times that each rollout is learned from
        num_mini_batches = 4  # gradient steps per epoch
        clip_param = 0.2  # range of the probability ratio around 1, and of value changes
        gamma = 0.98  # discount per control step
        lam = 0.95  # lambda of GAE
        value_loss_coef = 1.0  # weight of the value loss
        entropy_coef = 5e-4  # weight of the entropy bonus
        learning_rate = 1e-3  # of Adam; the first one if it adapts
        max_grad_norm = 1.0  # gradients of actor and critic are clipped to this norm
        schedule = "adaptive"  # steers the learning rate by the KL divergence; or "fixed"
        desired_kl = 0.01  # of the policy before and after an update
        max_learning_rate = 1e-2  # upper bound of an adaptive learning rate
        use_clipped_value_loss = True  # whether value changes are clipped too

        class symmetry_cfg:  # learning from mirror images as well, with rsl_rl's names
            use_data_augmentation = False  # whether minibatches hold mirror images as well
            use_mirror_loss = False  # whether actions that are not mirror images cost
            mirror_loss_coeff = 0.1  # weight of that loss
            data_augmentation_func = "legged_torque.envs.base.symmetry:with_mirror_images"  # what makes them

    def presets(self) -> dict[str, dict]:
        """Return the named changes to the settings of task and training that ``--preset`` chooses from."""
        rollouts = {"env": {"num_envs": 16, "num_envs_cpu": 16}, "runner": {"num_steps_per_env": 2000}}
        ppo = {"num_learning_epochs": 5, "num_mini_batches": 32, "clip_param": 0.1, "gamma": 0.99, "lam": 0.9}
        ppo |= {"entropy_coef": 5e-4, "learning_rate": 1e-4, "max_grad_norm": 5.0}
        fixed = {"schedule": "fixed", "symmetry_cfg": {"use_data_augmentation": False}}
        return {"parallel": {}, "paper": {**rollouts, "algorithm": {**ppo, **fixed}}}  # Table II to the letter
