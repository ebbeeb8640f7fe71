"""rsl_rl's PPO with an update that runs on the device from end to end."""

import contextlib
from itertools import zip_longest
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

from legged_torque.envs.base.symmetry import with_mirror_images
from legged_torque.learning.checkpoint import cloned
from legged_torque.learning.equivariance import MirroredWeights, are_known
from legged_torque.learning.protocols import Transition, annealed
from legged_torque.sim.graph import CudaGraph
from legged_torque.utils import distributed
from legged_torque.utils.errors import UserError, unknown_name

MIN_LEARNING_RATE = 1e-5  # lower bound of the adaptive learning rate, that of rsl_rl

LOSS_NAMES = ("value", "surrogate", "entropy", "kl", "gradient_norm", "critic_gradient_norm", "skipped_updates")
"""Losses of an update: means over the minibatches that were learned from, and the number of the others."""


class TorchPPO(PPO):
    """PPO whose epochs have fixed shapes and never wait for the host, so that each replays as a CUDA graph.

    The losses are rsl_rl's. The adaptive learning rate is a tensor. A minibatch whose gradient norm is not finite
    leaves the networks and the optimizer untouched and is counted. If a weight or a moment is not finite after an
    iteration, all its minibatches are undone and counted. Processes that train together learn from minibatches
    of their own and average gradients and KL divergence, so that all of them take the same step or skip it. As in
    rsl_rl, each normalizes the advantages of its own rollout. Networks may be equivariant, in place of learning from
    mirror images.

    Attributes:
        warm_up_iterations: Iterations at the start of a training in which only the critic learns.
        order: The samples of a rollout, in the order of an epoch. Shape: (batch_size * num_mini_batches,), int64.
        indices: Those of the minibatch that is learned from. Shape: (batch_size,), int64.
        update_graph: An epoch, which takes a gradient step on each minibatch of ``order``.
        action_weights: Weights of the actions in the entropy of our distribution. Shape: (num_actions,).
        product_dtype: Numbers that matrix products take; those of float32 may be TF32.
        mirrored: The mirror image of all parameters, of equivariant networks; else None.
    """

    capturable = True
    needs_next_obs = False
    warm_up_iterations = 0
    optimizer: torch.optim.Adam

    def __init__(
        self,
        actor: MLPModel,
        critic: MLPModel,
        storage: RolloutStorage,
        learning_rate: float = 1e-3,
        optimizer: str = "adam",
        max_learning_rate: float = 1e-2,
        annealing_start: float = 1.0,
        **kwargs,
    ) -> None:
        """Create the algorithm; arguments are rsl_rl's, a bound of the adaptive rate, and a share of the training.

        See :meth:`set_progress` for ``annealing_start``. A UserError names a setting that is not supported.
        """
        if optimizer not in ("adam", "adamw"):  # of these torch can skip a step on the device
            raise unknown_name("optimizer", optimizer, ["adam", "adamw"])
        if actor.is_recurrent or critic.is_recurrent:
            raise UserError(f"{type(self).__name__} does not support recurrent models")
        symmetry = dict(kwargs.pop("symmetry_cfg", None) or {})
        self.mirrored: MirroredWeights | None = None
        if symmetry.pop("use_equivariant_networks", False) and replaces_images(symmetry, actor, critic):
            with contextlib.suppress(UserError):  # an unknown mirror image is reported when training starts
                self.mirrored = MirroredWeights(actor, critic, symmetry["env"].mirror.maps)
        if not self.mirrored and symmetry and (symmetry["use_data_augmentation"] or symmetry["use_mirror_loss"]):
            kwargs["symmetry_cfg"] = symmetry
        super().__init__(actor, critic, storage, learning_rate=learning_rate, optimizer=optimizer, **kwargs)
        self.batch_size = max(storage.num_envs * storage.num_transitions_per_env // self.num_mini_batches, 1)
        self.learning_rates = (MIN_LEARNING_RATE, max_learning_rate)
        self.learning_rate = torch.tensor(learning_rate, device=self.device)
        self.annealing_start, self._first_rate = annealing_start, learning_rate
        self.kl_target = torch.tensor(self.desired_kl or 0.0, device=self.device)  # of the adaptive learning rate
        self.entropy_weight = torch.tensor(self.entropy_coef, device=self.device)
        self.action_weights = torch.ones(storage.actions.shape[-1], device=self.device)
        self.actor.distribution.weights = self.action_weights
        self._control_law: Any = None
        self._is_symmetric = True  # if networks shall be equivariant
        self._parts = [list(model.parameters()) for model in (self.actor, self.critic)]  # each is clipped by itself
        self._parameters = [*self._parts[0], *self._parts[1]]
        if self.mirrored:
            weights = self.mirrored.symmetric(parameters_to_vector(self._parameters))
            for parameter, part in zip(self._parameters, self._split(weights), strict=True):
                parameter.data.copy_(part)
        make_optimizer = type(self.optimizer)
        self.optimizer = make_optimizer(self._parameters, lr=self.learning_rate, fused=True, capturable=True)
        self.actor_learns = torch.ones((), device=self.device)
        self._skip = torch.zeros((), device=self.device)
        self.optimizer.found_inf = self._skip  # type: ignore[attr-defined] # where it is 1, a fused optimizer skips
        self.losses = torch.zeros(len(LOSS_NAMES), device=self.device)
        self.order = torch.zeros(self.batch_size * self.num_mini_batches, dtype=torch.long, device=self.device)
        self.indices = self.order[: self.batch_size]
        self.product_dtype = torch.float32
        self.update_graph = CudaGraph(self.update_epoch, self.device)

    @classmethod
    def construct_algorithm(cls, obs: TensorDict, env: Any, cfg: dict[str, Any], device: str) -> PPO:
        """Build the algorithm with its networks and storage, from settings in rsl_rl's layout."""
        if cfg["algorithm"].get("rnd_cfg"):
            raise UserError(f"{cls.__name__} does not support algorithm.rnd_cfg")
        algorithm = {**cfg["algorithm"], "class_name": cls.make}
        is_ours = cls.__module__.startswith("legged_torque.")  # a user's class may take gradient steps of its own
        if cfg["pretraining"]["function"] or not is_ours:  # pre-trained networks are not equivariant
            algorithm["symmetry_cfg"] = {**algorithm["symmetry_cfg"], "use_equivariant_networks": False}
        alg = PPO.construct_algorithm(obs, env, {**cfg, "algorithm": algorithm}, device)
        alg.update_graph.enabled = cfg["capture"]
        alg.warm_up_iterations = cfg["pretraining"]["critic_warmup_iterations"]
        if alg.warm_up_iterations and alg.optimizer.defaults["weight_decay"]:
            raise UserError("pretraining.critic_warmup_iterations needs the optimizer adam: adamw shrinks the actor")
        alg._control_law = getattr(env, "control_law", None)
        return alg

    @classmethod
    def make(cls, actor: MLPModel, critic: MLPModel, storage: RolloutStorage, **settings: Any) -> "TorchPPO":
        """Return the algorithm for networks, storage and settings; subclasses may choose between several."""
        return cls(actor, critic, storage, **settings)

    # ---- for the trainer, see protocols.Learner --------------------------------------------------------------------

    def allocate(self) -> None:
        """Raise a UserError if a rollout has fewer samples than minibatches, or networks have lost their symmetry.

        A policy that only plays needs neither.
        """
        self._check_symmetry()
        worlds, steps = self.storage.num_envs, self.storage.num_transitions_per_env
        if worlds * steps < self.num_mini_batches:
            raise UserError(
                f"algorithm.num_mini_batches is {self.num_mini_batches}, more than the samples of a rollout "
                f"({worlds} worlds x {steps} steps)"
            )

    def _check_symmetry(self) -> None:
        """Raise a UserError if networks were loaded that are not equivariant, but should be."""
        if not self._is_symmetric:
            setting = "algorithm.symmetry_cfg.use_equivariant_networks=false"
            raise UserError(f"the checkpoint's networks are not equivariant: they need --set {setting}")

    def observe(self, transition: Transition) -> None:
        """Keep what followed the actions, and compute returns after the last step of a rollout."""
        after = transition.obs_after
        self.process_env_step(after, transition.rewards, transition.dones, transition.extras)
        if self.storage.step == self.storage.num_transitions_per_env:
            self.compute_returns(after)

    def due(self) -> bool:
        """Return that an update is due: the storage holds one rollout."""
        return True

    def set_progress(self, iteration: int, num_iterations: int) -> None:
        """Prepare the update of an iteration: the critic learns alone at first, and the last updates are small.

        After the share ``annealing_start`` of the training, the weight of the entropy and the desired KL divergence
        fall linearly to 0. The adaptive learning rate follows the latter; a fixed learning rate falls itself. Actions
        count in the entropy by the weights of their torques: without effect, they would become ever more random.
        """
        self.actor_learns.fill_(float(iteration >= self.warm_up_iterations))
        left = annealed(iteration, num_iterations, self.annealing_start)
        self.entropy_weight.fill_(left * self.entropy_coef)
        if self._control_law:
            self.action_weights.copy_(self._control_law.weights().clamp(0.0, 1.0))
        if self.schedule == "adaptive":
            self.kl_target.fill_(left * self.desired_kl)
        else:
            self.learning_rate.fill_(left * self._first_rate)

    def policy(self) -> MLPModel:
        """Return the actor."""
        return self.get_policy()

    def state_dict(self) -> dict[str, Any]:
        """Return what rsl_rl saves, each tensor in memory of its own."""
        return cloned(self.save())

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load all parts of a :meth:`state_dict`."""
        self.load(state, None, True)

    def close(self) -> None:
        """Free the graph of the update: NCCL waits for the end of graphs with its work in them."""
        self.update_graph.reset()

    # ---- rsl_rl's methods --------------------------------------------------------------------------------------------

    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions and keep the transition, with a copy of observations that a task may overwrite in its step."""
        return super().act(obs.clone())

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages (GAE) in place, with rsl_rl's formulas."""
        advantages = self.storage.advantages
        super().compute_returns(obs)
        self.storage.advantages = advantages.copy_(self.storage.advantages)

    def update(self) -> dict[str, float]:
        """Learn from the rollout in random order, epoch by epoch.

        Returns:
            :data:`LOSS_NAMES` over all processes, "learning_rate", "action_std" and "all_skipped", see
            :class:`~legged_torque.learning.protocols.Learner`.
        """
        self.allocate()  # of a training that keeps no run
        self.losses.zero_()
        before = [tensor.clone() for tensor in self.tensors()]
        for _ in range(self.num_learning_epochs):
            torch.randperm(len(self.order), out=self.order)
            self.update_graph()
        self._update_normalization()
        self.storage.clear()
        is_finite = torch.cat([tensor.flatten() for tensor in self.tensors()]).isfinite().all()
        numbers = torch.cat([self.losses, is_finite.float().unsqueeze(0)])
        if self.is_multi_gpu:
            distributed.average([numbers])
        *values, share_finite = numbers.tolist()  # the only time that the host waits
        losses = dict(zip(LOSS_NAMES, values, strict=True))
        num_updates = self.num_learning_epochs * self.num_mini_batches
        if share_finite < 1.0:  # in any process
            for tensor, old in zip_longest(self.tensors(), before):
                tensor.zero_() if old is None else tensor.copy_(old)  # there are no moments before the first step
            losses = dict.fromkeys(LOSS_NAMES, 0.0) | {"skipped_updates": float(num_updates)}
        updates = num_updates - losses["skipped_updates"]
        means = {name: loss if name == "skipped_updates" else loss / max(updates, 1) for name, loss in losses.items()}
        policy = {"learning_rate": self.learning_rate.item(), "action_std": self.action_std().mean().item()}
        return {**means, **policy, "all_skipped": updates <= 0}

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load as rsl_rl does, and keep the learning rate the tensor that it was.

        A UserError if learning goes on with equivariant networks and those of the checkpoint are not; after a part of
        it was loaded, where learning begins.
        """
        learning_rate = self.learning_rate
        load_iteration = super().load(loaded_dict, load_cfg, strict)
        weights = parameters_to_vector(self._parameters)
        self._is_symmetric = not self.mirrored or self.mirrored.is_symmetric(weights)
        if load_cfg is None:
            self._check_symmetry()
        self.learning_rate = learning_rate.copy_(torch.as_tensor(self.learning_rate))
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        self.update_graph.reset()  # the optimizer's tensors are new
        return load_iteration

    def action_std(self) -> Tensor:
        """Return the standard deviations of the actions that were sampled last. Shape: (..., num_actions)."""
        return self.actor.output_std

    def tensors(self) -> list[Tensor]:
        """Return the weights, and moments and counters of the optimizer, which exist from its first step on."""
        kept = [value for entry in self.optimizer.state.values() for value in entry.values()]
        return [*(parameter.data for parameter in self._parameters), *kept]

    def _update_normalization(self) -> None:
        """Let models that normalize observations learn from the rollout; graphs need the tensors to stay the same."""
        observations = self.storage.observations.flatten(0, 1)
        for model in (self.actor, self.critic):
            if model.obs_normalization:
                std = model.obs_normalizer._std
                model.update_normalization(observations)  # from the rollouts of all processes
                model.obs_normalizer._std = std.copy_(model.obs_normalizer._std)

    def loss(self) -> tuple[Tensor, Tensor]:
        """Return the loss of the samples of ``indices`` with torch's operations, and the first four LOSS_NAMES."""
        batch = self._gather()
        if self.symmetry:
            self.symmetry.augment_batch(batch, self.batch_size)
        self.actor(batch.observations, stochastic_output=True)
        return self._losses(batch, self.critic(batch.observations))

    def _losses(self, batch: RolloutStorage.Batch, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return what :meth:`loss` does, from the samples, their values and the actor's distribution of actions."""
        log_prob = self.actor.get_output_log_prob(batch.actions)
        entropy = self.actor.output_entropy.flatten()[: self.batch_size].mean()  # without mirror images, as in rsl_rl
        with torch.no_grad():  # from the policy that acted, without mirror images
            params = tuple(params[: self.batch_size] for params in self.actor.output_distribution_params)
            kl = self.actor.get_kl_divergence(batch.old_distribution_params, params).mean()
        ratio = torch.exp(log_prob - batch.old_actions_log_prob.squeeze(1))
        advantages = batch.advantages.squeeze(1)
        clipped_ratio = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate_loss = torch.max(-advantages * ratio, -advantages * clipped_ratio).mean()
        error = (values - batch.returns).square()
        if self.use_clipped_value_loss:
            change = (values - batch.values).clamp(-self.clip_param, self.clip_param)
            error = torch.max(error, (batch.values + change - batch.returns).square())
        value_loss = error.mean()
        actor_loss = surrogate_loss - self.entropy_weight * entropy
        if self.symmetry and self.symmetry.use_mirror_loss:
            mirror_loss = self.symmetry.compute_loss(self.actor, batch, self.batch_size)
            actor_loss = actor_loss + self.symmetry.mirror_loss_coeff * mirror_loss
        loss = self.actor_learns * actor_loss + self.value_loss_coef * value_loss
        return loss, torch.stack([value_loss, surrogate_loss, entropy, kl]).detach()

    def update_epoch(self) -> None:
        """Take one gradient step on each minibatch of the samples in ``order``."""
        for indices in self.order.split(self.batch_size):
            self.indices = indices
            self.update_minibatch()

    def update_minibatch(self) -> None:
        """Take one gradient step on the samples of ``indices``."""
        loss, numbers = self.loss()
        kl = numbers[3]
        for parameter in self._parameters:  # as zero_grad() does, which takes longer
            parameter.grad = None
        loss.backward()
        if self.is_multi_gpu:
            distributed.average([*(parameter.grad for parameter in self._parameters if parameter.grad is not None), kl])
        if self.mirrored:
            gradient = torch.cat([parameter.grad.flatten() for parameter in self._parameters])
            for parameter, part in zip(self._parameters, self._split(self.mirrored.averaged(gradient)), strict=True):
                parameter.grad = part
        if self.schedule == "adaptive":
            lower = kl > 2.0 * self.kl_target
            higher = (kl < 0.5 * self.kl_target) & (kl > 0.0)
            factor = torch.where(lower, 1.0 / 1.5, torch.where(higher, 1.5, 1.0))
            factor = torch.where(self.actor_learns.bool(), factor, 1.0)  # a fixed policy has no divergence
            self.learning_rate.mul_(factor).clamp_(*self.learning_rates)
        norms = torch.stack([nn.utils.clip_grad_norm_(part, self.max_grad_norm) for part in self._parts])
        gradient_norm = torch.linalg.vector_norm(norms)
        self._skip.copy_(~torch.isfinite(gradient_norm))
        self.optimizer.step()
        numbers = torch.cat([numbers, torch.stack([gradient_norm, norms[1]])])
        kept = torch.where(self._skip.bool(), 0.0, numbers)
        self.losses += torch.cat([kept, self._skip.unsqueeze(0)])

    def _split(self, values: Tensor) -> list[Tensor]:
        """Return numbers, one per parameter, in the shapes of the parameters."""
        parts = values.split([parameter.numel() for parameter in self._parameters])
        return [part.view_as(parameter) for part, parameter in zip(parts, self._parameters, strict=True)]

    def _gather(self) -> RolloutStorage.Batch:
        """Return the samples of ``indices`` from the stored rollout."""
        storage = self.storage
        batch = self._gather_results(self._pick(storage.actions))
        groups = {key: self._pick(value) for key, value in storage.observations.items()}
        batch.observations = TensorDict(groups, [len(self.indices)])
        if self.normalize_advantage_per_mini_batch:
            advantages = batch.advantages
            batch.advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        return batch

    def _gather_results(self, actions: Tensor, images: int = 1) -> RolloutStorage.Batch:
        """Return samples without observations: their actions, and what is the same for so many images of each."""
        storage = self.storage
        columns = (storage.actions_log_prob, storage.values, storage.advantages, storage.returns)
        log_prob, values, advantages, returns = (self._pick(column).repeat(images, 1) for column in columns)
        return RolloutStorage.Batch(
            actions=actions,
            values=values,
            advantages=advantages,
            returns=returns,
            old_actions_log_prob=log_prob,
            old_distribution_params=tuple(self._pick(params) for params in storage.distribution_params),
        )

    def _pick(self, tensor: Tensor) -> Tensor:
        """Return the rows of ``indices`` of what is stored for all steps and worlds."""
        return tensor.flatten(0, 1).index_select(0, self.indices)


def replaces_images(symmetry: dict[str, Any], actor: MLPModel, critic: MLPModel) -> bool:
    """Return whether equivariant networks can replace the mirror images that settings want."""
    wanted = symmetry["use_data_augmentation"] and not symmetry["use_mirror_loss"]
    is_ours = resolve_callable(symmetry["data_augmentation_func"]) is with_mirror_images
    return wanted and is_ours and are_known(actor, critic)
