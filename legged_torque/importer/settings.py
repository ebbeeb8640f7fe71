"""Writing the settings class of an imported robot."""

import json

import numpy as np

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.importer.legs import FOOT, TRUNK, free_joints
from legged_torque.importer.robot import Robot

WEIGHT_TIMES_HEIGHT = 37.0  # of an A1 with its trunk at 0.303 m [N m]
TORQUE_SCALE = 1.1  # torque of an action of 1, as a multiple of the largest that holds the nominal pose; as for the A1
SCALED_HEIGHT = 0.28  # trunk height for which that holds; larger robots with four legs learn sooner with less [m]
ACTION_SCALE = (0.25, 0.15)  # without and with two legs, whose gains are higher than the G1's [rad]
LINE = 90  # most characters of a literal in one line

IMPORTED = "imported settings; each number is a proposal to look at."  # at the end of a module's docstring
TEMPLATE = '''"""{title}: {imported}"""

# Source: {file}

{imports}

class {cls}Cfg({base}):
    """Settings of the robot; alone, of position control on a plane."""

    class asset:
        file = {path}
        foot_name = "{foot}"
        penalize_contacts_on = {penalized}
        terminate_after_contacts_on = {terminating}
        mirrored_legs = {mirrored}
        max_dof_vel = {speed}

{engine}    class init_state:
        pos = [0.0, 0.0, {drop}]
        default_joint_angles = {angles}

    class control:  # as stiff for its weight and height as the robots of the library
        stiffness = {stiffness}
        damping = {damping}
        action_scale = {action_scale}
        torque_scale = {torque_scale}

{two_legs}    class rewards:
        base_height_target = {height}
        held_joints = {held}

        class scales:
            torques = {torques:.2g}  # the A1's, as its squared torques are to this robot's: by weight times height


class {cls}CfgPPO(LeggedRobotCfgPPO):
    """Training of it."""
{symmetry}{registration}'''
IMPORTS = "from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO\n"
OWN_IMPORTS = """from pathlib import Path

from legged_torque.envs import LeggedRobotCfg, LeggedRobotCfgPPO, register_robot
"""
REGISTRATION = """

register_robot("{name}", {cls}Cfg, {cls}CfgPPO)  # its tasks: {name}_position, {name}_rough_position, ...
"""
ENGINE = """    class sim:
        engine = "mujoco_warp"  # slower; the fused step cannot simulate this robot

"""
SYMMETRY = """
    class algorithm:
        class symmetry_cfg:
            use_data_augmentation = True
"""
TWO_LEGS = """    class domain_rand:  # in shares of the robot, not as the G1's
        trunk_mass = LeggedRobotCfg.domain_rand.trunk_mass
        dof_damping = LeggedRobotCfg.domain_rand.dof_damping
        dof_armature = LeggedRobotCfg.domain_rand.dof_armature
        dof_stiffness = LeggedRobotCfg.domain_rand.dof_stiffness
        dof_frictionloss = LeggedRobotCfg.domain_rand.dof_frictionloss

"""
G1 = "from legged_torque.envs.robots.g1 import G1Cfg  # rewards, commands and starts that two legs need\n"


def settings(robot: Robot, path: str = "", is_fused: bool = True) -> str:
    """Return the text of the module with a robot's settings. Everything from its file is written as literals.

    ``path`` is that of its MJCF, as in ``asset.file``. Without one the module is for ``--task_file``: it registers the
    robot's tasks, and its MJCF is next to it. ``is_fused`` says whether the fused step can simulate the robot.
    """
    cls = "".join(part.capitalize() for part in robot.name.split("_"))  # AnymalC for anymal_c
    penalized, two_legs = _penalized(robot), len(robot.legs) == 2
    stance, leverage = robot.stance, robot.source.weight * robot.stance.height
    relative = 1.0 if two_legs else SCALED_HEIGHT / stance.height
    return TEMPLATE.format(
        title=robot.name,
        imported=IMPORTED,
        file=ascii(robot.source.file.name),
        imports=(IMPORTS if path else OWN_IMPORTS) + (G1 if two_legs else ""),
        base="G1Cfg" if two_legs else "LeggedRobotCfg",
        cls=cls,
        path=_literal(path) if path else f'str(Path(__file__).with_name("{robot.name}.xml"))',
        engine="" if is_fused else ENGINE,
        foot=FOOT,
        penalized=_literal(penalized),
        terminating=_literal(penalized if two_legs else [TRUNK]),
        mirrored=_literal(robot.mirrored),
        speed=f"{robot.speed:.4g}" if "." in f"{robot.speed:.4g}" else f"{robot.speed:.1f}",
        drop=round(stance.drop, 2),
        angles=_literal(dict(zip(robot.joints, (stance.angles.round(3) + 0.0).tolist(), strict=True))),
        stiffness=_table(robot, stance.stiffness),
        damping=_table(robot, stance.damping),
        torque_scale=float(f"{TORQUE_SCALE * stance.load * relative:.2g}"),
        height=round(stance.height, 3),
        torques=LeggedRobotCfg.rewards.scales.torques * (WEIGHT_TIMES_HEIGHT / leverage) ** 2,
        action_scale=ACTION_SCALE[two_legs],
        two_legs=TWO_LEGS if two_legs else "",
        held=_literal(_held(robot) if two_legs else []),
        symmetry=SYMMETRY if robot.symmetric else "",
        registration="" if path else REGISTRATION.format(name=robot.name, cls=cls),
    )


def _penalized(robot: Robot) -> list[str]:
    """Return parts of names that match all geoms but feet and the legs' links next to the trunk."""
    geoms = {shape.name for found in robot.shapes.values() for shape in found}
    spared = {shape.name for leg in robot.legs if len(leg.bodies) > 2 for shape in robot.shapes[leg.bodies[0]]}
    spared |= {leg.foot.name for leg in robot.legs}
    parts = [TRUNK]
    for name in sorted(geoms - spared):
        leg = next((leg.name for leg in robot.legs if name.startswith(leg.name + "_")), "")
        part = name.removeprefix(leg).strip("_")
        if not any(known in name for known in parts):
            parts.append(name if any(part in other for other in spared) else part)
    return parts


def _held(robot: Robot) -> list[str]:
    """Return the kinds of joints that a two-legged robot holds; their names where kinds match those that it bends."""
    free = free_joints(robot.source.model, robot.legs)
    names, kinds = ([name for i, name in enumerate(found) if i not in free] for found in (robot.joints, robot.kinds))
    matches_free = any(kind in robot.joints[joint] for kind in kinds for joint in free)
    return list(dict.fromkeys(names if matches_free else kinds))


def _literal(value: str | list | dict) -> str:
    """Return texts, numbers, or lists or dictionaries of them as a Python literal in double quotes."""
    line = json.dumps(value, ensure_ascii=False)
    return line if len(line) < LINE else json.dumps(value, ensure_ascii=False, indent=4).replace("\n", "\n" + 8 * " ")


def _table(robot: Robot, values: np.ndarray) -> str:
    """Return numbers by the kinds of joints as a dictionary; one number if they are all the same.

    They are by the names of joints where those of legs have kinds in them, as leg1_2 has 1.
    """
    numbers = robot.by_kind(values)
    parts = sorted(zip(numbers, numbers, strict=True), key=lambda part: len(part[0]), reverse=True)
    joints = list(zip(robot.joints, robot.kinds, strict=True))
    if any(next(part for part, _ in parts if part in name) != kind for name, kind in joints):
        parts = sorted(joints, key=lambda part: len(part[0]), reverse=True)  # the first part that matches counts
    same = len(set(numbers.values())) == 1
    return str(numbers[parts[0][1]]) if same else _literal({part: numbers[kind] for part, kind in parts})
