"""Every task by name: robot x approach x ground, by listing their settings as bases: ground, approach, robot.

Task classes are named, not imported, so that a command line is answered before torch is there.
"""

import importlib
import pkgutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from legged_torque.envs import robots
from legged_torque.envs.approaches import decap_config as decap
from legged_torque.envs.approaches import multi_head_config as multi_head
from legged_torque.envs.approaches import sata_config as sata
from legged_torque.envs.approaches import torque_config as torque
from legged_torque.envs.approaches import torque_curriculum_config as torque_curriculum
from legged_torque.envs.approaches import torque_gravity
from legged_torque.envs.approaches import variable_stiffness_config as stiffness
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO
from legged_torque.envs.grounds.rough import RoughCfg, RoughCfgPPO, RoughScanCfg
from legged_torque.envs.robots.a1 import A1Cfg, A1CfgPPO
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.options import DEFAULT_TASK
from legged_torque.utils.task_registry import task_registry


class A1TorqueCfg(torque.TorqueCfg, A1Cfg):
    """A1 whose actions are torques; their scale lets the noise of the start lift it, so that it finds walking."""

    class control:
        torque_scale = 8.0


class A1TorqueCfgPPO(torque.TorqueCfgPPO, A1CfgPPO):
    """Its training."""


class A1TorqueDampedCfg(A1TorqueCfg):
    """A1 with torques, trained with up to 20 ms of latency and damping on the drives, see docs/results.md."""

    class env:
        history_length = 3

    class motors:
        chain = ["delay", "drive", "ideal", "urdf"]

        class delay:
            range = [0, 4]

        class drive:
            damping = 0.5

    class sensing:
        class delay:
            range = [0, 1]


class A1TorqueGravityCfgPPO(torque_gravity.TorqueGravityCfgPPO, A1CfgPPO):
    """Training of torque control from a policy that stands."""


class A1TorqueCurriculumCfg(torque_curriculum.TorqueCurriculumCfg, A1Cfg):
    """A1 with torques that is first rewarded for its nominal pose."""


class A1TorqueCurriculumCfgPPO(torque_curriculum.TorqueCurriculumCfgPPO, A1CfgPPO):
    """Its training."""


class A1TorqueCurriculumHighCfg(A1TorqueCurriculumCfg):
    """The same with a higher nominal pose: its feet are below the same places of the trunk, and 0.33 m below it.

    With links of 0.2 m, a thigh angle t and a calf angle c, a foot is 0.4 cos(c / 2) away from its thigh's joint, and
    t + c / 2 turns that line backwards: 0.32 m below the joint it is 0.015 m behind it at the front, 0.072 m at the
    rear. Hips of 0.1 rad leave 0.310 m below the trunk, and the foot's radius adds 0.02 m.
    """

    class init_state:
        default_joint_angles = (
            {"FR_hip_joint": -0.1, "FR_thigh_joint": 0.69, "FR_calf_joint": -1.28}
            | {"FL_hip_joint": 0.1, "FL_thigh_joint": 0.69, "FL_calf_joint": -1.28}
            | {"RR_hip_joint": -0.1, "RR_thigh_joint": 0.83, "RR_calf_joint": -1.22}
            | {"RL_hip_joint": 0.1, "RL_thigh_joint": 0.83, "RL_calf_joint": -1.22}
        )

    class rewards:
        base_height_target = 0.33


class A1TorqueMultiHeadCfg(multi_head.TorqueMultiHeadCfg, A1Cfg):
    """A1 with positions and torques; the PD part fades to 0."""


class A1GravityMultiHeadCfgPPO(torque_gravity.TorqueGravityCfgPPO, multi_head.MultiHeadCfgPPO, A1CfgPPO):
    """Training from a policy whose torque head stands."""


class A1VariableStiffnessCfg(stiffness.VariableStiffnessCfg, A1Cfg):
    """A1 with positions and stiffness."""


class A1SataCfg(sata.SataCfg, A1TorqueCfg):
    """A1 with torques by muscles that grow."""


class A1SataCfgPPO(sata.SataCfgPPO, A1CfgPPO):
    """Its training."""


class A1DecapCfg(decap.DecapCfg, A1TorqueCfg):
    """A1 with torques and a PD bias that decays."""


_ROBOT = "legged_torque.envs.base.legged_robot:LeggedRobot"
_TORQUE = "legged_torque.envs.approaches.torque:TorqueRobot"
_CURRICULUM = "legged_torque.envs.approaches.torque_curriculum:TorqueCurriculumRobot"
_MULTI_HEAD = "legged_torque.envs.approaches.multi_head:MultiHeadRobot"
_CURRICULUM_MULTI_HEAD = "legged_torque.envs.approaches.multi_head:CurriculumMultiHeadRobot"
_TWO_RATES = "legged_torque.envs.approaches.multi_head:MultiHeadTwoRatesRobot"
_STIFFNESS = "legged_torque.envs.approaches.variable_stiffness:VariableStiffnessRobot"
_SATA = "legged_torque.envs.approaches.sata:SataRobot"
_DECAP = "legged_torque.envs.approaches.decap:DecapRobot"

A1_TASKS: tuple[tuple[str, str, type[LeggedRobotCfg], type[LeggedRobotCfgPPO]], ...] = (
    ("a1_torque", _TORQUE, A1TorqueCfg, A1TorqueCfgPPO),
    ("a1_torque_damped", _TORQUE, A1TorqueDampedCfg, A1TorqueCfgPPO),
    ("a1_torque_gravity", _TORQUE, A1TorqueCfg, A1TorqueGravityCfgPPO),
    ("a1_torque_gravity_curriculum", _CURRICULUM, A1TorqueCurriculumCfg, A1TorqueGravityCfgPPO),
    ("a1_torque_gravity_multihead", _MULTI_HEAD, A1TorqueMultiHeadCfg, A1GravityMultiHeadCfgPPO),
    ("a1_torque_curriculum_high", _CURRICULUM, A1TorqueCurriculumHighCfg, A1TorqueCurriculumCfgPPO),
    ("a1_variable_stiffness", _STIFFNESS, A1VariableStiffnessCfg, A1CfgPPO),
    ("a1_decap", _DECAP, A1DecapCfg, A1TorqueCfgPPO),
    ("a1_sata", _SATA, A1SataCfg, A1SataCfgPPO),
)
"""Tasks of the A1 on a plane that no other robot has, or in another way: name, class, settings and training."""

APPROACHES: tuple[tuple[str, str, type, type], ...] = (
    ("torque", _TORQUE, torque.TorqueCfg, torque.TorqueCfgPPO),
    ("torque_gravity", _TORQUE, torque.TorqueCfg, torque_gravity.TorqueGravityCfgPPO),
    ("torque_curriculum", _CURRICULUM, torque_curriculum.TorqueCurriculumCfg, torque_curriculum.TorqueCurriculumCfgPPO),
    ("torque_multihead", _MULTI_HEAD, multi_head.TorqueMultiHeadCfg, multi_head.MultiHeadCfgPPO),
    ("multihead", _MULTI_HEAD, multi_head.MultiHeadCfg, multi_head.MultiHeadCfgPPO),
    (
        "torque_curriculum_multihead",
        _CURRICULUM_MULTI_HEAD,
        multi_head.CurriculumMultiHeadCfg,
        multi_head.MultiHeadCfgPPO,
    ),
    ("multihead_two_rates", _TWO_RATES, multi_head.MultiHeadTwoRatesCfg, multi_head.MultiHeadTwoRatesCfgPPO),
)
"""Approaches that combine with any robot: name, task class, settings and training; position control is the robot's."""


def tasks_of(name: str, cfg: Any, train_cfg: Any) -> list[tuple[str, str, Any, Any]]:
    """Return the tasks of a robot with all approaches on a plane, as in :data:`A1_TASKS`."""
    tasks = [(f"{name}_position", _ROBOT, cfg, train_cfg)]
    for approach, robot, approach_cfg, approach_train_cfg in APPROACHES:
        text = {"__doc__": f"{cfg.__doc__} Approach: {approach_cfg.__doc__}"}
        settings, training = (approach_cfg, cfg), (approach_train_cfg, train_cfg)
        tasks.append((f"{name}_{approach}", robot, type(cfg.__name__, settings, text), type("CfgPPO", training, text)))
    return tasks


def further_robots() -> Iterator[tuple[str, Any, Any]]:
    """Yield name, settings and training of the robots in ``envs/robots`` but the A1: modules with two such classes.

    A module that cannot be imported, or has several settings, of which none is the robot's for certain, is reported,
    and its robot is missing.
    """
    for module in pkgutil.iter_modules(robots.__path__):
        if module.name != "a1":
            try:
                parts = vars(importlib.import_module(f"{robots.__name__}.{module.name}"))
                own = [c for c in parts.values() if isinstance(c, type) and c.__module__ == parts["__name__"]]
                settings = [part for part in own if issubclass(part, LeggedRobotCfg)]
                training = [part for part in own if issubclass(part, LeggedRobotCfgPPO)]
                LeggedRobotCfg.refuse_mistakes(*settings, *training)
                for classes in (settings, training) if settings and training else ():
                    if len(classes) > 1:
                        names = ", ".join(part.__name__ for part in classes)
                        raise UserError(f"it must have one class of this kind, not {names}")
            except Exception as error:  # a user's own file may raise anything
                print(f"Note: the robot '{module.name}' is missing: {type(error).__name__}: {error}", file=sys.stderr)
                continue
            if settings and training:
                yield module.name, settings[0], training[0]


PURPOSES = {
    "position": "joint positions under PD control",
    "torque": "joint torques",
    "torque_damped": "torques, damped drives, latency",
    "torque_gravity": "torques, from a policy that stands",
    "torque_curriculum": "torques, nominal pose comes first",
    "torque_multihead": "positions + torques, PD down to 0",
    "multihead": "positions + torques, PD down to 0.1",
    "torque_curriculum_multihead": "curriculum, torque multi-head",
    "torque_gravity_curriculum": "pre-training + curriculum",
    "torque_gravity_multihead": "pre-training + torque multi-head",
    "torque_curriculum_high": "curriculum with a higher pose",
    "multihead_two_rates": "positions 50 Hz, torques 200 Hz",
    "variable_stiffness": "positions and stiffness",
    "decap": "torques, PD bias decays",
    "sata": "torques by muscles that grow",
}
"""What the tasks of an approach are, for lists."""


def list_tasks(part: str) -> list[str]:
    """Return lines on all tasks, or on those with ``part`` in their names, by robot and ground.

    A UserError if there is none.
    """
    groups: dict[str, list[str]] = {}
    robots = dict[str, None]()
    for name in task_registry.names():
        cfg, _ = task_registry.get_cfgs(name)
        scan = "_scan" if cfg.terrain.measure_heights else ""
        ground = f"on rough ground, {'with a height scan' if scan else 'blind'}"
        robots[robot := Path(cfg.asset.file).stem] = None
        approach = name.removeprefix(f"{robot}_").removeprefix("rough_").removesuffix(scan)
        purpose = PURPOSES.get(approach) or str(cfg.__doc__).partition("\n")[0]
        if part in name:
            title = f"{robot} {'on a plane' if cfg.terrain.mesh_type == 'plane' else ground}:"
            groups.setdefault(title, []).append(f"{'*' if name == DEFAULT_TASK else ' '} {name:<42} {purpose}")
    if not groups:
        raise unknown_name("part of a task's name", part, robots)
    lines = [line for title, names in groups.items() for line in (title, *names)]
    return [*lines, f"* the default of --task, which is recommended ({len(lines) - len(groups)} tasks)"]


def on_ground(ground: type, task: type) -> Any:
    """Return settings of a task on another ground, which has the last word."""
    return type(ground.__name__, (ground, task), {"__doc__": f"{task.__doc__} On: {ground.__doc__}"})()


def register_robot(name: str, cfg: type[LeggedRobotCfg], train_cfg: type[LeggedRobotCfgPPO]) -> None:
    """Register the tasks of a robot: ``<name>_<approach>`` and ``<name>_rough_<approach>``, for every approach.

    A UserError if one of them is a task already.
    """
    _register(name, tasks_of(name, cfg, train_cfg))


def _register(robot_name: str, tasks: Sequence[tuple[str, str, Any, Any]]) -> None:
    """Register tasks of a robot on a plane, then the same on rough ground."""
    for name, robot, env_cfg, train_cfg in tasks:
        task_registry.register(name, robot, env_cfg(), train_cfg())
    for name, robot, env_cfg, train_cfg in tasks:
        rough_name = f"{robot_name}_rough_{name.removeprefix(f'{robot_name}_')}"
        training = on_ground(RoughCfgPPO, train_cfg)
        task_registry.register(rough_name, robot, on_ground(RoughCfg, env_cfg), training)
        task_registry.register(f"{rough_name}_scan", robot, on_ground(RoughScanCfg, env_cfg), training)


_register("a1", list({task[0]: task for task in (*tasks_of("a1", A1Cfg, A1CfgPPO), *A1_TASKS)}.values()))
for robot_parts in further_robots():
    register_robot(*robot_parts)
