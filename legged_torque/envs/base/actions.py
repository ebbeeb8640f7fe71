"""From actions to wanted torques: one term per block of actions, each with a control law of one joint."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.motors.config import by_joint
from legged_torque.motors.kernel import control_law, launch_law, read
from legged_torque.utils.errors import UserError
from legged_torque.utils.mirroring import Mirroring


class ControlParameters:
    """Constants of the control laws in all worlds, which may be drawn at random.

    Attributes:
        default_dof_pos: Nominal pose [rad]. Shape: (num_dof,).
        joint_offset: Errors of the target angles [rad]. Shape: (num_envs, num_dof).
        action_scale: Target angle per unit of an action [rad]. Shape: (num_envs, 1), or (num_envs, num_dof).
        torque_scale: Torque per unit of an action [N m]. Shape: (num_envs, 1), or (num_envs, num_dof).
        p_gains: Kp of PD control [N m/rad]. Shape: (num_envs, num_dof).
        d_gains: Kd of PD control [N m s/rad]. Shape: (num_envs, num_dof).
        torque_per_position: Torque scale in units of the action scale [N m/rad].
    """

    def __init__(
        self,
        control: type[LeggedRobotCfg.control],
        dof_names: Sequence[str],
        pose: Sequence[float],
        num_envs: int,
        device: str,
    ) -> None:
        """Take the numbers of the section ``control``, and the nominal pose [rad], for all worlds."""
        zeros = torch.zeros(num_envs, len(dof_names), device=device)
        self.default_dof_pos = torch.tensor(pose, dtype=torch.float32, device=device)
        self.joint_offset = zeros.clone()
        names = ("stiffness", "damping")
        gains = [by_joint(f"control.{name}", getattr(control, name), dof_names) for name in names]
        self.p_gains, self.d_gains = (zeros + torch.tensor(values, device=device) for values in gains)
        self.action_scale, self.torque_scale = zeros[:, :1] + control.action_scale, zeros[:, :1] + control.torque_scale
        self.torque_per_position = control.torque_scale / control.action_scale


@dataclass
class ActionTerm:
    """One action per joint, what it means, and the torque that it asks for.

    The kernel, torch, mirror images, ``policy.yaml``, its simulation in numpy, and the viewer all follow from here.
    """

    name: str  # what ``policy.yaml`` calls it: "position_residual" or "torque"
    scale: Tensor  # factor on the action, one per world. Shape: (num_envs, 1)
    unit: str  # of scale times action
    meaning: str  # what scale times action is
    law: Any = None  # Warp function ``(reads, action, world, joint, pos [rad], vel [rad/s]) -> torque [N m]``
    reads: Any = None  # instance of the Warp struct that the law reads
    weight: Tensor | None = None  # of its torques, a scalar on the device; None is 1
    interval: int = 1  # control steps for which its actions are held, from the start of an episode on
    is_unsigned: bool = False  # whether actions keep their signs in a mirror image
    whole_law: Any = None  # a law of all actions of a world, in place of the sum of the terms' laws

    def torques(self, actions: Tensor, pos: Tensor, vel: Tensor) -> Tensor:
        """Return the torques of this term without its weight [N m].

        Actions of this term alone, joint positions [rad] and velocities [rad/s]. Shapes: (num_envs, num_dof).
        """
        out = torch.empty_like(actions)
        launch_law(control_law([((self.law, self.reads), None)], actions.shape[1]), actions, pos, vel, out)
        return out


class ControlLaw:
    """The weighted sum of action terms.

    Attributes:
        terms: The terms.
        kernel: The Warp function of the sum, and what it reads, see :func:`~legged_torque.motors.kernel.control_law`;
            None if a term has no law, so that the task must compute torques itself.
    """

    def __init__(self, terms: Sequence[ActionTerm], num_dof: int) -> None:
        """Put terms together, each with one action per joint, in this order."""
        if not terms:
            raise UserError("action_terms() must return one term or more")
        self.terms, self.num_actions = list(terms), len(terms) * num_dof
        laws = [((term.law, term.reads), term.weight) for term in terms]
        whole = [(term.whole_law, term.reads) for term in terms if term.whole_law]
        if not whole and all(term.law for term in terms):
            whole = [control_law(laws, num_dof)]
        self.kernel = whole[0] if whole else None

    def mirrors(self, joints: Mirroring | None) -> list[tuple[str, Mirroring | None]]:
        """Return the mirror images of the actions by term, given that of joint angles; None where it is not known."""
        return [(term.name, joints.unsigned() if joints and term.is_unsigned else joints) for term in self.terms]

    def weights(self) -> Tensor:
        """Return the weight of each action's torques now, on the device. Shape: (num_actions,)."""
        size = self.num_actions // len(self.terms)
        weights = [term.scale.new_ones(()) if term.weight is None else term.weight for term in self.terms]
        return torch.stack(weights).repeat_interleave(size)

    def torques(self, actions: Tensor, pos: Tensor, vel: Tensor, out: Tensor) -> Tensor:
        """Write the torques that motors are asked for to ``out`` [N m], and return it.

        Shapes: (num_envs, num_actions), others (num_envs, num_dof); pos in rad, vel in rad/s. A UserError if a term has
        no law.
        """
        if not self.kernel:
            lacking = [term.name for term in self.terms if not term.law]
            raise UserError(f"the action term '{lacking[0]}' has no law, and no _compute_torques takes its place")
        launch_law(self.kernel, actions, pos, vel, out)
        return out


# ---- laws ----------------------------------------------------------------------------------------------------------


@wp.func
def of_joint(scales: wp.array2d[float], world: int, joint: int) -> float:
    """Return a joint's scale; a single column is for all joints, as where torch broadcasts."""
    return scales[world, wp.min(joint, scales.shape[1] - 1)]  # type: ignore[attr-defined]


@wp.struct
class PdControl:
    """Inputs of :func:`pd_torque`, see :class:`ControlParameters`."""

    default_dof_pos: wp.array[float]
    joint_offset: wp.array2d[float]
    action_scale: wp.array2d[float]
    p_gains: wp.array2d[float]
    d_gains: wp.array2d[float]


@wp.func
def pd_target(pd: PdControl, action: float, world: int, joint: int) -> float:
    """q_nominal + scale a [rad]."""
    target = pd.default_dof_pos[joint] + pd.joint_offset[world, joint]
    return target + of_joint(pd.action_scale, world, joint) * action


@wp.func
def pd_torque(pd: PdControl, action: float, world: int, joint: int, pos: float, vel: float) -> float:
    """tau = Kp (q_nominal + scale a - q) - Kd qd [N m] (eq. 8)."""
    error = pd_target(pd, action, world, joint) - pos
    return pd.p_gains[world, joint] * error - pd.d_gains[world, joint] * vel


@wp.struct
class TorqueControl:
    """Inputs of :func:`scaled_torque`."""

    torque_scale: wp.array2d[float]


@wp.func
def scaled_torque(control: TorqueControl, action: float, world: int, joint: int, pos: float, vel: float) -> float:
    """tau = scale a [N m] (section III)."""
    return of_joint(control.torque_scale, world, joint) * action


def position_residual(control: ControlParameters, weight: Tensor | None = None) -> ActionTerm:
    """Return the term of PD targets (eq. 8); ``weight`` as of :class:`ActionTerm`."""
    names = ("default_dof_pos", "joint_offset", "action_scale", "p_gains", "d_gains")
    reads = read(PdControl, **{name: getattr(control, name) for name in names})
    meaning = "joint position relative to nominal_pose, for PD control"
    return ActionTerm("position_residual", control.action_scale, "rad", meaning, pd_torque, reads, weight)


def torque(control: ControlParameters, weight: Tensor | None = None) -> ActionTerm:
    """Return the term of joint torques; ``weight`` as of :class:`ActionTerm`."""
    reads = read(TorqueControl, torque_scale=control.torque_scale)
    return ActionTerm("torque", control.torque_scale, "N m", "joint torque", scaled_torque, reads, weight)
