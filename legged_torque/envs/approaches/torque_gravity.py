"""Gravity pre-training: the torque policy starts from one that has learned to stand by supervision (paper, III-A)."""

from typing import Any

from legged_torque.envs.approaches.torque_config import TorqueCfgPPO
from legged_torque.utils.config import Section
from legged_torque.utils.limits import Count, Fraction, NotNegative, Number, Positive, Share


class TorqueGravityCfgPPO(TorqueCfgPPO):
    """Training of torque control from a pre-trained policy; the task is that of default torque control."""

    class pretraining:
        function = "legged_torque.paper.gravity.pretraining:pretrain"
        critic_warmup_iterations = 10
        seed: Number = 1  # of the pre-training alone
        num_configurations: Count = 20_000  # random initial states, each followed for
        num_steps: Count = 50  # control steps,
        num_rounds: Count = 4  # round 1: the controller acts; later rounds: the current policy (DAgger)
        max_mean_torque: Positive = 30.0  # [N m] pairs with a larger mean absolute torque are dropped, as in the paper
        max_residual: Positive = 3.0  # [weights] largest part of the wanted wrench that contacts cannot give
        held_out: Share = 0.1  # share of the configurations that only measure the learned policy
        num_epochs: Count = 4  # per round, through all pairs so far
        batch_size: Count = 4096  # pairs per gradient step
        learning_rate: Fraction = 1e-3  # the first one, of Adam; it falls to 0

        class controller(Section):
            """Where the imitated controller differs from the one that stands most often: it is softer."""

            joint_damping: NotNegative = 0.5  # [N m s/rad] of the posture
            foot_stiffness: NotNegative = 0.0  # [N/m] of feet in the air
            attitude_stiffness: NotNegative = 100.0  # [1/s^2] of the trunk towards level
            attitude_damping: NotNegative = 15.0  # [1/s] of its angular velocity
            position_stiffness: NotNegative = 20.0  # [1/s^2] of the trunk towards its height
            position_damping: NotNegative = 6.0  # [1/s] of its linear velocity

    def presets(self) -> dict[str, dict[str, Any]]:
        """Return all but the laptop's: its small networks would need a pre-trained policy of their own."""
        named = super().presets()
        del named["laptop"]
        return named
