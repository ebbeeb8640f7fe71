"""Sums over many steps, kept on the device and read once per iteration."""

import torch
from torch import Tensor

from legged_torque.envs.base.state import RobotState


class TaskLog:
    """Episodes, tracking and diverged worlds since the last :meth:`read`."""

    def __init__(self, reward_names: list[str], num_envs: int, device: str) -> None:
        """Start with empty sums; names of reward terms are in the order of ``episode_sums``."""
        self._names = [*reward_names, "steps", "episodes", "length", "return", "diverged", "error_xy", "error_yaw"]
        self._num_terms = len(reward_names)
        # Of each world, since adding up worlds costs a GPU more than all else here.
        self._of_terms, self._of_steps = (
            torch.zeros(count, num_envs, device=device)
            for count in (self._num_terms, len(self._names) - self._num_terms)
        )

    def add_step(self, state: RobotState, episode_sums: Tensor) -> None:
        """Add one control step, after its rewards and before its resets.

        ``episode_sums`` are those of the reward terms. Shape: (terms, num_envs).
        """
        error_xy = (state.commands[:, :2] - state.base_lin_vel[:, :2]).square().sum(dim=1)
        error_yaw = (state.commands[:, 2] - state.base_ang_vel[:, 2]).square()
        finished = state.reset_buf.float()
        diverged = state.diverged
        rows = [
            torch.ones_like(finished),
            finished,
            finished * state.episode_length,
            finished * state.episode_return,
            diverged.float(),
            torch.where(diverged, 0.0, error_xy),
            torch.where(diverged, 0.0, error_yaw),
        ]
        self._of_terms.add_(episode_sums * finished)
        for row, number in zip(self._of_steps, rows, strict=True):
            row.add_(number)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the sums."""
        return {"of_terms": self._of_terms, "of_steps": self._of_steps}

    def read(self, max_episode_length_s: float) -> dict[str, float]:
        """Return the means since the last call and start anew. Waits for the device.

        Per finished episode: "Episode_Reward/<term>", divided by the length of a full episode [s] as in legged_gym,
        "return" and "length"; absent if none has finished. Per step: "Tracking/error_xy" [m^2/s^2],
        "Tracking/error_yaw" [rad^2/s^2]. "Health/diverged_worlds": worlds that were reset because anything in them was
        not finite.
        """
        numbers = torch.cat([self._of_terms, self._of_steps]).sum(dim=1).tolist()
        sums = dict(zip(self._names, numbers, strict=True))
        self._of_terms.zero_()
        self._of_steps.zero_()
        result = {}
        if sums["episodes"]:
            for name in self._names[: self._num_terms]:
                result[f"Episode_Reward/{name}"] = sums[name] / sums["episodes"] / max_episode_length_s
            result |= {key: sums[key] / sums["episodes"] for key in ("return", "length")}
        if sums["steps"]:
            result |= {f"Tracking/{key}": sums[key] / sums["steps"] for key in ("error_xy", "error_yaw")}
        result["Health/diverged_worlds"] = sums["diverged"]
        return result
