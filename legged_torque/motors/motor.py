"""The interface of motor models, and the joints that they drive."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from legged_torque.motors.config import MotorCfg, by_joint
from legged_torque.sim.randomization import RandomParameter
from legged_torque.utils.buffers import Buffers
from legged_torque.utils.errors import UserError


@dataclass(frozen=True)
class Joints:
    """The joints of all worlds, and the clock of their motors."""

    names: list[str]
    torque_limits: Tensor  # lowest and highest torques [N m]. Shape: (2, num_dof)
    armature: Tensor  # reflected inertia of the rotors [kg m^2]. Shape: (num_dof,)
    actions: Tensor  # the newest actions, written before each control step. Shape: (num_envs, num_actions)
    dt: float  # physics step [s]
    decimation: int  # physics steps per control step
    nominal_pose: Tensor  # [rad]. Shape: (num_dof,)
    gains: tuple[Tensor, Tensor]  # Kp [N m/rad] and Kd [N m s/rad] of PD control. Shapes: (num_envs, num_dof)
    section: str = "motors"  # path of the settings of the link that is built

    @property
    def num_envs(self) -> int:
        """Number of worlds."""
        return len(self.actions)

    @property
    def device(self) -> str:
        """Device of all tensors."""
        return str(self.actions.device)

    def values(self, setting: str, values: float | dict[str, float]) -> Tensor:
        """Return a setting's numbers by joint; errors of :func:`by_joint`. Shape: (num_dof,)."""
        return torch.tensor(by_joint(setting, values, self.names), device=self.device)


class Motor(Buffers):
    """One link of the chain from the policy to the joints: a model of a motor, a delay, a limit.

    A model is a subclass with :meth:`apply`, and a section of settings whose ``build`` makes it, named in
    ``motors.chain``. It may name a Warp function, :attr:`kernel`; if all links do, one kernel computes the torques of a
    physics step. What it keeps from step to step is made by :meth:`~legged_torque.utils.buffers.Buffers.buffer`, and
    then part of checkpoints.
    """

    acts_on: ClassVar[str] = "torques"
    """"torques", those that the control law asks for, "actions", before the control law sees them, or "measurements".

    The last is for a single link with a method ``measured``, see :class:`~legged_torque.motors.models.EncoderModel`.
    """
    kernel: ClassVar[Any] = None
    """A Warp function that does the same as :meth:`apply` for one joint of one world.

    Of torques: ``(reads, world, joint, substep, wanted, pos, vel) -> torque [N m]``, where ``reads`` is the struct that
    :meth:`kernel_reads` returns. Of actions: ``(reads, world, substep) -> row of actions``. Of measurements: ``(reads,
    world, joint, pos, vel) -> wp.vec2`` of both.
    """

    lost: Tensor | None = None
    """What friction took from the torques in the last physics step [N m], for metrics. Shape: (num_envs, num_dof)."""

    def __init__(self, cfg: MotorCfg, joints: Joints) -> None:
        """Create the motors of all worlds."""
        super().__init__(joints.num_envs, joints.device)
        self.cfg, self.joints = cfg, joints

    def send(self, actions: Tensor) -> None:
        """Take the actions of a new control step, before its physics steps. Shape: (num_envs, num_actions)."""

    def finish_step(self) -> None:
        """Sum up a control step after its physics steps; torch only, so that it can be compiled."""

    def apply(self, wanted: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the torques that come out of this link [N m]; runs at every physics step, inside a CUDA graph.

        Args:
            wanted: Torques that come in [N m]. Of links that act on actions: nothing is read, actions are returned.
            pos: Joint positions [rad]. Shapes: (num_envs, num_dof).
            vel: Joint velocities [rad/s].
            substep: Number of the physics step within the control step.
        """
        raise UserError(f"{type(self).__name__} has no apply")

    def kernel_reads(self) -> Any:
        """Return what :attr:`kernel` reads: an instance of the Warp struct of its first parameter."""
        raise UserError(f"{type(self).__name__} names a kernel without kernel_reads")

    def reset(self, mask: Tensor) -> None:
        """Forget what belongs to episodes that have ended. Shape: (num_envs,), bool."""

    def random_parameters(self) -> list[RandomParameter]:
        """Return what is drawn of these motors, at resets and at random or at resets alone."""
        return []

    def describe(self) -> dict[str, Any]:
        """Return the constants of this link for ``policy.yaml``, plain values: those of its settings."""
        return self.cfg.describe()
