"""The multi-head actor of the paper (III-C.2, Figure 2)."""

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP
from tensordict import TensorDict
from torch import Tensor, nn

from legged_torque.utils.errors import UserError


class MultiHeadMLP(nn.Module):
    """General layers, a position head on them, and a torque head on them and on the position head's output."""

    def __init__(
        self, input_dim: int, output_dim: int, hidden_dims: list[int], head_hidden_dims: list[int], activation: str
    ) -> None:
        """Create general layers and both heads; the output is positions, then torques, one of each per joint."""
        super().__init__()
        num_dof = output_dim // 2
        self.trunk = MLP(input_dim, hidden_dims[-1], hidden_dims[:-1], activation, last_activation=activation)
        self.position_head = MLP(hidden_dims[-1], num_dof, head_hidden_dims, activation)
        self.torque_head = MLP(hidden_dims[-1] + num_dof, num_dof, head_hidden_dims, activation)

    def forward(self, observations: Tensor) -> Tensor:
        """Return positions and torques, unscaled. Shape: (..., output_dim)."""
        features = self.trunk(observations)
        positions = self.position_head(features)
        torques = self.torque_head(torch.cat([features, positions], dim=-1))
        return torch.cat([positions, torques], dim=-1)


class MultiHeadModel(MLPModel):
    """An rsl_rl model whose network is a :class:`MultiHeadMLP`."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: tuple[int, ...] | list[int] = (512, 256),
        activation: str = "elu",
        obs_normalization: bool = False,
        distribution_cfg: dict | None = None,
        head_hidden_dims: tuple[int, ...] | list[int] = (128,),
    ) -> None:
        """Create the model; arguments are those of rsl_rl's ``MLPModel``, and sizes of each head's hidden layers.

        A UserError if the number of actions is odd or a layer is missing.
        """
        if output_dim % 2:
            raise UserError(f"a multi-head actor needs an even number of actions, env.num_actions is {output_dim}")
        if len(hidden_dims) < 2 or not head_hidden_dims:
            raise UserError("a multi-head actor needs two actor.hidden_dims or more and one of actor.head_hidden_dims")
        super().__init__(
            obs, obs_groups, obs_set, output_dim, hidden_dims, activation, obs_normalization, distribution_cfg
        )
        self.mlp = MultiHeadMLP(self._get_latent_dim(), output_dim, [*hidden_dims], [*head_hidden_dims], activation)
