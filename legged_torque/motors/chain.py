"""The chain of links from the policy's actions to the torques of the joints."""

import dataclasses
from typing import Any

import torch
from torch import Tensor

from legged_torque.motors.config import MotorCfg, check_single
from legged_torque.motors.kernel import Part, TorqueKernel, joint_torque, newest_actions
from legged_torque.motors.motor import Joints, Motor
from legged_torque.sim.randomization import RandomParameter
from legged_torque.utils.buffers import check_tensor
from legged_torque.utils.errors import UserError, check_names


class MotorChain:
    """Links in the order of ``motors.chain``: first one that acts on actions, if any, then those that act on torques.

    Between them the control law computes the desired torques, which are multiplied by the strength of the motors.

    Attributes:
        links: The links by name.
        encoder: The link that acts on measurements; None if they are exact.
        strength: Factors on the desired torques, drawn at random. Shape: (num_envs, num_dof).
    """

    def __init__(self, settings: Any, joints: Joints) -> None:
        """Build the links of a section ``motors`` of settings.

        A UserError names a link without a section, one that occurs twice, one of actions behind one of torques, and
        several of actions or of measurements.
        """
        known = [name for name, value in vars(settings).items() if isinstance(value, MotorCfg)]
        self.links: dict[str, Motor] = {}
        for name in settings.chain:
            check_names("motors.chain", [name], known)
            if name in self.links:
                raise UserError(f"motors.chain has the link '{name}' twice; give the second one a section of its own")
            own = dataclasses.replace(joints, section=f"motors.{name}")
            self.links[name] = link = getattr(settings, name).build(own)
            if not isinstance(link, Motor):
                raise UserError(f"motors.{name}.build must return a Motor, not {link}")
            check_names(f"acts_on of {type(link).__name__}", [link.acts_on], ("actions", "torques", "measurements"))
            link.hold_tensors()
        self._of_actions, self._behind_law = (
            [link for link in self.links.values() if (link.acts_on == "actions") == early] for early in (True, False)
        )
        early = [name for name, link in self.links.items() if link in self._of_actions]
        check_single("motors.chain", "link that acts on actions", early)
        encoders = {name: link for name, link in self.links.items() if link.acts_on == "measurements"}
        check_single("motors.chain", "encoder", list(encoders))
        self.encoder: Any = next(iter(encoders.values()), None)
        if list(self.links.values()) != [*self._of_actions, *self._behind_law]:
            raise UserError(f"motors.chain must have links that act on actions first, not {', '.join(self.links)}")
        self.strength = torch.ones(joints.num_envs, len(joints.names), device=joints.device)
        self._actions = joints.actions

    def send(self, actions: Tensor) -> None:
        """Take the actions of a new control step. Shape: (num_envs, num_actions)."""
        for link in self.links.values():
            link.send(actions)

    def finish_step(self) -> None:
        """Sum up a control step after its physics steps; torch only."""
        for link in self.links.values():
            link.finish_step()

    def actions(self, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the actions that have reached the motors by a physics step. Shape: (num_envs, num_actions)."""
        actions = self._actions
        for link in self._of_actions:
            actions = _applied(link, actions, pos, vel, substep)
        return actions

    def measured(self, pos: Tensor, vel: Tensor) -> tuple[Tensor, Tensor]:
        """Return what control laws have of joint positions [rad] and velocities [rad/s].

        Shapes: (num_envs, num_dof).
        """
        return self.encoder.measured(pos, vel) if self.encoder else (pos, vel)

    def apply(self, wanted: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the torques that joints get of those that a control law asks for [N m].

        Called once per physics step; arguments as of :meth:`~legged_torque.motors.motor.Motor.apply`.
        """
        check_tensor("what _compute_torques returns", wanted, pos.shape, pos.device)
        torques, state = self.strength * wanted, self.measured(pos, vel)
        for link in self._behind_law:
            if link is self.encoder:
                state = pos, vel
            else:
                torques = _applied(link, torques, *state, substep)
        return torques

    def before_friction(self, torques: Tensor) -> Tensor:
        """Return what motors have made of torques that joints have got in a physics step [N m]; shapes as of them."""
        for link in self.links.values():
            torques = torques if link.lost is None else torques + link.lost
        return torques

    def kernel(self, law: Part | None, pos: Tensor, vel: Tensor, out: Tensor) -> TorqueKernel | None:
        """Return the whole chain behind a control law as one kernel; None without a law, or if a link has no function.

        Joint positions [rad], velocities [rad/s], and where it writes torques [N m]. Shapes: (num_envs, num_dof).
        """
        if not law or any(link.kernel is None for link in self.links.values()):
            return None
        parts = {link: (link.kernel, link.kernel_reads()) for link in self.links.values()}
        actions: Any = parts[self._of_actions[0]] if self._of_actions else (newest_actions, self._actions)
        links = [(link.acts_on, parts[link]) for link in self._behind_law]
        return TorqueKernel(joint_torque(law, self.strength, actions, links), pos, vel, out)

    def reset(self, mask: Tensor) -> None:
        """Forget what belongs to episodes that have ended. Shape: (num_envs,), bool."""
        for link in self.links.values():
            link.reset(mask)

    def random_parameters(self) -> list[RandomParameter]:
        """Return what is drawn of all links."""
        return [parameter for link in self.links.values() for parameter in link.random_parameters()]

    def describe(self) -> dict[str, dict[str, Any]]:
        """Return the constants of all links in their order, for ``policy.yaml``; none if they only limit torques."""
        described = {name: link.describe() for name, link in self.links.items()}
        described = {name: constants for name, constants in described.items() if constants}
        return {} if list(described.values()) == [{"model": "ideal"}] else described

    def state_dict(self) -> dict[str, Any]:
        """Return what all links keep from step to step, by name of the link."""
        return {name: link.state_dict() for name, link in self.links.items()} | {"strength": self.strength}

    def watched(self) -> dict[str, Tensor]:
        """Return the tensors that must be finite in every world. Shapes: (num_envs, any)."""
        states = ((name, link.state_dict()) for name, link in self.links.items())
        return {f"{name}.{key}": value.flatten(1) for name, state in states for key, value in state.items()}


def _applied(link: Motor, values: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
    """Return what a link makes of torques or actions; a UserError if it has another shape."""
    result = link.apply(values, pos, vel, substep)
    check_tensor(f"what {type(link).__name__}.apply returns", result, values.shape, values.device)
    return result
