"""Mirror images among the samples that a policy learns from."""

import functools
from typing import Any

import torch
from rsl_rl.extensions import Symmetry
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from legged_torque.utils.errors import UserError


class MirrorImages(Symmetry):
    """rsl_rl's extension, whose images may also take the place of half of the samples, so that these stay as many.

    Attributes:
        replaces_half: Whether they do; otherwise they follow all samples.
    """

    def __init__(self, env: Any, replaces_half: bool = False, **settings: Any) -> None:
        """Create the extension for a task with rsl_rl's settings; a UserError if the mirror loss has too few images."""
        super().__init__(env, **settings)
        self.replaces_half = replaces_half and self.use_data_augmentation
        if self.replaces_half and self.use_mirror_loss:
            raise UserError(
                "algorithm.symmetry_cfg: use_mirror_loss needs the images of all samples, replaces_half=false"
            )

    def sizes(self, num_samples: int) -> tuple[int, int]:
        """Return how many of so many samples stay as they are, which come first, and how many there are with images."""
        if self.replaces_half:
            return num_samples - num_samples // 2, num_samples
        return num_samples, num_samples * (2 if self.use_data_augmentation else 1)

    def add(self, obs: TensorDict, actions: Tensor | None) -> tuple[Any, Any]:
        """Return samples with images. Shapes: (samples, size) per group, (samples, num_actions); None stays None."""
        make: Any = functools.partial(self.data_augmentation_func, env=self.env)
        if not self.replaces_half:
            return make(obs=obs, actions=actions)
        first, _ = self.sizes(len(obs))
        count = len(obs) - first
        seen, done = make(obs=obs[first:], actions=None if actions is None else actions[first:])
        replaced = torch.cat([obs[:first], seen[count:]])
        return replaced, None if actions is None else torch.cat([actions[:first], done[count:]])

    def augment_batch(self, batch: RolloutStorage.Batch, original_batch_size: int) -> None:
        """Add images to a minibatch, as rsl_rl does or in the place of half of it."""
        if self.replaces_half:
            batch.observations, batch.actions = self.add(batch.observations, batch.actions)
        else:
            super().augment_batch(batch, original_batch_size)
