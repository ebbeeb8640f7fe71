"""The left-right mirror image of what a policy sees and does, for rsl_rl's symmetry extension."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.utils.errors import UserError

if TYPE_CHECKING:
    from legged_torque.envs.base.legged_robot import LeggedRobot


class Mirror:
    """Reflects observations and actions at the robot's sagittal plane: signed permutations of their entries.

    Joints and feet change places with those of the same name on the other side: R and L swapped at the end of the
    part before the first underscore, as in FR_hip and FL_hip. Joints that turn about the x axis change their sign.
    """

    def __init__(self, task: LeggedRobot) -> None:
        """Prepare the permutations.

        Args:
            task: The task; its observations are those of ``Observations.compute_observations``.

        Raises:
            UserError: If a joint or foot has no counterpart on the other side, or a drawn parameter has another number
                of values than one or one per joint.
        """
        names = task.dof_names
        joints = counterparts(names)
        rolls = [abs(task.sim.mj_model.joint(name).axis[0]) > 0.5 for name in names]
        joint_signs = [-1.0 if roll else 1.0 for roll in rolls]
        feet = counterparts(task.foot_names)
        actions = [joints, joint_signs] if task.actions_per_dof == 1 else repeat(joints, joint_signs, 2)
        vector, axial = ([0, 1, 2], [1.0, -1.0, 1.0]), ([0, 1, 2], [-1.0, 1.0, -1.0])
        command = ([0, 1, 2], [1.0, -1.0, -1.0])
        policy = [vector, axial, command, (joints, joint_signs), (joints, joint_signs), tuple(actions)]
        signed = {
            "trunk_com": vector,
            "foot_offset": ([3 * foot + axis for foot in feet for axis in range(3)], vector[1] * len(feet)),
            "joint_offset": (joints, joint_signs),
        }
        unsigned = {1: ([0], [1.0]), len(joints): (joints, [1.0] * len(joints))}
        drawn = []
        for name, size in task.randomization.sizes.items():
            if name not in signed and size not in unsigned:
                raise UserError(f"algorithm.symmetry_cfg: the mirror image of the {size} numbers '{name}' is not known")
            drawn.append(signed.get(name) or unsigned[size])
        critic = [*policy, vector, ([0], [1.0]), (feet, [1.0] * len(feet)), *drawn]
        self._maps = {
            name: self._concatenate(parts, task.device)
            for name, parts in {
                "policy": policy * task.cfg.env.history_length,
                "critic": critic,
                "actions": [tuple(actions)],
            }.items()
        }

    def __call__(self, name: str, values: Tensor) -> Tensor:
        """Return the mirror image.

        Args:
            name: "policy", "critic" or "actions".
            values: Shape: (samples, size).
        """
        order, signs = self._maps[name]
        return values[:, order] * signs

    @staticmethod
    def _concatenate(parts: list[tuple[list[int], list[float]]], device: str) -> tuple[Tensor, Tensor]:
        """Return order and signs of all parts behind each other."""
        order: list[int] = []
        signs: list[float] = []
        for indices, part_signs in parts:
            start = len(order)
            order += [start + index for index in indices]
            signs += part_signs
        return torch.tensor(order, device=device), torch.tensor(signs, device=device)


def repeat(indices: list[int], signs: list[float], times: int) -> tuple[list[int], list[float]]:
    """Return a signed permutation that acts alike on each of several blocks."""
    size = len(indices)
    return [block * size + index for block in range(times) for index in indices], signs * times


def counterparts(names: list[str]) -> list[int]:
    """Return where each part's counterpart on the other side stands: that of FR_hip is FL_hip.

    Raises:
        UserError: If one is missing.
    """
    result = []
    for name in names:
        leg, _, rest = name.partition("_")
        other = f"{leg[:-1]}{leg[-1:].translate(str.maketrans('LR', 'RL'))}_{rest}"
        if other not in names:
            raise UserError(f"algorithm.symmetry_cfg: '{name}' has no counterpart '{other}' on the other side")
        result.append(names.index(other))
    return result


def with_mirror_images(
    env: LeggedRobot, obs: TensorDict | None, actions: Tensor | None
) -> tuple[TensorDict | None, Tensor | None]:
    """Return observations and actions followed by their mirror images: rsl_rl's ``data_augmentation_func``.

    Args:
        env: The task.
        obs: Observations, each (samples, size), or None.
        actions: Shape: (samples, num_actions), or None.
    """
    if obs is not None:
        groups = {name: torch.cat([group, env.mirror(name, group)]) for name, group in obs.items()}
        obs = TensorDict(groups, [2 * len(obs)])
    if actions is not None:
        actions = torch.cat([actions, env.mirror("actions", actions)])
    return obs, actions
