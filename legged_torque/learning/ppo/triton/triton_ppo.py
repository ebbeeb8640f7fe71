"""PPO that acts and learns with the kernels of this package."""

import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import triton
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from legged_torque.learning.ppo.torch_ppo import TorchPPO
from legged_torque.learning.ppo.triton import products, samples, steps
from legged_torque.learning.ppo.triton.memory import LOSS_SAMPLES, NARROW_TILE, NUMBERS, SAMPLES, TILE, Memory
from legged_torque.learning.ppo.triton.networks import ALIGNMENT, Columns, aligned, read_network
from legged_torque.sim.compiled import keep_kernels
from legged_torque.utils import distributed
from legged_torque.utils.progress import torch_compiles

GAE_WORLDS = 64  # worlds of a program


def shows_compilation(method: Callable) -> Callable:
    """Show in the progress line that the first call of a method compiles its kernels."""

    @functools.wraps(method)
    def call(self: "TritonPPO", *args: Any) -> Any:
        with contextlib.nullcontext() if method.__name__ in self.compiled else torch_compiles():
            self.compiled.add(method.__name__)
            return method(self, *args)

    return call


class TritonPPO(TorchPPO):
    """Does what :class:`TorchPPO` does, in few kernels.

    Products of matrices take bfloat16 numbers with mixed precision, else TF32; sums, parameters, losses and Adam are
    float32. Policies round alike when they act and when they learn.
    """

    use_mixed_precision: bool

    def __init__(self, actor: MLPModel, critic: MLPModel, storage: RolloutStorage, **settings: Any) -> None:
        """Create the algorithm, and move the parameters of both models into one piece, and the optimizer's state.

        Arguments are those of :class:`TorchPPO`, for which there must be kernels.
        """
        super().__init__(actor, critic, storage, **settings)
        keep_kernels()
        self.compiled: set[str] = set()  # methods whose kernels have been compiled
        self.product_dtype = torch.bfloat16 if self.use_mixed_precision else torch.float32
        self._models = (actor, critic)
        size = storage.actions.shape[-1]
        networks = (read_network(actor.mlp), read_network(critic.mlp, size))
        self._std = self._deviation_settings()
        self._num_samples = self.batch_size * (2 if self.symmetry else 1)
        sizes = (self._num_samples, storage.num_envs)
        self._memory = Memory(self._models, networks, self._std[0], self.product_dtype, *sizes)
        self._places = self._memory.output_places()
        flat = self._memory.flat
        self._gradient = flat.new_zeros(len(flat) + NUMBERS)
        self._numbers = self._gradient[len(flat) :]  # value loss, surrogate loss, entropy, KL divergence
        self._moments, self._squares = flat.new_zeros(2, len(flat)).unbind()
        self._adam_steps = flat.new_zeros(())
        self._norms = flat.new_zeros(2, steps.PARTS)
        self._scalars = flat.new_zeros(5)  # see :func:`~legged_torque.learning.ppo.triton.steps.prepare_adam_step`
        self._means, self._stds = torch.zeros_like(storage.actions), flat.new_zeros(size)
        storage.distribution_params = (self._means, self._stds.expand_as(self._means))  # the same for all samples
        self._maps = [[self._mirror_map(group) for group in model.obs_groups] for model in self._models]
        self._action_map = self._mirror_map("actions")
        self._share_optimizer_state()

    # ---- acting --------------------------------------------------------------------------------------------------

    @shows_compilation
    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions and keep the transition. Shape: (num_envs, num_actions)."""
        storage, step = self.storage, self.storage.step
        if step == 0:
            self.round_weights()  # something else than a gradient step may have changed them
        storage.observations[step].copy_(obs)
        self._run_networks(obs)
        actions = storage.actions[step]
        noise = torch.randn_like(actions)
        written = (actions, self._means[step], self._stds, storage.actions_log_prob[step], storage.values[step])
        samples.act[(triton.cdiv(len(actions), samples.ROWS),)](
            self._memory.outputs, noise, *self._std[:3], *written, *actions.shape,
            IS_LOG=self._std[3], ROWS=samples.ROWS, COLUMNS=triton.next_power_of_2(actions.shape[1]),
        )  # fmt: skip
        return actions

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Tensor]) -> None:
        """Keep what followed the actions; a time-out is worth what the critic thought of the state before."""
        storage, step = self.storage, self.storage.step
        kept = storage.rewards[step].view(-1)
        if "time_outs" in extras:
            time_outs = extras["time_outs"].float()
            torch.addcmul(rewards, storage.values[step].view(-1), time_outs, value=self.gamma, out=kept)
        else:
            kept.copy_(rewards)
        storage.dones[step].copy_(dones.view(-1, 1))
        storage.step += 1

    @shows_compilation
    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages (GAE), these of mean 0 and deviation 1 over the rollout."""
        storage = self.storage
        self._run_networks(obs)
        last_values = self._memory.outputs[: storage.num_envs, -1].contiguous()
        samples.generalized_advantages[(triton.cdiv(storage.num_envs, GAE_WORLDS),)](
            storage.rewards, storage.dones, storage.values, last_values, storage.returns, storage.advantages,
            storage.num_transitions_per_env, storage.num_envs, self.gamma, self.lam, WORLDS=GAE_WORLDS, num_warps=2,
        )  # fmt: skip
        advantages = storage.advantages
        advantages.copy_((advantages - advantages.mean()) / (advantages.std() + 1e-8))

    def action_std(self) -> Tensor:
        """Return the standard deviations of actions when they were last sampled. Shape: (num_actions,)."""
        return self._stds

    # ---- learning ------------------------------------------------------------------------------------------------

    @shows_compilation
    def update_minibatch(self) -> None:
        """Take one gradient step on the samples of ``indices``."""
        memory = self._memory
        for inputs, model, maps in zip(memory.inputs, self._models, self._maps, strict=True):
            groups = [self.storage.observations[group].flatten(0, 1) for group in model.obs_groups]
            self._observe(inputs, groups, memory.rows, maps)
        self._forward(memory.rows)
        self._write_losses()
        for table in memory.backward:
            arguments = (memory.values, memory.gradients, memory.weights, memory.sums, memory.sums.shape[1], table)
            settings = {"SAMPLES": SAMPLES, "TILE": NARROW_TILE} | products.BACKWARD
            self._product(products.input_gradient, arguments, memory.rows // SAMPLES, settings)
        self._weight_gradients()
        if self.is_multi_gpu:
            distributed.average([self._gradient])
        if self.mirrored:
            gradient = self._gradient[: len(memory.flat)]
            gradient.copy_(self.mirrored.averaged(gradient))
        self._step()

    def round_weights(self) -> None:
        """Prepare the weights for the products, after something else than a gradient step has changed them."""
        memory = self._memory
        size = len(memory.flat)
        grid = (triton.cdiv(size, steps.BLOCK),)
        steps.round_weights[grid](memory.flat, memory.weights, memory.source, size, BLOCK=steps.BLOCK)

    def gradients(self) -> list[Tensor]:
        """Return the gradients of the last minibatch before they were clipped, in the order of the parameters."""
        return self._memory.views(self._gradient)

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load as :class:`TorchPPO` does, into the memory of the kernels."""
        load_iteration = super().load(loaded_dict, load_cfg, strict)
        self._share_optimizer_state()
        return load_iteration

    def tensors(self) -> list[Tensor]:
        """Return the parameters, both moments and the number of steps."""
        return [self._memory.flat, self._moments, self._squares, self._adam_steps.view(1)]

    def _share_optimizer_state(self) -> None:
        """Take over the state of the optimizer, and let it be views of what the kernels use."""
        moments, squares = self._memory.views(self._moments), self._memory.views(self._squares)
        for parameter, moment, square in zip(self._parameters, moments, squares, strict=True):
            state = self.optimizer.state[parameter] or {"exp_avg": 0.0, "exp_avg_sq": 0.0, "step": 0.0}
            moment.copy_(torch.as_tensor(state["exp_avg"]))
            square.copy_(torch.as_tensor(state["exp_avg_sq"]))
            self._adam_steps.copy_(torch.as_tensor(state["step"]))
            self.optimizer.state[parameter] = {"step": self._adam_steps, "exp_avg": moment, "exp_avg_sq": square}

    def _run_networks(self, obs: TensorDict) -> None:
        """Compute the outputs of actor and critic in all worlds."""
        rows = aligned(self.storage.num_envs, SAMPLES)
        for inputs, model in zip(self._memory.inputs, self._models, strict=True):
            self._observe(inputs, [obs[group] for group in model.obs_groups], rows, None)
        self._forward(rows)

    def _observe(self, inputs: Columns, groups: Sequence[Tensor], num_rows: int, maps: Any) -> None:
        """Write the inputs of a network: groups of observations, with mirror images if there are maps for them."""
        column, memory = 0, self._memory
        for i, group in enumerate(groups):
            order, signs = maps[i] if maps else (group, group)
            target = (memory.place(inputs), inputs.block.width, column)
            counts = (self.batch_size, self._num_samples if maps else len(group), group.shape[1])
            columns = triton.next_power_of_2(group.shape[1])
            rows = max(1, min(samples.ROWS, samples.NUMBERS // columns))
            samples.observe[(num_rows // rows,)](
                group, self.indices, order, signs, memory.values, *target, *counts,
                CHOOSE=bool(maps), ROWS=rows, COLUMNS=columns, num_warps=8,
            )  # fmt: skip
            column += group.shape[1]

    def _forward(self, num_rows: int) -> None:
        """Compute the outputs of actor and critic from their inputs."""
        memory = self._memory
        for table, tile, has_outputs in memory.forward:
            arrays = (memory.values, memory.weights, memory.flat, memory.outputs, table)
            sizes = {"HAS_OUTPUTS": has_outputs, "SAMPLES": SAMPLES, "TILE": tile}
            settings = products.FORWARD if tile == TILE else products.NARROW
            self._product(products.forward, arrays, num_rows // SAMPLES, sizes | settings)

    def _product(self, kernel: Any, arguments: tuple, parts: int, settings: dict[str, int]) -> None:
        """Launch a matrix product of all tiles of a table, the last argument, for all parts of the samples."""
        num_tiles, columns = arguments[-1].shape
        kernel[num_tiles, parts](*arguments, COLUMNS=columns, STEP=ALIGNMENT, PRECISION="tf32", **settings)

    def _write_losses(self) -> None:
        """Compute losses and their gradients by the outputs."""
        memory, storage = self._memory, self.storage
        size = storage.actions.shape[-1]
        policy = (storage.actions, self._means, storage.actions_log_prob)
        values = (storage.values, storage.advantages, storage.returns)
        counts = (self.batch_size, self._num_samples, size)
        weights = (self.clip_param, self.value_loss_coef, self.entropy_weight, self.action_weights)
        sums = memory.loss_sums
        samples.losses[(len(sums),)](
            memory.outputs, *self._std[:3], self._stds, self.indices, *self._action_map, *policy, *values,
            self.actor_learns, memory.gradients, *self._places, sums, sums.shape[1], *counts, *weights,
            IS_LOG=self._std[3], CLIP_VALUES=self.use_clipped_value_loss, ROWS=LOSS_SAMPLES,
            COLUMNS=triton.next_power_of_2(size), num_warps=1,
        )  # fmt: skip

    def _weight_gradients(self) -> None:
        """Compute the gradient of all parameters from those of what the layers compute."""
        memory = self._memory
        parts, room = memory.partial.shape
        arguments = (memory.values, memory.gradients, memory.partial, memory.rows // parts, room, memory.weight_tiles)
        self._product(products.weight_gradient, arguments, parts, {"TILE": TILE} | products.BACKWARD)
        size = len(memory.flat)
        for sums, to in ((memory.loss_sums, memory.loss_destination), (memory.sums, memory.destination)):
            steps.sum_rows[(triton.cdiv(sums.shape[1], steps.COLUMNS),)](
                sums, *sums.shape, to, self._gradient, ROWS=steps.ROWS, COLUMNS=steps.COLUMNS, num_warps=8
            )
        steps.sum_parts[(triton.cdiv(size, steps.BLOCK),)](
            memory.partial, parts, room, memory.source, self._gradient, size, BLOCK=steps.BLOCK
        )

    def _step(self) -> None:
        """Clip the gradients and let Adam take a step, unless they are not finite."""
        memory = self._memory
        size, group = len(memory.flat), self.optimizer.param_groups[0]
        steps.sum_squares[(steps.PARTS,)](
            self._gradient, memory.actor_size, size, self._norms, PARTS=steps.PARTS, BLOCK=steps.BLOCK
        )
        beta1, beta2 = group["betas"]
        steps.prepare_adam_step[(1,)](
            self._numbers, self._norms, self.learning_rate, self.actor_learns, self._adam_steps, self._scalars,
            self.losses, self.max_grad_norm, self.kl_target, *self.learning_rates, math.log(beta1), math.log(beta2),
            ADAPTIVE=self.schedule == "adaptive", PARTS=steps.PARTS,
        )  # fmt: skip
        decay = group["weight_decay"] if isinstance(self.optimizer, torch.optim.AdamW) else 0.0
        steps.adam[(triton.cdiv(size, steps.BLOCK),)](
            memory.flat, self._gradient, self._moments, self._squares, memory.weights, memory.source,
            self._scalars, self.learning_rate, memory.actor_size, size,
            beta1, beta2, group["eps"], decay, BLOCK=steps.BLOCK,
        )  # fmt: skip

    def _mirror_map(self, name: str) -> tuple[Tensor, Tensor]:
        """Return order and signs of the mirror image of observations or actions; without images, of no change."""
        if self.symmetry:
            return self.symmetry.env.mirror.maps[name]
        size = (self.storage.actions if name == "actions" else self.storage.observations[name]).shape[-1]
        return torch.arange(size, device=self.device), torch.ones(size, device=self.device)

    def _deviation_settings(self) -> tuple[Any, float, float, bool]:
        """Return the parameter of the standard deviations, its range, and whether it is a logarithm."""
        distribution: Any = self.actor.distribution
        if distribution.std_type == "log":
            return distribution.log_std_param, *distribution.log_std_range, True
        return distribution.std_param, *distribution.std_range, False


def can_multiply(dtype: torch.dtype, device: str) -> bool:
    """Return whether a GPU multiplies bfloat16 and TF32, and has the shared memory that the tiles of a product take."""
    stages = max(settings["num_stages"] for settings in (products.FORWARD, products.BACKWARD))
    tiles = stages * (SAMPLES + TILE) * ALIGNMENT * dtype.itemsize
    properties = torch.cuda.get_device_properties(device)
    return properties.major >= 8 and tiles <= properties.shared_memory_per_multiprocessor
