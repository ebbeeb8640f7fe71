"""The tensors of a task that must be finite in every world."""

from collections.abc import Mapping

import torch
from torch import Tensor

from legged_torque.envs.base.observations import Observations
from legged_torque.envs.base.rewards import Rewards
from legged_torque.envs.base.state import RobotState
from legged_torque.sim.health import Watched


def watched(
    state: RobotState, kept: Mapping[str, Tensor], rewards: Rewards, observations: Observations
) -> list[Watched]:
    """Return actions, what a world keeps from step to step, torques, rewards and observations, causes first.

    All of them have the values now that they have in a healthy world at the start. The physical state is not among
    them: the simulator itself flags worlds in which that diverged. ``kept`` are further tensors by name, float32 and of
    shape (num_envs, any); others are left out, as are those that are not finite at the start.
    """
    buffers = {
        **kept,
        "commands": state.commands,
        "feet_air_time": state.feet_air_time,
        "last_actions": state.last_actions,
        "last_dof_vel": state.last_dof_vel,
        "episode_return": state.episode_return.unsqueeze(1),
        "episode_sums": rewards.episode_sums.T,
        "observation_history": observations.history,
    }
    rows = {name: numbers for name, numbers in buffers.items() if len(numbers) == state.num_envs}
    numeric = {name: row.unsqueeze(-1).flatten(1) for name, row in rows.items() if row.dtype == torch.float32}
    per_world = {name: numbers for name, numbers in numeric.items() if numbers.isfinite().all()}
    terms = zip(rewards.names, rewards.terms.unsqueeze(-1), strict=True)
    return [
        *(Watched("buffer", name, numbers) for name, numbers in per_world.items()),
        *(Watched("observation", name, numbers) for name, numbers in observations.by_term().items()),
        Watched("buffer", "torques", state.torques, is_derived=True),
        *(Watched("reward term", name, numbers, is_derived=True) for name, numbers in terms),
    ]
