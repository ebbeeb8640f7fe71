"""Proximal policy optimization, with torch's operations or, where it can be done, in ways that suit the device."""

from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage

from legged_torque.envs.base.symmetry import with_mirror_images
from legged_torque.learning.equivariance import are_known
from legged_torque.learning.ppo.cpu_ppo import CpuPPO
from legged_torque.learning.ppo.torch_ppo import LOSS_NAMES as LOSS_NAMES
from legged_torque.learning.ppo.torch_ppo import TorchPPO
from legged_torque.learning.ppo.triton.networks import read_network
from legged_torque.sim.compiled import has_triton


class OnDevicePPO(TorchPPO):
    """The PPO that settings name; :meth:`construct_algorithm` chooses what suits the device where that is possible."""

    @classmethod
    def make(cls, actor: MLPModel, critic: MLPModel, storage: RolloutStorage, **settings: Any) -> TorchPPO:
        """Return the algorithm for CPUs or, on a GPU that can run them, with Triton's kernels, if all is known."""
        alg = cls(actor, critic, storage, **settings)
        if not has_kernels(alg):
            return alg
        if not has_triton(alg.device):
            return CpuPPO(actor, critic, storage, **settings) if torch.device(alg.device).type == "cpu" else alg
        from legged_torque.learning.ppo.triton.triton_ppo import TritonPPO, can_multiply  # imports Triton

        dtype = torch.bfloat16 if alg.use_mixed_precision else torch.float32
        return TritonPPO(actor, critic, storage, **settings) if can_multiply(dtype, alg.device) else alg


def has_kernels(alg: TorchPPO) -> bool:
    """Return whether Triton's kernels and :class:`CpuPPO` know all parts of an algorithm; they know no user's class."""
    symmetry = alg.symmetry
    return (
        type(alg) is OnDevicePPO
        and are_known(alg.actor, alg.critic)
        and all(read_network(model.mlp) for model in (alg.actor, alg.critic))
        and not alg.normalize_advantage_per_mini_batch
        and not (symmetry and symmetry.use_mirror_loss)
        and not (symmetry and symmetry.data_augmentation_func is not with_mirror_images)
    )
