"""Writing the MJCF of an imported robot."""

from __future__ import annotations

import re
from collections.abc import Iterable

import mujoco

from legged_torque.importer.robot import FOOT, Robot
from legged_torque.importer.shapes import Shape

HEAD = """<!-- {title}: written by scripts/import_robot.py.
     Source: {file}
     Changes:
{notes} -->
<mujoco model="{name}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005" solver="Newton" cone="pyramidal" integrator="implicitfast" impratio="100"/>
  <statistic center="0 0 {center}" extent="{extent}"/>
  <visual>
    <global offwidth="1920" offheight="1080" azimuth="140" elevation="-18"/>
    <headlight ambient="0.3 0.3 0.3" diffuse="0.3 0.3 0.3" specular="0.1 0.1 0.1"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.36 0.50 0.68" rgb2="0.92 0.94 0.96" width="512"
             height="3072"/>
    <texture name="floor" type="2d" builtin="checker" rgb1="0.52 0.56 0.61" rgb2="0.46 0.50 0.55" mark="edge"
             markrgb="0.66 0.70 0.74" width="512" height="512"/>
    <material name="floor" texture="floor" texrepeat="2 2" texuniform="true" specular="0.1"/>
    <material name="body" rgba="0.60 0.62 0.65 1" specular="0.5"/>
    <material name="rubber" rgba="0.05 0.05 0.05 1" specular="0.1"/>
  </asset>
  <default>
    <!-- One bit on the floor, one on the robot: the robot meets the floor and never itself. -->
    <geom group="1" contype="0" conaffinity="1" condim="3" friction="1.0 0.005 0.0001" solref="-1000 -80"
          material="body"/>
    <default class="foot">
      <geom priority="1" material="rubber"/>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05" material="floor" contype="1" conaffinity="0"/>
"""
CAMERA = """{pad}<light name="sun" mode="trackcom" pos="1 -1 4" dir="-0.25 0.25 -1" cutoff="89" exponent="0"/>
{pad}<camera name="track" mode="trackcom" pos="{x} -{x} {z}" xyaxes="0.7071 0.7071 0 -0.2126 0.2126 0.9537" fovy="40"/>
"""


def _numbers(values: Iterable[float]) -> str:
    """Return numbers as MJCF, to nine digits; what is as good as 0 is 0."""
    return " ".join(f"{0.0 if abs(value) < 1e-12 else value:.9g}" for value in values)


def _comment(text: str) -> str:
    """Return a text without the end of a comment, which XML forbids inside of one."""
    return re.sub("-(?=-)", "- ", text)


def mjcf(robot: Robot) -> str:
    """Return the text of a robot's MJCF."""
    model, height = robot.source.model, robot.stance.height
    notes = "\n".join(f"       - {_comment(note)}" for note in robot.notes)
    head = HEAD.format(
        title=robot.name,
        name=robot.name,
        file=_comment(ascii(robot.source.file.name)),
        notes=notes,
        center=_numbers([round(0.8 * height, 3)]),
        extent=_numbers([round(2.3 * height, 3)]),
    )
    motors = [
        f'    <motor name="{joint}" joint="{joint}" ctrlrange="{_numbers([-limit, limit])}" '
        f'forcerange="{_numbers([-limit, limit])}"/>\n'
        for joint, limit in zip(robot.joints, robot.torques, strict=True)
    ]
    pose = _numbers([0, 0, height, 1, 0, 0, 0, *robot.stance.angles.round(4)])
    return (
        f"{head}{_body(robot, model, 1, 4)}  </worldbody>\n  <actuator>\n{''.join(motors)}  </actuator>\n"
        f'  <keyframe>\n    <key name="home" qpos="{pose}"/>\n  </keyframe>\n</mujoco>\n'
    )


def _body(robot: Robot, model: mujoco.MjModel, body: int, indent: int) -> str:
    """Return the text of a body and all that hangs on it."""
    pad, inner = " " * indent, " " * (indent + 2)
    name = model.body(body).name or robot.shapes[body][0].name
    quat = model.body_quat[body]
    pos = [0, 0, robot.stance.height] if body == 1 else model.body_pos[body]
    turned = "" if body == 1 or abs(quat[0]) > 1 - 1e-12 else f' quat="{_numbers(quat)}"'
    lines = [f'{pad}<body name="{name}" pos="{_numbers(pos)}"{turned}>\n']
    lines.append(
        f'{inner}<inertial pos="{_numbers(model.body_ipos[body])}" quat="{_numbers(model.body_iquat[body])}" '
        f'mass="{_numbers([model.body_mass[body]])}"\n{inner}          '
        f'diaginertia="{_numbers(model.body_inertia[body])}"/>\n'
    )
    if body == 1:
        size = 2.5 * robot.stance.height
        lines.append(f'{inner}<freejoint name="root"/>\n')
        lines.append(CAMERA.format(pad=inner, x=_numbers([round(size, 2)]), z=_numbers([round(0.4 * size, 2)])))
    else:
        lines.append(f"{inner}{_joint(robot, model, body)}\n")
    lines += [f"{inner}{_geom(shape)}\n" for shape in robot.shapes[body]]
    children = [child for child in range(2, model.nbody) if model.body_parentid[child] == body]
    lines += [_body(robot, model, child, indent + 2) for child in children]
    return "".join(lines) + f"{pad}</body>\n"


def _joint(robot: Robot, model: mujoco.MjModel, body: int) -> str:
    """Return the text of the joint of a body."""
    joint = int(model.body_jntadr[body])
    place, dof = joint - 1, int(model.jnt_dofadr[joint])
    pos = f' pos="{_numbers(model.jnt_pos[joint])}"' if model.jnt_pos[joint].any() else ""
    others = {"stiffness": model.jnt_stiffness[joint], "damping": model.dof_damping[dof]}
    others |= {"frictionloss": model.dof_frictionloss[dof], "ref": model.qpos0[model.jnt_qposadr[joint]]}
    if model.jnt_stiffness[joint]:
        others["springref"] = model.qpos_spring[model.jnt_qposadr[joint]]
    extra = "".join(f' {name}="{_numbers([value])}"' for name, value in others.items() if value)
    return (
        f'<joint name="{robot.joints[place]}"{pos} axis="{_numbers(model.jnt_axis[joint])}" '
        f'range="{_numbers(robot.ranges[place])}" armature="{_numbers([robot.stance.armature[place]])}"{extra}/>'
    )


def _geom(shape: Shape) -> str:
    """Return the text of a shape."""
    kind = ' class="foot"' if shape.name.endswith(FOOT) else ""
    quat = "" if shape.kind == "sphere" else f' quat="{_numbers(shape.quat)}"'
    return (
        f'<geom name="{shape.name}"{kind} type="{shape.kind}" size="{_numbers(shape.size)}" '
        f'pos="{_numbers(shape.pos)}"{quat}/>'
    )
