"""The criterion of a standing robot, and holding a robot's pose under PD control in plain MuJoCo."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import mujoco
import numpy as np

from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import kept_warnings

LEAST_HEIGHT = 0.5  # of a standing robot's trunk, as a share of its height in the nominal pose
MOST_TILT = 0.5  # of a standing robot's trunk [rad]

Values: TypeAlias = Any  # a number, a numpy array or a tensor


def stands(height: Values, nominal_height: float, tilt: Values) -> Values:
    """Return whether a trunk is neither too low nor too tilted for a standing robot; NaN is not standing.

    Args:
        height: Height of the trunk above the ground [m].
        nominal_height: The same in the nominal pose [m].
        tilt: Angle between the trunk's vertical axis and that of the world [rad], of the shape of ``height``.
    """
    return (height > LEAST_HEIGHT * nominal_height) & (tilt < MOST_TILT)


@dataclass
class Standing:
    """How a robot stood until the time was over or it fell."""

    fall: str  # when and how it fell; empty if it stands
    nominal: float  # height of the trunk in the beginning [m]
    height: float  # of the trunk in the end [m]
    tilt: float  # of the trunk in the end [rad]
    drift: float  # of the trunk, horizontally [m]
    error: float  # largest distance of a joint from its angle in the second half of the time; 0 before [rad]
    joint: str  # the joint of that error
    saturated: float  # share of torques at their limits

    def __str__(self) -> str:
        """Return a line."""
        errors = f"; largest joint error {self.error:.3f} rad ({self.joint})"
        return (
            f"{f'IT FELL {self.fall}' if self.fall else 'it stands'}: trunk at {self.height:.3f} m "
            f"({self.nominal:.3f} m nominal), tilted {np.degrees(self.tilt):.1f} degrees, moved "
            f"{100 * self.drift:.1f} cm{'' if self.fall else errors}; {self.saturated:.1%} of torques at their limits"
        )


def hold_pose(
    data: mujoco.MjData,
    stiffness: np.ndarray,
    damping: np.ndarray,
    limits: np.ndarray,
    seconds: float,
    *,
    every: int = 1,
    may_not_touch: Sequence[int] = (),
) -> Standing:
    """Hold the joint angles of a state by PD control, until the time is over or the robot falls.

    Args:
        data: Initial state, which becomes the last one. Motors must be in the order of joints, controls their torques.
        stiffness: Gains [N m/rad]. Shape: (joints,).
        damping: Gains [N m s/rad]. Shape: (joints,).
        limits: Lowest and highest torques [N m]. Shape: (2, joints).
        seconds: Time to stand [s].
        every: Physics steps between new torques.
        may_not_touch: Geoms whose contact with anything is a fall.

    Raises:
        UserError: If the simulation diverges.
    """
    model, place, pose = data.model, data.qpos[:3].copy(), data.qpos[7:].copy()
    steps = round(seconds / model.opt.timestep)
    errors, saturated, fall = np.zeros(model.nu), list[float](), ""
    with kept_warnings():
        for step in range(steps):
            if step % every == 0:
                wanted = stiffness * (pose - data.qpos[7:]) - damping * data.qvel[6:]
                data.ctrl[:] = np.clip(wanted, *limits)
                saturated.append(float((data.ctrl != wanted).mean()))
            mujoco.mj_step(model, data)
            if any(warning.number for warning in data.warning):
                raise UserError("the simulation diverges under PD control: check masses, gains and the time step")
            if step >= steps // 2:
                errors = np.maximum(errors, np.abs(data.qpos[7:] - pose))
            height, upright = float(data.qpos[2]), 1.0 - 2.0 * (data.qpos[4] ** 2 + data.qpos[5] ** 2)
            tilt = float(np.arccos(np.clip(upright, -1.0, 1.0)))  # between the trunk's z axis and the vertical
            touching = np.intersect1d(data.contact.geom, may_not_touch)
            if touching.size:
                fall = f"'{model.geom(int(touching[0])).name}' touches the ground"
            elif not stands(height, place[2], tilt):
                sunk = f"has sunk from {place[2]:.2f} to {height:.2f} m"
                fall = f"the trunk {sunk if tilt < MOST_TILT else f'is tilted by {tilt:.2f} rad'}"
            if fall:
                fall = f"after {(step + 1) * model.opt.timestep:.2f} s {fall}"
                break
    return Standing(
        fall=fall,
        nominal=float(place[2]),
        height=height,
        tilt=tilt,
        drift=float(np.linalg.norm(data.qpos[:2] - place[:2])),
        error=float(errors.max()),
        joint=model.joint(int(errors.argmax()) + 1).name,
        saturated=float(np.mean(saturated)),
    )
