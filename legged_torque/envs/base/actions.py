"""What actions mean: one term per block of actions, one action of each term per joint."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass
class ActionTerm:
    """One action per joint; mirrored as the joints are.

    ``_compute_torques`` says what is done with it. Sizes, mirror images, ``policy.yaml`` and plots follow from here.
    """

    name: str  # what ``policy.yaml`` calls it: "position_residual" or "torque"
    scale: Tensor  # factor on the action, one per world. Shape: (num_envs, 1)
    unit: str  # of scale times action
    meaning: str  # what scale times action is
    weight: Tensor | None = None  # of its torques, a scalar on the device; None is 1
    interval: int = 1  # control steps for which its actions are held, from the start of an episode on


def position_residual(scale: Tensor, weight: Tensor | None = None) -> ActionTerm:
    """Return the term of PD targets (eq. 8); for the arguments see :class:`ActionTerm`."""
    meaning = "joint position relative to nominal_pose, for PD control"
    return ActionTerm("position_residual", scale, "rad", meaning, weight)


def torque(scale: Tensor, weight: Tensor | None = None) -> ActionTerm:
    """Return the term of joint torques; for the arguments see :class:`ActionTerm`."""
    return ActionTerm("torque", scale, "N m", "joint torque", weight)
