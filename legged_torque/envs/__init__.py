"""All tasks, and what a variant builds on; what needs torch is imported when it is first asked for."""

import pkgutil
from typing import TYPE_CHECKING, Any

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg as LeggedRobotCfg
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfgPPO as LeggedRobotCfgPPO
from legged_torque.envs.base.legged_robot_config import LinearChange as LinearChange
from legged_torque.envs.robots.a1 import A1Cfg as A1Cfg
from legged_torque.envs.robots.a1 import A1CfgPPO as A1CfgPPO
from legged_torque.envs.tasks import A1GravityMultiHeadCfgPPO as A1GravityMultiHeadCfgPPO
from legged_torque.envs.tasks import A1TorqueCfg as A1TorqueCfg
from legged_torque.envs.tasks import A1TorqueCfgPPO as A1TorqueCfgPPO
from legged_torque.envs.tasks import A1TorqueCurriculumCfg as A1TorqueCurriculumCfg
from legged_torque.envs.tasks import A1TorqueCurriculumCfgPPO as A1TorqueCurriculumCfgPPO
from legged_torque.envs.tasks import A1TorqueCurriculumHighCfg as A1TorqueCurriculumHighCfg
from legged_torque.envs.tasks import A1TorqueGravityCfgPPO as A1TorqueGravityCfgPPO
from legged_torque.envs.tasks import A1TorqueMultiHeadCfg as A1TorqueMultiHeadCfg
from legged_torque.envs.tasks import register_robot as register_robot
from legged_torque.utils.config import Section as Section
from legged_torque.utils.task_registry import task_registry as task_registry

if TYPE_CHECKING:
    from legged_torque.envs.approaches.multi_head import CurriculumMultiHeadRobot as CurriculumMultiHeadRobot
    from legged_torque.envs.approaches.multi_head import MultiHeadRobot as MultiHeadRobot
    from legged_torque.envs.approaches.multi_head import MultiHeadTwoRatesRobot as MultiHeadTwoRatesRobot
    from legged_torque.envs.approaches.torque import TorqueRobot as TorqueRobot
    from legged_torque.envs.approaches.torque_curriculum import TorqueCurriculumRobot as TorqueCurriculumRobot
    from legged_torque.envs.base.legged_robot import LeggedRobot as LeggedRobot
    from legged_torque.envs.base.observations import ObservationTerm as ObservationTerm

_LATER = {
    "CurriculumMultiHeadRobot": "legged_torque.envs.approaches.multi_head:CurriculumMultiHeadRobot",
    "MultiHeadRobot": "legged_torque.envs.approaches.multi_head:MultiHeadRobot",
    "MultiHeadTwoRatesRobot": "legged_torque.envs.approaches.multi_head:MultiHeadTwoRatesRobot",
    "TorqueRobot": "legged_torque.envs.approaches.torque:TorqueRobot",
    "TorqueCurriculumRobot": "legged_torque.envs.approaches.torque_curriculum:TorqueCurriculumRobot",
    "LeggedRobot": "legged_torque.envs.base.legged_robot:LeggedRobot",
    "ObservationTerm": "legged_torque.envs.base.observations:ObservationTerm",
}
"""Modules of the classes that need torch."""


def __getattr__(name: str) -> Any:
    """Return a class of :data:`_LATER`: Python calls this for names that the module does not have (PEP 562)."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return pkgutil.resolve_name(_LATER[name])
