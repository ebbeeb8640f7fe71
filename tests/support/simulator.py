"""Sensed geoms of the A1 and their contacts by hand."""

import mujoco
import numpy as np

LEGS = ("FR", "FL", "RR", "RL")
SENSED = ["trunk", *(f"{leg}_{part}" for leg in LEGS for part in ("hip", "thigh", "calf", "foot"))]
"""Columns of the contact buffers: all collision geoms of the robot in the order of the XML."""
WEIGHT = 12.453 * 9.81


def contacts_by_hand(model, data):
    """Number of contacts with the floor and net world force of each sensed geom, from MuJoCo's list of contacts."""
    found, force, wrench = np.zeros(len(SENSED)), np.zeros((len(SENSED), 3)), np.zeros(6)
    for i, contact in enumerate(data.contact):
        first, second = (model.geom(geom).name for geom in contact.geom)
        assert first == "floor"
        if second in SENSED:
            mujoco.mj_contactForce(model, data, i, wrench)
            found[SENSED.index(second)] += 1
            force[SENSED.index(second)] += contact.frame.reshape(3, 3).T @ wrench[:3]
    return found, force
