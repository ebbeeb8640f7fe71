"""Torques that are wrong in a way that depends on the state: a perturbation in torque space, for trainings."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_torque.motors.config import PerturbationCfg
from legged_torque.motors.kernel import read
from legged_torque.motors.motor import Joints, Motor
from legged_torque.sim.randomization import RandomParameter


@wp.struct
class Perturbation:
    """Inputs of :func:`perturbed_torque`, see :class:`TorquePerturbation`."""

    most: float
    offset: wp.array2d[float]
    of_pos: wp.array2d[float]
    of_vel: wp.array2d[float]


@wp.func
def perturbed_torque(
    motors: Perturbation, world: int, joint: int, substep: int, wanted: float, pos: float, vel: float
) -> float:
    """Return the torque plus most tanh(offset + of_pos q + of_vel qd)."""
    state = motors.offset[world, joint] + motors.of_pos[world, joint] * pos + motors.of_vel[world, joint] * vel
    return wanted + motors.most * wp.tanh(state)


class TorquePerturbation(Motor):
    """Adds a bounded random function of each joint's state to its torque, another one in every episode.

    After torque space perturbation (Cha et al., arXiv 2504.06585), where a random network sees the whole state, and
    ERFI, where an offset and white noise are added. Here each joint has a neuron of its own, without noise.

    Attributes:
        offset, of_pos, of_vel: Weights, uniform from -1 to 1 times the settings [1, 1/rad, s/rad], drawn at resets.
            Shapes: (num_envs, num_dof).
    """

    kernel = perturbed_torque
    cfg: PerturbationCfg

    def __init__(self, cfg: PerturbationCfg, joints: Joints) -> None:
        """Allocate the weights."""
        super().__init__(cfg, joints)
        shape = len(joints.names)
        self.offset, self.of_pos, self.of_vel = (self.buffer(name, shape) for name in ("offset", "of_pos", "of_vel"))

    def apply(self, wanted: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the perturbed torques."""
        return wanted + self.cfg.most * torch.tanh(self.offset + self.of_pos * pos + self.of_vel * vel)

    def kernel_reads(self) -> Any:
        """Return the weights and the largest perturbation."""
        return read(Perturbation, most=self.cfg.most, offset=self.offset, of_pos=self.of_pos, of_vel=self.of_vel)

    def describe(self) -> dict[str, Any]:
        """Return nothing: no exported policy has it."""
        return {}

    def random_parameters(self) -> list[RandomParameter]:
        """Return the weights, one draw per joint and world."""
        cfg, joints = self.cfg, range(self.offset.shape[1])
        widths = {"offset": cfg.offset, "of_pos": cfg.of_pos, "of_vel": cfg.of_vel}
        fields = {"offset": self.offset, "of_pos": self.of_pos, "of_vel": self.of_vel}
        return [
            RandomParameter(f"torque_{name}", fields[name], joints, {"set": [-width, width]}, at_reset_only=True)
            for name, width in widths.items()
        ]
