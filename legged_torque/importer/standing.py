"""Whether an imported robot stands: its nominal pose held under PD, in MuJoCo itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from legged_torque.sim.fused.tree import read_tree
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import loading

FALLEN = 0.5  # of the nominal height: lower, the trunk has come down
TILTED = 0.5  # [rad]


@dataclass
class Standing:
    """How a robot stood."""

    height: float  # [m] of the trunk at the end
    nominal: float  # [m] of the trunk in the nominal pose
    tilt: float  # [rad] of the trunk at the end
    error: float  # [rad] largest distance of a joint from its nominal angle in the second half
    joint: str  # the joint of that error
    saturated: float  # share of torques at their limits
    drift: float  # [m] horizontally

    @property
    def stands(self) -> bool:
        """Whether the trunk is up, upright and still a number."""
        return bool(self.height > FALLEN * self.nominal and self.tilt < TILTED)

    def __str__(self) -> str:
        """Say it in a line."""
        verdict = "it stands" if self.stands else "IT FELL"
        degrees = np.degrees(self.tilt)
        return (
            f"{verdict}: trunk at {self.height:.3f} m ({self.nominal:.3f} m nominal), tilted {degrees:.1f} degrees, "
            f"moved {100 * self.drift:.1f} cm; largest joint error {self.error:.3f} rad ({self.joint}); "
            f"{self.saturated:.1%} of torques at their limits"
        )


def measure(
    model: mujoco.MjModel, stiffness: np.ndarray, damping: np.ndarray, seconds: float = 5.0
) -> tuple[Standing, mujoco.MjData]:
    """Hold the nominal pose, the first keyframe, under PD; return how it went and the last state.

    Motors must be in the order of joints and have ``ctrlrange``. Gains [N m/rad, N m s/rad] are by joint.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    target, place = data.qpos[7:].copy(), data.qpos[:3].copy()
    steps = round(seconds / model.opt.timestep)
    worst, saturated = np.zeros(model.nu), 0.0
    for step in range(steps):
        torques = stiffness * (target - data.qpos[7:]) - damping * data.qvel[6:]
        data.ctrl[:] = np.clip(torques, *model.actuator_ctrlrange.T)
        saturated += float((data.ctrl != torques).mean()) / steps
        mujoco.mj_step(model, data)
        if step >= steps // 2:
            worst = np.maximum(worst, np.abs(data.qpos[7:] - target))
    up = 1 - 2 * float(data.qpos[4] ** 2 + data.qpos[5] ** 2)
    result = Standing(
        height=float(data.qpos[2]),
        nominal=float(place[2]),
        tilt=float(np.arccos(np.clip(up, -1, 1))),
        error=float(worst.max()),
        joint=model.joint(int(worst.argmax()) + 1).name,
        saturated=saturated,
        drift=float(np.linalg.norm(data.qpos[:2] - place[:2])),
    )
    return result, data


def draw(model: mujoco.MjModel, data: mujoco.MjData, file: Path, size: tuple[int, int] = (640, 480)) -> None:
    """Write a picture of a state as its camera ``track`` sees it."""
    from PIL import Image

    renderer = mujoco.Renderer(model, size[1], size[0])
    renderer.update_scene(data, camera="track")
    Image.fromarray(renderer.render()).save(file)
    renderer.close()


def parse(text: str, file: Path) -> mujoco.MjModel:
    """Return the model of the text of a MJCF that was made of a file, which an error names."""
    with loading(file):
        return mujoco.MjModel.from_xml_string(text)


def fused_problem(model: mujoco.MjModel) -> str:
    """Return why the fused step cannot simulate a model and what to do, "" if it can."""
    try:
        read_tree(model)
    except UserError as error:
        return str(error)
    return ""
