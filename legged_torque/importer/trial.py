"""Trying out an imported robot: which engine simulates it, whether it stands, how it looks."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from legged_torque.sim.fused.tree import read_tree
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import loading
from legged_torque.utils.standing import Standing, hold_pose


def parse(text: str, file: Path) -> mujoco.MjModel:
    """Compile the MJCF written for a file, which a UserError names."""
    with loading(file):
        return mujoco.MjModel.from_xml_string(text)


def fused_problem(model: mujoco.MjModel) -> str:
    """Return why the fused step cannot simulate a model, and what to do; empty if it can."""
    try:
        read_tree(model)
    except UserError as error:
        return str(error)
    return ""


def stand(model: mujoco.MjModel, gains: np.ndarray, seconds: float = 5.0) -> tuple[Standing, mujoco.MjData]:
    """Hold the first keyframe by PD control; return how the robot stood, and the last state.

    ``gains`` are stiffness [N m/rad] and damping [N m s/rad] by joint. Shape: (2, joints).
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    stiffness, damping = gains
    return hold_pose(data, stiffness, damping, model.actuator_ctrlrange.T, seconds), data


def draw(data: mujoco.MjData, file: Path, size: tuple[int, int] = (640, 480)) -> None:
    """Write a picture of a state, seen by the camera ``track``; ``size`` is width and height in pixels."""
    from PIL import Image

    renderer = mujoco.Renderer(data.model, size[1], size[0])
    renderer.update_scene(data, camera="track")
    Image.fromarray(renderer.render()).save(file)
    renderer.close()
