"""Gravity pre-training: the torque policy starts from one that has learned to stand by supervision (paper, III-A)."""

from __future__ import annotations

from legged_torque.envs.approaches.torque import A1TorqueCfg, A1TorqueCfgPPO


class A1TorqueGravityCfg(A1TorqueCfg):
    """Settings of ``a1_torque_gravity``: those of default torque control."""


class A1TorqueGravityCfgPPO(A1TorqueCfgPPO):
    """Training of ``a1_torque_gravity``."""

    class runner(A1TorqueCfgPPO.runner):
        experiment_name = "a1_torque_gravity"

    class pretraining(A1TorqueCfgPPO.pretraining):
        function = "legged_torque.control.gravity_pretraining:pretrain"
        critic_warmup_iterations = 10
        seed = 1
        num_configurations = 20_000  # random initial states, each followed for
        num_steps = 50  # control steps,
        num_rounds = 4  # first under the controller, in the other rounds under the policy as it is by then
        max_mean_torque = 30.0  # [N m] pairs with a larger mean absolute torque are dropped, as in the paper
        max_residual = 3.0  # likewise: what the contacts cannot give of the wanted wrench, as a share of the weight
        held_out = 0.1  # share of the configurations that only measure the learned policy
        num_epochs = 4  # per round, through all pairs so far
        batch_size = 4096
        learning_rate = 1e-3

        class controller:
            """Where the imitated controller differs from the one that stands most often: it is softer."""

            joint_damping = 0.5
            foot_stiffness = 0.0
            attitude_stiffness = 100.0
            attitude_damping = 15.0
            position_stiffness = 20.0
            position_damping = 6.0
