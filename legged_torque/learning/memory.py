"""The memory of recurrent policies outside of their learner."""

from collections.abc import Callable
from typing import Any

from rsl_rl.models import MLPModel
from rsl_rl.modules import HiddenState
from tensordict import TensorDict
from torch import Tensor, nn


class RememberingPolicy(nn.Module):
    """A recurrent policy with a memory of its own, of some worlds: the network itself remembers those of its learner.

    A world whose episode has just started is forgotten, so that loops need not do it.

    Attributes:
        memory: What the network remembers of each world, in the form that it has in rsl_rl; None before the first step.
    """

    def __init__(self, model: MLPModel, worlds: Callable[[], Any]) -> None:
        """Take the network, and a function that returns the task from which observations come."""
        super().__init__()
        self.model, self._worlds = model, worlds
        self.memory: HiddenState = None

    def forward(self, obs: TensorDict) -> Tensor:
        """Return mean actions for the next observations of all worlds. Shape: (num_envs, num_actions)."""
        of_learner = self.model.get_hidden_state()
        self.model.reset(hidden_state=self.memory)
        self.model.reset(self._worlds().reset_buf)
        actions = self.model(obs)
        self.memory = self.model.get_hidden_state()
        self.model.reset(hidden_state=of_learner)
        return actions


def acting(model: Any, worlds: Callable[[], Any]) -> Any:
    """Return a policy that acts in the worlds that a function returns: the model itself if it remembers nothing."""
    return RememberingPolicy(model, worlds) if getattr(model, "is_recurrent", False) else model
