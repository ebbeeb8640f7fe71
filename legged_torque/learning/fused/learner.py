"""Acting and learning with the kernels of this package."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.learning.fused import products, samples, steps
from legged_torque.learning.fused.memory import NUMBERS, SAMPLES, TILE, LearningWorkspace, Parameters, Workspace
from legged_torque.learning.fused.networks import ALIGNMENT, Network, read_network
from legged_torque.sim.compiled import keep_kernels
from legged_torque.utils import distributed
from legged_torque.utils.progress import torch_compiles

if TYPE_CHECKING:
    from legged_torque.learning.ppo import OnDevicePPO

GAE_WORLDS = 64  # worlds of a program


def compiles_first(method: Callable) -> Callable:
    """Let the progress line know when a method of the learner is called for the first time."""

    @functools.wraps(method)
    def call(self: FusedLearner, *args: Any) -> Any:
        if method.__name__ in self.compiled:
            return method(self, *args)
        self.compiled.add(method.__name__)
        with torch_compiles():
            return method(self, *args)

    return call


class FusedLearner:
    """Does what :class:`~legged_torque.learning.ppo.OnDevicePPO` does with torch's operations, in few kernels.

    Products of matrices take bfloat16 numbers with mixed precision, else TF32; sums, parameters, losses and Adam are
    float32. Policies round alike when they act and when they learn.
    """

    def __init__(self, alg: OnDevicePPO) -> None:
        """Move an algorithm's parameters into one piece, and its optimizer's state."""
        keep_kernels()
        self._alg = alg
        self.compiled: set[str] = set()  # methods whose kernels have been compiled
        self._networks = networks = [network for m in (alg.actor, alg.critic) if (network := read_network(m.mlp))]
        layers = [layer for network in networks for layer in network.layers]
        storage, device = alg.storage, alg.device
        self._std = self._deviation_settings()
        self._parameters = Parameters(alg.actor, alg.critic, layers, self._std[0], alg.product_dtype)
        self._acting = Workspace(networks, self._parameters, storage.num_envs)
        images = 2 if alg.symmetry else 1
        self._num_chosen = alg.batch_size
        self._num_samples = images * alg.batch_size
        self._learning = LearningWorkspace(networks, self._parameters, self._num_samples)
        self._places = self._learning.output_places(networks)
        size, flat = storage.actions.shape[-1], self._parameters.flat
        self._gradient = torch.zeros(len(flat) + NUMBERS, device=device)
        self._numbers = self._gradient[len(flat) :]  # value loss, surrogate loss, entropy, KL divergence
        self.moments, self.squares = torch.zeros(2, len(flat), device=device).unbind()
        self.adam_steps = torch.zeros((), device=device)
        self._norms = torch.zeros(2, steps.PARTS, device=device)
        self._scalars = torch.zeros(5, device=device)  # see :func:`~legged_torque.learning.fused.steps.settle`
        self._means, self._stds = torch.zeros_like(storage.actions), torch.zeros(size, device=device)
        storage.distribution_params = (self._means, self._stds.expand_as(self._means))  # the same for all samples
        self._maps = [[self._mirror_map(group) for group in model.obs_groups] for model in (alg.actor, alg.critic)]
        self._action_map = self._mirror_map("actions")
        self.share_state(alg.optimizer)

    # ---- acting --------------------------------------------------------------------------------------------------

    @compiles_first
    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions and keep the transition. Shape: (num_envs, num_actions)."""
        storage, step = self._alg.storage, self._alg.storage.step
        if step == 0:
            self.round_weights()  # something else than a gradient step may have changed them
        storage.observations[step].copy_(obs)
        self._run_networks(obs)
        actions = storage.actions[step]
        noise = torch.randn_like(actions)
        written = (actions, self._means[step], self._stds, storage.actions_log_prob[step], storage.values[step])
        shape, columns = actions.shape, _power_of_two(actions.shape[1])
        samples.act[(-(-shape[0] // samples.ROWS),)](
            self._acting.outputs, noise, *self._std[:3], *written, *shape,
            IS_LOG=self._std[3], ROWS=samples.ROWS, COLUMNS=columns,
        )  # fmt: skip
        return actions

    def add_step(self, rewards: Tensor, dones: Tensor, time_outs: Tensor | None) -> None:
        """Keep what followed the actions; a time-out is worth what the critic thought of the state before."""
        storage, step = self._alg.storage, self._alg.storage.step
        kept = storage.rewards[step].view(-1)
        if time_outs is None:
            kept.copy_(rewards)
        else:
            torch.addcmul(rewards, storage.values[step].view(-1), time_outs.float(), value=self._alg.gamma, out=kept)
        storage.dones[step].copy_(dones.view(-1, 1))
        storage.step += 1

    @compiles_first
    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages (GAE), these of mean 0 and deviation 1 over the rollout."""
        storage, alg = self._alg.storage, self._alg
        self._run_networks(obs)
        last_values = self._acting.outputs[: storage.num_envs, -1].contiguous()
        samples.generalized_advantages[(-(-storage.num_envs // GAE_WORLDS),)](
            storage.rewards, storage.dones, storage.values, last_values, storage.returns, storage.advantages,
            storage.num_transitions_per_env, storage.num_envs, alg.gamma, alg.lam, WORLDS=GAE_WORLDS, num_warps=2,
        )  # fmt: skip
        advantages = storage.advantages
        advantages.copy_((advantages - advantages.mean()) / (advantages.std() + 1e-8))

    def action_std(self) -> Tensor:
        """Return the standard deviations of actions when they were last sampled. Shape: (num_actions,)."""
        return self._stds

    # ---- learning ------------------------------------------------------------------------------------------------

    @compiles_first
    def update_minibatch(self) -> None:
        """Take one gradient step on the chosen samples."""
        alg, work = self._alg, self._learning
        for network, model, maps in zip(self._networks, (alg.actor, alg.critic), self._maps, strict=True):
            groups = [alg.storage.observations[group].flatten(0, 1) for group in model.obs_groups]
            self._observe(work, network, groups, maps)
        self._forward(work)
        self._losses()
        for table in work.backward:
            arguments = (work.values, work.gradients, self._parameters.weights, work.sums, work.sums.shape[1], table)
            settings = {"SAMPLES": SAMPLES} | products.BACKWARD
            self._product(products.input_gradient, arguments, work.rows // SAMPLES, settings)
        self._weight_gradients()
        if alg.is_multi_gpu:
            distributed.average([self._gradient])
        self._step()

    def round_weights(self) -> None:
        """Prepare the weights for the products, after something else than a gradient step has changed them."""
        parameters = self._parameters
        arrays = (parameters.flat, parameters.weights, parameters.source, len(parameters.flat))
        steps.round_weights[(-(-len(parameters.flat) // steps.BLOCK),)](*arrays, BLOCK=steps.BLOCK)

    def state(self) -> list[Tensor]:
        """Return the parameters, both moments and the number of steps; writing them changes the state."""
        return [self._parameters.flat, self.moments, self.squares, self.adam_steps.view(1)]

    def gradients(self) -> list[Tensor]:
        """Return the gradients of the last minibatch before they were clipped, as the algorithm's parameters."""
        return self._parameters.views(self._gradient)

    def share_state(self, optimizer: torch.optim.Optimizer) -> None:
        """Take over the state of an Adam optimizer, and let it be views of what is used here."""
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        moments, squares = self._parameters.views(self.moments), self._parameters.views(self.squares)
        for parameter, moment, square in zip(parameters, moments, squares, strict=True):
            state = optimizer.state[parameter] or {"exp_avg": 0.0, "exp_avg_sq": 0.0, "step": 0.0}
            moment.copy_(torch.as_tensor(state["exp_avg"]))
            square.copy_(torch.as_tensor(state["exp_avg_sq"]))
            self.adam_steps.copy_(torch.as_tensor(state["step"]))
            optimizer.state[parameter] = {"step": self.adam_steps, "exp_avg": moment, "exp_avg_sq": square}

    def _run_networks(self, obs: TensorDict) -> None:
        """Compute the outputs of actor and critic in all worlds."""
        for network, model in zip(self._networks, (self._alg.actor, self._alg.critic), strict=True):
            self._observe(self._acting, network, [obs[group] for group in model.obs_groups], None)
        self._forward(self._acting)

    def _observe(self, work: Workspace, network: Network, groups: Sequence[Tensor], maps: Any) -> None:
        """Write the inputs of a network: groups of observations, with mirror images if there are maps for them."""
        column = 0
        for i, group in enumerate(groups):
            order, signs = maps[i] if maps else (group, group)
            target = (work.place(network.inputs), network.inputs.block.width, column)
            counts = (self._num_chosen, self._num_samples if maps else len(group), group.shape[1])
            columns = _power_of_two(group.shape[1])
            rows = max(1, min(samples.ROWS, samples.NUMBERS // columns))
            samples.observe[(work.rows // rows,)](
                group, self._alg.indices, order, signs, work.values, *target, *counts,
                CHOOSE=bool(maps), ROWS=rows, COLUMNS=columns,
            )  # fmt: skip
            column += group.shape[1]

    def _forward(self, work: Workspace) -> None:
        """Compute the outputs of actor and critic from their inputs."""
        for table, has_outputs in work.forward:
            arrays = (work.values, self._parameters.weights, self._parameters.flat, work.outputs, table)
            sizes = {"HAS_OUTPUTS": has_outputs, "SAMPLES": SAMPLES}
            self._product(products.forward, arrays, work.rows // SAMPLES, sizes | products.FORWARD)

    def _product(self, kernel: Any, arguments: tuple, parts: int, settings: dict[str, int]) -> None:
        """Launch a matrix product of all tiles of a table, the last argument, for all parts of the samples."""
        num_tiles, columns = arguments[-1].shape
        kernel[num_tiles, parts](*arguments, COLUMNS=columns, TILE=TILE, STEP=ALIGNMENT, PRECISION="tf32", **settings)

    def _losses(self) -> None:
        """Compute losses and their gradients by the outputs."""
        alg, work, storage = self._alg, self._learning, self._alg.storage
        size = storage.actions.shape[-1]
        batch = (
            storage.actions,
            self._means,
            storage.actions_log_prob,
            storage.values,
            storage.advantages,
            storage.returns,
        )
        numbers = (self._num_chosen, self._num_samples, size, alg.clip_param, alg.value_loss_coef, alg.entropy_weight)
        places, strides, columns = self._places
        samples.losses[(len(work.sums),)](
            work.outputs, *self._std[:3], self._stds, alg.indices, *self._action_map, *batch, alg.actor_learns,
            work.gradients, places, strides, work.sums, work.sums.shape[1], columns, *numbers, IS_LOG=self._std[3],
            CLIP_VALUES=alg.use_clipped_value_loss, ROWS=SAMPLES, COLUMNS=_power_of_two(size), num_warps=16,
        )  # fmt: skip

    def _weight_gradients(self) -> None:
        """Compute the gradient of all parameters from those of what the layers compute."""
        work, parameters = self._learning, self._parameters
        parts, room = work.partial.shape
        arguments = (work.values, work.gradients, work.partial, work.rows // parts, room, work.weight_tiles)
        self._product(products.weight_gradient, arguments, parts, products.BACKWARD)
        size, (rows, columns) = len(parameters.flat), work.sums.shape
        steps.sum_rows[(-(-columns // 32),)](
            work.sums, rows, columns, parameters.destination, self._gradient, ROWS=128, COLUMNS=32, num_warps=8
        )
        steps.sum_parts[(-(-size // steps.BLOCK),)](
            work.partial, parts, room, parameters.source, self._gradient, size, BLOCK=steps.BLOCK
        )

    def _step(self) -> None:
        """Clip the gradients and let Adam take a step, unless they are not finite."""
        alg, parameters = self._alg, self._parameters
        size, group = len(parameters.flat), alg.optimizer.param_groups[0]
        steps.sum_squares[(steps.PARTS,)](
            self._gradient, parameters.actor_size, size, self._norms, PARTS=steps.PARTS, BLOCK=steps.BLOCK
        )
        beta1, beta2 = group["betas"]
        steps.settle[(1,)](
            self._numbers, self._norms, alg.learning_rate, alg.actor_learns, self.adam_steps, self._scalars, alg.losses,
            alg.max_grad_norm, alg.kl_target, *alg.learning_rates, math.log(beta1), math.log(beta2),
            ADAPTIVE=alg.schedule == "adaptive", PARTS=steps.PARTS,
        )  # fmt: skip
        decay = group["weight_decay"] if isinstance(alg.optimizer, torch.optim.AdamW) else 0.0
        steps.adam[(-(-size // steps.BLOCK),)](
            parameters.flat, self._gradient, self.moments, self.squares, parameters.weights, parameters.source,
            self._scalars, alg.learning_rate, parameters.actor_size, size,
            beta1, beta2, group["eps"], decay, BLOCK=steps.BLOCK,
        )  # fmt: skip

    def _mirror_map(self, name: str) -> tuple[Tensor, Tensor]:
        """Return order and signs of the mirror image of observations or actions; without images, of no change."""
        alg = self._alg
        if alg.symmetry:
            return alg.symmetry.env.mirror.maps[name]
        size = (alg.storage.actions if name == "actions" else alg.storage.observations[name]).shape[-1]
        return torch.arange(size, device=alg.device), torch.ones(size, device=alg.device)

    def _deviation_settings(self) -> tuple[Any, float, float, bool]:
        """Return the parameter of the standard deviations, its range, and whether it is a logarithm."""
        distribution: Any = self._alg.actor.distribution
        if distribution.std_type == "log":
            return distribution.log_std_param, *distribution.log_std_range, True
        return distribution.std_param, *distribution.std_range, False


def can_multiply(dtype: torch.dtype, device: str) -> bool:
    """Return whether a GPU multiplies bfloat16 and TF32, and has the shared memory that the tiles of a product take."""
    stages = max(settings["num_stages"] for settings in (products.FORWARD, products.BACKWARD))
    tiles = stages * (SAMPLES + TILE) * ALIGNMENT * dtype.itemsize
    properties = torch.cuda.get_device_properties(device)
    return properties.major >= 8 and tiles <= properties.shared_memory_per_multiprocessor


def _power_of_two(size: int) -> int:
    """Return the next power of two."""
    return 1 << (size - 1).bit_length()
