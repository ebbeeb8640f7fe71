"""Settings of curriculum pre-training, see :mod:`~legged_torque.envs.approaches.torque_curriculum`."""

from legged_torque.envs.approaches.torque_config import TorqueCfg, TorqueCfgPPO
from legged_torque.envs.base.legged_robot_config import LinearChange
from legged_torque.utils.limits import Positive


class TorqueCurriculumCfg(TorqueCfg):
    """Settings of the torque curriculum: the reward for the pose fades, then tracking takes over."""

    class rewards:
        nominal_position_temperature: Positive = 0.5  # gamma of the term

        class scales:
            nominal_position: float = 1.0  # standing in the nominal pose

        class curriculum:
            class nominal_position(LinearChange):
                start, end = 20.0, 1.0
                t_start, t_end = 0, 5_000_000

            class tracking_lin_vel:
                t_start, t_end = 3_000_000, 13_000_000

            class tracking_ang_vel:
                t_start, t_end = 3_000_000, 13_000_000


class TorqueCurriculumCfgPPO(TorqueCfgPPO):
    """Training of the torque curriculum: that of torque control."""
