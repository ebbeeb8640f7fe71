"""Writing the MJCF of an imported robot."""

import re
from pathlib import Path

import mujoco
import numpy as np

from legged_torque.importer.legs import FOOT
from legged_torque.importer.robot import Robot
from legged_torque.importer.source import balanced
from legged_torque.utils.mjcf import loading

SCENE = Path(__file__).with_name("scene.xml")  # everything but the robot's own parts
COMMENT = """{name}: written by scripts/import_robot.py. Its geoms touch the floor and never each other.
     Source: {file}
     Changes:
{notes}"""
DISTANCE, ELEVATION = 2.5, 1.0  # of the camera along x and -y, and over the trunk; in heights of the trunk


def mjcf(robot: Robot) -> tuple[str, mujoco.MjModel]:
    """Return the text of a robot's MJCF, with the changes to its source in a comment, and its model.

    Numbers have six digits. A UserError if MuJoCo refuses the text or warns of it.
    """
    model, height = robot.source.model, robot.stance.height
    spec = mujoco.MjSpec.from_file(str(SCENE))
    spec.modelname = robot.name
    spec.stat.center, spec.stat.extent = [0.0, 0.0, round(0.8 * height, 3)], round(2.3 * height, 3)
    trunk = spec.worldbody.first_body()
    trunk.pos = [0.0, 0.0, height]
    spec.camera("track").pos = np.round([DISTANCE * height, -DISTANCE * height, ELEVATION * height], 2)
    bodies = {1: trunk}
    for number in range(2, model.nbody):
        parent = bodies[int(model.body_parentid[number])]
        bodies[number] = parent.add_body(pos=model.body_pos[number], quat=model.body_quat[number])
        joint = int(model.body_jntadr[number])
        dof, address, place = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint]), joint - 1
        bodies[number].add_joint(
            name=robot.joints[place],
            pos=model.jnt_pos[joint],
            axis=model.jnt_axis[joint],
            range=robot.ranges[place],
            armature=robot.stance.armature[place],
            stiffness=model.jnt_stiffness[joint],
            damping=model.dof_damping[dof],
            frictionloss=model.dof_frictionloss[dof],
            ref=model.qpos0[address],
            springref=model.qpos_spring[address],
        )
    for number, body in bodies.items():
        body.name = model.body(number).name or robot.shapes[number][0].name
        body.mass, body.inertia = model.body_mass[number], balanced(model.body_inertia[number])
        body.ipos, body.iquat, body.explicitinertial = model.body_ipos[number], model.body_iquat[number], True
        for shape in robot.shapes[number]:
            default = spec.find_default("foot" if shape.name.endswith(FOOT) else "main")
            kind = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}")
            geom = body.add_geom(default, name=shape.name, type=kind, pos=shape.pos)
            geom.size[: len(shape.size)] = shape.size
            if shape.kind != "sphere":
                geom.quat = shape.quat
    for name, limit in zip(robot.joints, robot.torques, strict=True):
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.ctrlrange = motor.forcerange = [-limit, limit]
    spec.add_key(name="home", qpos=[0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0, *robot.stance.angles])
    spec.compile()
    notes = "\n".join(f"       - {note}" for note in robot.source.notes)
    comment = COMMENT.format(name=robot.name, file=ascii(robot.source.file.name), notes=notes)
    text = f"<!-- {re.sub('-(?=-)', '- ', comment)} -->\n{spec.to_xml()}"  # XML forbids two dashes in a comment
    with loading(robot.source.file):
        return text, mujoco.MjModel.from_xml_string(text)
