"""Settings of variable stiffness, see :mod:`~legged_torque.envs.approaches.variable_stiffness`."""

from typing import Annotated, Literal

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.utils.limits import Limits, Positive


class VariableStiffnessCfg(LeggedRobotCfg):
    """Settings of PD control with a learned stiffness; ``control.stiffness`` is that of an action of 0."""

    class control:
        stiffness_of: Literal["joint", "leg"] = "leg"  # what has a stiffness of its own
        stiffness_scale: Positive = 5.0  # [N m/rad] per unit of a stiffness action; ours, as is the range
        stiffness_range: Annotated[list[float], Limits(0, 1000, ordered=True)] = [10.0, 60.0]  # [N m/rad]
        damping = 0.2  # Kd per square root of Kp, the paper's number
