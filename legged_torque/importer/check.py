"""Whether an imported robot stands on its feet."""

import mujoco
import numpy as np

from legged_torque.importer.legs import FOOT
from legged_torque.importer.robot import Robot
from legged_torque.utils.standing import hold_pose

SECONDS = 5.0  # for which the nominal pose is held [s]
LEAST_SHARE = 0.9  # of the contact force on the feet of a robot that stands on them
MOST_TILT = np.radians(10.0)  # of its trunk [rad]


def check(robot: Robot, data: mujoco.MjData) -> str:
    """Hold the nominal pose of a robot by PD control in plain MuJoCo; return how it went, in a line.

    ``data`` is that of the robot's MJCF, and becomes the last state. A UserError if the simulation diverges.
    """
    model = data.model
    mujoco.mj_resetDataKeyframe(model, data, 0)
    stiffness, damping = robot.gains()
    result = hold_pose(data, stiffness, damping, model.actuator_ctrlrange.T, SECONDS)
    mujoco.mj_forward(model, data)
    on_feet, total, others, force = 0.0, 0.0, dict[str, None](), np.zeros(6)
    for place, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, place, force)
        name = model.geom(int(contact.geom.max())).name  # the floor is the first geom
        total += force[0]
        on_feet += force[0] * (FOOT in name)
        others |= {} if FOOT in name else {name: None}
    problems = []
    if not result.fall and on_feet < LEAST_SHARE * total:
        problems.append(f"{on_feet / total:.0%} of the contact force is on its feet")
    if not result.fall and others:
        problems.append(f"it stands on {', '.join(others)}")
    if not result.fall and result.tilt > MOST_TILT:
        problems.append(f"its trunk is tilted by {np.degrees(result.tilt):.0f} degrees")
    return f"IT DOES NOT STAND ON ITS FEET: {'; '.join(problems)}. {result}" if problems else str(result)
