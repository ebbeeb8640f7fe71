"""Writing the settings class of an imported robot."""

from __future__ import annotations

import json
from itertools import groupby

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.importer.pose import BANDWIDTH, DAMPING_RATIO, SAG
from legged_torque.importer.robot import FOOT, TRUNK, Robot

WEIGHT_TIMES_HEIGHT = 37.0  # of an A1 with its trunk at 0.303 m [N m]
DROP = 1.3  # height of the trunk at the start of an episode, as a multiple of the nominal one; as for the A1
TORQUE_SCALE = 0.12  # torque of an action of 1 as a share of the strongest motor's; as for the A1
LINE = 90  # most characters of a table in one line

TEMPLATE = '''"""{title}: imported settings; each number is a proposal to look at."""

# Source: {file}

from __future__ import annotations

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO


class {cls}Cfg(LeggedRobotCfg):
    """Settings of the robot; alone, of position control on a plane."""

    class asset:
        file = {path}
        foot_name = "{foot}"
        penalize_contacts_on = {penalized}
        terminate_after_contacts_on = ["{trunk}"]
        mirrored_legs = {mirrored}
        max_dof_vel = {speed}

{engine}    class init_state:
        pos = [0.0, 0.0, {drop}]
        default_joint_angles = (
{angles}
        )

    class control:  # {bandwidth:g} Hz with a leg's own inertia, {sag:g} rad under its weight; damping ratio {ratio:g}
        stiffness = {stiffness}
        damping = {damping}
        torque_scale = {torque_scale}

    class rewards:
        base_height_target = {height}

        class scales:
            torques = {torques:.2g}  # the A1's, as its squared torques are to this robot's: by weight times height


class {cls}CfgPPO(LeggedRobotCfgPPO):
    """Training of it."""
{symmetry}'''
ENGINE = """    class sim:
        engine = "mujoco_warp"  # slower; the fused step cannot simulate this robot

"""
SYMMETRY = """
    class algorithm:
        class symmetry_cfg:
            use_data_augmentation = True
"""


def settings(robot: Robot, path: str, is_fused: bool = True) -> str:
    """Return the text of the module with a robot's settings. Everything from its file is written as literals.

    ``path`` is that of its MJCF, as in ``asset.file``; ``is_fused`` says whether the fused step can simulate it.
    """
    stance, leverage = robot.stance, robot.source.weight * robot.stance.height
    return TEMPLATE.format(
        title=robot.name,
        file=ascii(robot.source.file.name),
        cls="".join(part.capitalize() for part in robot.name.split("_")),  # AnymalC for anymal_c
        path=_literal(path),
        engine="" if is_fused else ENGINE,
        foot=FOOT,
        trunk=TRUNK,
        penalized=_literal(_penalized(robot)),
        mirrored=_literal(robot.mirrored),
        speed=f"{robot.speed:.4g}" if "." in f"{robot.speed:.4g}" else f"{robot.speed:.1f}",
        drop=round(DROP * stance.height, 2),
        angles=_angles(robot),
        bandwidth=BANDWIDTH,
        sag=SAG,
        ratio=DAMPING_RATIO,
        stiffness=_table(robot.by_kind(stance.stiffness)),
        damping=_table(robot.by_kind(stance.damping)),
        torque_scale=float(f"{TORQUE_SCALE * max(robot.torques):.2g}"),
        height=round(stance.height, 3),
        torques=LeggedRobotCfg.rewards.scales.torques * (WEIGHT_TIMES_HEIGHT / leverage) ** 2,
        symmetry=SYMMETRY if robot.symmetric else "",
    )


def _penalized(robot: Robot) -> list[str]:
    """Return parts of names that match all geoms but feet and the links next to the trunk."""
    model = robot.source.model
    geoms = {shape.name for found in robot.shapes.values() for shape in found}
    first = {body for body in range(2, model.nbody) if model.body_parentid[body] == 1}
    spared = {s.name for body in first for s in robot.shapes[body] if len(robot.legs[0].bodies) > 2}
    spared |= {leg.foot.name for leg in robot.legs}
    parts = [TRUNK]
    for name in sorted(geoms - spared):
        leg = next((leg.name for leg in robot.legs if name.startswith(leg.name + "_")), "")
        part = name.removeprefix(leg).strip("_")
        if not any(known in name for known in parts):
            matches_spared = any(part in other for other in spared)
            parts.append(name if matches_spared else part)
    return parts


def _literal(value: str | list) -> str:
    """Return a text, or lists of texts, as a Python literal in double quotes."""
    return json.dumps(value, ensure_ascii=False)


def _table(numbers: dict[str, float]) -> str:
    """Return numbers by the kinds of joints as a dictionary; one number if they are all the same."""
    if len(set(numbers.values())) == 1:
        return str(next(iter(numbers.values())))
    ordered = sorted(numbers, key=len, reverse=True)  # the first part that matches counts
    entries = [f"{_literal(kind)}: {numbers[kind]}" for kind in ordered]
    line = "{" + ", ".join(entries) + "}"
    return line if len(line) < LINE else "{\n" + "".join(f"            {entry},\n" for entry in entries) + "        }"


def _angles(robot: Robot) -> str:
    """Return the lines of the nominal pose: dictionaries of up to three joints of a leg, joined."""
    rows: list[str] = []
    named = zip(robot.joints, robot.kinds, robot.stance.angles.tolist(), strict=True)
    for _, group in groupby(named, key=lambda each: each[0].removesuffix(each[1])):
        entries = [f"{_literal(joint)}: {round(angle, 3) + 0.0}" for joint, _, angle in group]
        rows += ["{" + ", ".join(entries[start : start + 3]) + "}" for start in range(0, len(entries), 3)]
    return "\n".join(f"            {'| ' if number else ''}{row}" for number, row in enumerate(rows))
