"""Motors as a network that was trained with logged data."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_torque.motors.joints import Joints
from legged_torque.motors.model_config import NetworkCfg
from legged_torque.motors.motor import Motor
from legged_torque.utils.errors import UserError

INPUTS = 2  # position error [rad] and velocity [rad/s] of a joint


class NetworkMotor(Motor):
    """An LSTM in legged_gym's form (``actuator_nets/anydrive_v3_lstm.pt``), the same for all joints; in torch alone.

    It maps position error and velocity of a joint, (joints of all worlds, 1, 2), and its state to torques [N m] and new
    state. The error follows from the wanted torque and the gains of the settings: (wanted + damping vel) / stiffness.
    The file is TorchScript: a network with its own program, which torch interprets. It runs no Python.
    """

    cfg: NetworkCfg

    def __init__(self, cfg: NetworkCfg, joints: Joints) -> None:
        """Load the network; a UserError if the file cannot be read or is of another form."""
        super().__init__(cfg, joints)
        path, num_dof = joints.section, len(joints.names)
        try:
            self._network = torch.jit.load(cfg.file, map_location=self.device).eval()
            weights = {name.rpartition(".")[2]: tuple(part.shape) for name, part in self._network.named_parameters()}
        except (OSError, RuntimeError, ValueError) as error:
            raise UserError(f"{path}.file '{cfg.file}' is not a TorchScript file: {_line(error)}") from None
        inputs, hidden = (weights.get(f"weight_{kind}_l0", (0, 0))[1] for kind in ("ih", "hh"))
        if inputs != INPUTS:
            raise UserError(f"{path}.file '{cfg.file}' must be an LSTM of {INPUTS} inputs per joint, not {inputs}")
        layers = sum(name.startswith("weight_hh_l") for name in weights)
        self._hidden, self._cell = (self.buffer(name, layers, num_dof, hidden) for name in ("hidden", "cell"))
        gains = {"stiffness": cfg.stiffness, "damping": cfg.damping}
        self._kp, self._kd = (joints.values(f"{path}.{name}", values) for name, values in gains.items())
        zeros = torch.zeros(self.num_envs, num_dof, device=self.device)
        try:
            self.apply(zeros, zeros, zeros, 0)
        except (RuntimeError, TypeError, ValueError) as error:
            raise UserError(f"{path}.file '{cfg.file}' cannot compute torques: {_line(error)}") from None
        self.reset(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))

    def apply(self, wanted: Tensor, pos: Tensor, vel: Tensor, substep: int) -> Tensor:
        """Return the network's torques."""
        seen = torch.stack([(wanted + self._kd * vel) / self._kp, vel], dim=2).view(-1, 1, INPUTS)
        before = tuple(state.transpose(0, 1).flatten(1, 2).contiguous() for state in (self._hidden, self._cell))
        with torch.no_grad():
            torques, after = self._network(seen, before)
        for state, new in zip((self._hidden, self._cell), after, strict=True):
            state.copy_(new.unflatten(1, (self.num_envs, -1)).transpose(0, 1))
        return torques.view(wanted.shape)

    def reset(self, mask: Tensor) -> None:
        """Forget the state of ended episodes."""
        for state in (self._hidden, self._cell):
            state.masked_fill_(mask.view(-1, 1, 1, 1), 0.0)


def _line(error: Exception) -> str:
    """Return the last line of an error: those of TorchScript begin with its program."""
    return [line for line in str(error).splitlines() if line.strip()][-1]
