"""What must be finite in every world of a task."""

from __future__ import annotations

from typing import TYPE_CHECKING

from legged_torque.sim.health import Watched

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot


def watched(task: LeggedRobot) -> list[Watched]:
    """Return actions, what a world keeps from step to step, torques, rewards and observations, causes first.

    All of them have the values now that they have in a healthy world at the start. The physical state is not among
    them: the simulator itself tells where that diverged.
    """
    kept = {
        "actions": task._given_actions,
        **{drawn.model_field or drawn.name: drawn.field for drawn in task.randomization.parameters},
        "random_parameters": task.randomization.values,
        "action_delay": task.action_delay.drawn,
        "commands": task.commands,
        "feet_air_time": task.feet_air_time,
        "last_actions": task.last_actions,
        "last_dof_vel": task.last_dof_vel,
        "episode_return": task.episode_return.unsqueeze(1),
        "episode_sums": task.episode_sums.T,
        "delayed_actions": task.action_delay.before.flatten(1),
        "observation_history": task.obs_buf["policy"][:, task.observations.policy_size :],
    }
    per_world = {name: numbers for name, numbers in kept.items() if len(numbers) == task.num_envs}  # or worlds share it
    rewards = zip(task.reward_names, task.rewards.terms.unsqueeze(-1), strict=True)
    sizes = [task.observations.sizes[term.name] for term in task.observations.terms]
    observations = zip(task.observations.terms, task.obs_buf["critic"].split(sizes, dim=1), strict=True)
    return [
        *(Watched("buffer", name, numbers) for name, numbers in per_world.items()),
        *(Watched("observation", term.name, numbers) for term, numbers in observations),
        Watched("buffer", "torques", task.torques, is_derived=True),
        *(Watched("reward term", name, numbers, is_derived=True) for name, numbers in rewards),
    ]
