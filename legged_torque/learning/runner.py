"""The runner that users and the registry know: the trainer, built as rsl_rl's runner is."""

from typing import Any

import torch
from rsl_rl import runners
from rsl_rl.utils import resolve_callable
from torch import nn

import legged_torque
from legged_torque.learning.memory import acting
from legged_torque.learning.protocols import check_methods
from legged_torque.learning.trainer import Trainer
from legged_torque.utils import distributed
from legged_torque.utils.errors import UserError, check_names


class OnPolicyRunner(Trainer, runners.OnPolicyRunner):
    """The :class:`~legged_torque.learning.trainer.Trainer` of the learner that ``algorithm.class_name`` names.

    The constructor and the methods that export policies are those of rsl_rl's runner; everything else is the trainer's.
    """

    def __init__(self, env: Any, train_cfg: dict, log_dir: str | None = None, device: str = "cpu") -> None:
        """Create learner and trainer, with settings in rsl_rl's layout and on the task's device, "cpu" or "cuda:N".

        The folder of the run, ``log_dir``, is created when training starts; None keeps nothing. A UserError if a
        network reads observations that the task does not have, mirror images that training needs are not known, or
        processes that train together do not find each other.
        """
        torch.set_float32_matmul_precision("high")  # TF32 on a GPU
        check_methods(resolve_callable(train_cfg["algorithm"]["class_name"]))  # not rsl_rl's PPO, for instance
        groups_of_task = list(map(str, env.get_observations().keys()))
        for key, groups in train_cfg["obs_groups"].items():
            check_names(f"observation group in obs_groups.{key}", groups or [""], groups_of_task)
        if hasattr(env, "step_graph"):
            env.step_graph.enabled = train_cfg["capture"]
        try:
            runners.OnPolicyRunner.__init__(self, env, train_cfg, log_dir, device)
        except ValueError as error:
            if "observations" not in str(error):
                raise
            raise UserError(f"obs_groups: {error}") from error  # such as images for a network of vectors
        except TypeError as error:
            if "argument" not in str(error):
                raise
            raise UserError(f"algorithm, actor or critic: {error}") from error  # such as a setting that a class lacks
        self.logger.git_status_repos = [legged_torque.__file__]  # whose uncommitted changes a run's folder keeps
        Trainer.__init__(self, env, self.alg, train_cfg, self.logger)
        symmetry = getattr(self.alg, "symmetry", None)
        if log_dir and symmetry:  # refuse what has no mirror image before a folder is made
            obs, actions = env.get_observations()[:1], torch.zeros(1, env.num_actions, device=env.device)
            images = symmetry.data_augmentation_func(env=env, obs=obs, actions=actions)
            if len({len(image) for image in images}) > 1:
                raise UserError("symmetry_cfg.data_augmentation_func must return as many actions as observations")
        if log_dir and hasattr(self.alg, "allocate"):  # so that too much memory is refused before that, too
            self.alg.allocate()
        if log_dir and hasattr(env, "try_step"):
            env.try_step()

    def get_inference_policy(self, device: str | None = None) -> nn.Module:
        """Return the policy for inference in the worlds of ``env``, on a device if one is given."""
        return acting(self.alg.policy().eval().to(device), lambda: self.env)

    def _configure_multi_gpu(self) -> None:
        """Join the processes that torchrun has started; rsl_rl's own method knows only GPUs."""
        self.gpu_world_size, self.gpu_global_rank = distributed.world_size(), distributed.rank()
        self.is_distributed = self.gpu_world_size > 1
        self.cfg["multi_gpu"] = None
        if self.is_distributed:
            distributed.join(self.device)
            ranks = {"global_rank": self.gpu_global_rank, "local_rank": distributed.local_rank()}
            self.cfg["multi_gpu"] = {**ranks, "world_size": self.gpu_world_size}
