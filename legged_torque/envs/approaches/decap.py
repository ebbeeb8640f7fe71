"""Decaying action priors: PD torques lead the first torques of a policy (Sood et al., arXiv 2310.05714).

The reference are joint angles that a position policy has walked with, by ``control.decap.record``; docs/howto/python.md
writes such a file. None comes with this package: without it, the reference is the nominal pose.
"""

import csv
from collections.abc import Sequence

import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged_torque import resource_path
from legged_torque.envs.approaches.decap_config import DecapCfg as DecapCfg
from legged_torque.envs.base.actions import ActionTerm, of_joint
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.robot_checks import UNLIKE
from legged_torque.motors.kernel import read
from legged_torque.utils.errors import UserError, refuse, unknown_name


@wp.struct
class Decap:
    """Inputs of :func:`decap_torque`."""

    torque_scale: wp.array2d[float]
    p_gains: wp.array2d[float]
    d_gains: wp.array2d[float]
    reference: wp.array2d[float]
    bias: wp.array[float]


@wp.func
def decap_torque(decap: Decap, action: float, world: int, joint: int, pos: float, vel: float) -> float:
    """tau = scale a + bias (Kp (q_reference - q) - Kd qd) [N m]."""
    prior = decap.p_gains[world, joint] * (decap.reference[world, joint] - pos) - decap.d_gains[world, joint] * vel
    return of_joint(decap.torque_scale, world, joint) * action + decap.bias[0] * prior


class DecapRobot(LeggedRobot):
    """Torque control with a bias that decays: gamma^(t / k).

    Attributes:
        reference: Joint angles of the bias and of the imitation in this control step [rad]. Shape: (num_envs, num_dof).
        bias: Weight of the bias. Shape: (1,).
    """

    cfg: DecapCfg

    def _init_buffers(self) -> None:
        """Allocate reference and weight."""
        super()._init_buffers()
        self.reference = self.control.default_dof_pos.repeat(self.num_envs, 1)
        file = self.cfg.control.decap.record
        record = torch.tensor(read_angles(file, self.dof_names), device=self.device) if file else None
        self._record = self.reference[:1] if record is None else record
        if joints := self.symmetry.joints:
            for pair in filter(None, (joints.unlike(row, self.dof_names) for row in self._record.cpu().numpy())):
                self.symmetry.refuse(f"a row of control.decap.record has {pair}: {UNLIKE}")
        self.bias = torch.ones(1, device=self.device)
        self.update_curriculum()

    def action_terms(self) -> list[ActionTerm]:
        """Return one torque per joint, to which the bias is added."""
        control = self.control
        arrays = {"torque_scale": control.torque_scale, "p_gains": control.p_gains, "d_gains": control.d_gains}
        reads = read(Decap, **arrays, reference=self.reference, bias=self.bias)
        return [ActionTerm("biased_torque", control.torque_scale, "N m", "joint torque", decap_torque, reads)]

    def run_physics(self) -> None:
        """Move on in the record, which starts with each episode and is repeated."""
        rows = self.episode_length_buf * (self.dt / self.cfg.control.decap.row_time)
        self.reference.copy_(self._record[(rows + 1e-3).long() % len(self._record)])
        super().run_physics()

    def update_curriculum(self) -> None:
        """Let the bias decay."""
        decay = self.cfg.control.decap
        self.bias.copy_(decay.gamma ** (self.total_steps / decay.k))

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return the weight of the bias too."""
        return super().curriculum_values() | {"bias": self.bias[0]}

    def _reward_imitation_angles(self) -> Tensor:
        """exp(-imitation_temperature |q - q_reference|^2), joint angles [rad]. Shape: (num_envs,)."""
        error = (self.dof_pos - self.reference).square().sum(dim=1)
        return torch.exp(-self.cfg.rewards.imitation_temperature * error)


def read_angles(file: str, dof_names: Sequence[str]) -> np.ndarray:
    """Return the joint angles of a CSV file whose header has the joints' names [rad]. Shape: (rows, num_dof), float32.

    A UserError if it cannot be read, has other joints than these, or holds more than finite numbers.
    """
    path = resource_path(file)
    if not path.is_file():  # a device might never end
        raise UserError(f"cannot read '{file}': there is no such file")
    try:
        names, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
        refuse([str(unknown_name(f"joint in '{file}'", name, dof_names)) for name in names if name not in dof_names])
        if sorted(names) != sorted(dof_names):
            raise UserError(f"'{file}' must have each of these joints once: {', '.join(dof_names)}")
        angles = np.array(rows, dtype=np.float32).reshape(-1, len(names))
        if not len(angles) or not np.isfinite(angles).all():
            raise UserError(f"'{file}' must have rows of joint angles that are finite")
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"'{file}' is not a table of joint angles: {error}") from None
    return angles[:, [names.index(name) for name in dof_names]]
