"""FlashSAC (arXiv 2604.04539): soft actor-critic for thousands of worlds, with few and large gradient steps.

The names of settings are those of rsl_rl_flashsac, https://github.com/Holiday-Robot/rsl_rl_flashsac.
"""

import copy
import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from rsl_rl.extensions import Symmetry
from tensordict import TensorDict
from torch import Tensor, nn

from legged_torque.learning.checkpoint import cloned
from legged_torque.learning.flashsac.exploration import RepeatedNoise
from legged_torque.learning.flashsac.networks import FlashSACActor, FlashSACCritic, bound_weights
from legged_torque.learning.flashsac.replay import Batch, Replay
from legged_torque.learning.flashsac.returns import RewardScale, lower_of, projected
from legged_torque.learning.protocols import Transition
from legged_torque.sim.compiled import compiled
from legged_torque.sim.graph import CudaGraph
from legged_torque.utils.errors import UserError

OF_ACTOR = ("actor", "entropy", "action_std", "actor_gradient_norm")
NUMBERS = {"actor": OF_ACTOR, "critic": ("critic", "critic_gradient_norm")}
"""What is logged of the gradient steps of critic and actor: means over those that were made."""


class FlashSAC:
    """The learner; a gradient step has fixed shapes and never waits for the host, so that it replays as a CUDA graph.

    Soft actor-critic (arXiv 1812.05905) with two critics that predict distributions, the networks of
    :mod:`~legged_torque.learning.flashsac.networks`, scaled rewards, repeated noise, and returns of several steps.
    Actions are uniform until the first update. A gradient step whose norm is not finite leaves the network and its
    optimizer untouched and is counted.

    Attributes:
        actor: The policy.
        critic: Both critics.
        target: Their copies, with which returns go on. Weights follow slowly; normalizations see every batch.
        log_temperature: Logarithm of the weight of the entropy.
        replay: Past steps.
        reward_scale: What rewards are divided by.
        symmetry: rsl_rl's extension that adds mirror images to samples, or None.
        num_updates: Gradient steps so far.
        graphs: The gradient steps with and without the actor.
        uses_bfloat16: Whether losses multiply matrices of bfloat16 numbers; all else is float32.
    """

    capturable = True
    needs_next_obs = True

    def __init__(
        self,
        actor: FlashSACActor,
        critic: FlashSACCritic,
        replay: Replay,
        settings: dict[str, Any],
        gamma: float,
        steps_per_rollout: int,
        symmetry: Symmetry | None = None,
    ) -> None:
        """Create the learner.

        Args:
            actor: The policy.
            critic: Both critics.
            replay: Where steps are kept.
            settings: The section ``flashsac``.
            gamma: Discount of a control step.
            steps_per_rollout: Control steps between two updates.
            symmetry: Adds mirror images to samples.
        """
        self.actor, self.critic, self.target = actor, critic, copy.deepcopy(critic).requires_grad_(False)
        self.replay, self.settings, self.gamma, self.symmetry = replay, settings, gamma, symmetry
        self.updates_per_rollout: int = steps_per_rollout * settings["updates_per_step"]
        device, num_actions = replay.device, replay.num_actions
        mu, most_steps = settings["actor_noise_zeta_mu"], settings["actor_noise_zeta_max"]
        self.noise = RepeatedNoise(replay.num_envs, num_actions, mu, most_steps, device)
        self.reward_scale = RewardScale(gamma, settings["normalized_g_max"]).to(device)
        self.returns = torch.zeros(replay.num_envs, device=device)  # of the present episodes so far
        self.target_entropy = 0.5 * num_actions * math.log(2.0 * math.pi * math.e * settings["temp_target_sigma"] ** 2)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(settings["temp_initial_value"]), device=device))
        self.learning_rate = torch.tensor(settings["learning_rate_peak"], device=device)
        learned = {"actor": [*actor.parameters(), self.log_temperature], "critic": [*critic.parameters()]}
        self.optimizers = {
            name: torch.optim.Adam(parameters, lr=self.learning_rate, fused=True, capturable=True)
            for name, parameters in learned.items()
        }
        self._skip = torch.zeros((), device=device)
        for optimizer in self.optimizers.values():
            optimizer.found_inf = self._skip  # type: ignore[attr-defined] # where it is 1, a fused optimizer skips
        self._sums = {name: torch.zeros(len(names) + 1, device=device) for name, names in NUMBERS.items()}
        self._acts_at_random = torch.ones((), dtype=torch.bool, device=device)
        self.num_updates = 0
        steps = {learns: functools.partial(self.take_gradient_step, learns) for learns in (True, False)}
        self.graphs = {learns: CudaGraph(step, device) for learns, step in steps.items()}
        self._parts: dict[str, Callable] = {
            "act": self._random_actions,
            "remember": self._remember,
            "sample": self._sample,
        }
        self._parts |= {"actor": self.actor_loss, "critic": self.critic_loss, "bound": bound_weights}
        self.uses_bfloat16 = False

    @classmethod
    def construct_algorithm(cls, obs: TensorDict, env: Any, cfg: dict[str, Any], device: str) -> "FlashSAC":
        """Build the learner from settings in rsl_rl's layout; a UserError names one that is not supported."""
        settings, groups, algorithm = cfg["flashsac"], cfg["obs_groups"], cfg["algorithm"]
        mirroring = dict(algorithm["symmetry_cfg"])
        mirroring.pop("use_equivariant_networks", None)  # of PPO
        if cfg["pretraining"]["function"]:
            raise UserError("FlashSAC does not support pretraining.function: it starts from random networks")
        if mirroring["use_mirror_loss"]:
            raise UserError("FlashSAC does not support algorithm.symmetry_cfg.use_mirror_loss")
        bound, largest = settings["action_bound"], settings["normalized_g_max"]
        actor = FlashSACActor(obs, groups, "actor", env.num_actions, bound, **settings["actor"]).to(device)
        critic = FlashSACCritic(obs, groups, "critic", env.num_actions, largest, **settings["critic"]).to(device)
        kept, dtype = {*actor.obs_groups, *critic.obs_groups}, getattr(torch, settings["buffer_obs_dtype"])
        replay = Replay(obs, sorted(kept), env.num_actions, settings["replay_buffer_size"], dtype, device)
        symmetry = Symmetry(env, **mirroring) if mirroring["use_data_augmentation"] else None
        alg = cls(actor, critic, replay, settings, algorithm["gamma"], cfg["num_steps_per_env"], symmetry)
        for graph in alg.graphs.values():
            graph.enabled = cfg["capture"]
        alg.compile()
        alg.uses_bfloat16 = algorithm["use_mixed_precision"] and torch.device(device).type == "cuda"
        return alg

    def compile(self) -> None:
        """Let its parts run as few kernels, where they can be compiled."""
        device, learned = self.replay.device, ("actor", "critic", "bound")
        self._parts = {name: compiled(part, device, learns=name in learned) for name, part in self._parts.items()}

    # ---- for the trainer, see protocols.Learner --------------------------------------------------------------------

    def allocate(self) -> None:
        """Make room for the replay; a UserError if sizes do not fit each other, or the device has too little."""
        least, most = self.settings["buffer_min_length"], self.settings["replay_buffer_size"]
        lowest = (self.settings["n_steps"] + 1) * self.replay.num_envs
        if not lowest <= least <= most:
            raise UserError(
                f"flashsac.buffer_min_length must be from {lowest} (n_steps + 1 in {self.replay.num_envs} worlds) to "
                f"flashsac.replay_buffer_size, {most}, not {least}"
            )
        self.replay.allocate()

    def act(self, obs: TensorDict) -> Tensor:
        """Return random actions in the task's units. Shape: (num_envs, num_actions)."""
        return self._parts["act"](obs)

    def _random_actions(self, obs: TensorDict) -> Tensor:
        """Return random actions for :meth:`act`."""
        mean, std = self.actor.distribution(obs, learning=False)
        uniform = 2.0 * torch.rand_like(mean) - 1.0
        actions = torch.tanh(mean + std * self.noise.next())
        return self.actor.action_bound * torch.where(self._acts_at_random, uniform, actions)

    def observe(self, transition: Transition) -> None:
        """Keep a step, and let the scale of rewards follow it."""
        self.allocate()  # of a training that keeps no run
        self._parts["remember"](transition)

    def _remember(self, transition: Transition) -> None:
        """Keep a step for :meth:`observe`."""
        self.reward_scale.follow(self.returns, transition.rewards, transition.dones)
        self.replay.add(transition, transition.actions / self.actor.action_bound)

    def due(self) -> bool:
        """Return whether the replay holds ``buffer_min_length`` steps."""
        return int(self.replay.count) * self.replay.num_envs >= self.settings["buffer_min_length"]

    def set_progress(self, iteration: int, num_iterations: int) -> None:
        """Let the learning rate fall along a cosine, from ``learning_rate_peak`` to ``learning_rate_end``."""
        peak, end = self.settings["learning_rate_peak"], self.settings["learning_rate_end"]
        self.learning_rate.fill_(end + (peak - end) * 0.5 * (1.0 + math.cos(math.pi * iteration / num_iterations)))

    def update(self) -> dict[str, float]:
        """Take ``updates_per_step`` gradient steps for each control step of the rollout.

        Returns:
            Means of :data:`NUMBERS`, "temperature", "reward_scale", "learning_rate", "skipped_updates", "all_skipped".
        """
        for sums in self._sums.values():
            sums.zero_()
        self._acts_at_random.fill_(False)
        made = {"critic": self.updates_per_rollout, "actor": 0}
        for _ in range(self.updates_per_rollout):
            actor_learns = self.num_updates % self.settings["actor_update_period"] == 0
            self.graphs[actor_learns]()
            self.num_updates += 1
            made["actor"] += actor_learns
        numbers = {"temperature": float(self.log_temperature.detach().exp())}  # here the host waits for the first time
        numbers |= {"reward_scale": float(self.reward_scale.scale()), "learning_rate": float(self.learning_rate)}
        skipped = 0.0
        for name, names in NUMBERS.items():
            *totals, kept = self._sums[name].tolist()
            skipped += made[name] - kept
            if kept:
                numbers |= {key: total / kept for key, total in zip(names, totals, strict=True)}
        return {**numbers, "skipped_updates": skipped, "all_skipped": skipped == sum(made.values())}

    def policy(self) -> FlashSACActor:
        """Return the actor."""
        return self.actor

    def close(self) -> None:
        """Free the graphs."""
        for graph in self.graphs.values():
            graph.reset()

    # ---- learning ----------------------------------------------------------------------------------------------------

    def take_gradient_step(self, actor_learns: bool) -> None:
        """Draw samples; let the actor learn from them, if it does, then the critic; let the target follow."""
        batch = self._parts["sample"]()
        if actor_learns:
            self._descend("actor", batch, self.actor)
        self._descend("critic", batch, self.critic)
        slow, fast = list(self.target.parameters()), [parameter.detach() for parameter in self.critic.parameters()]
        torch._foreach_lerp_(slow, fast, self.settings["critic_target_update_tau"])  # type: ignore[arg-type]

    def _sample(self) -> Batch:
        """Return ``mini_batch_size`` samples, and their mirror images if symmetry is used."""
        batch = self.replay.sample(self.settings["mini_batch_size"], self.settings["n_steps"], self.gamma)
        if self.symmetry is None:
            return batch
        env, add_images = self.symmetry.env, self.symmetry.data_augmentation_func
        obs, actions = add_images(env=env, obs=batch.obs, actions=batch.actions)
        next_obs, _ = add_images(env=env, obs=batch.next_obs, actions=None)
        times = len(obs) // len(batch.obs)
        rewards, discounts, weights = (part.repeat(times) for part in (batch.rewards, batch.discounts, batch.weights))
        return Batch(obs, actions, rewards, discounts, next_obs, weights)

    def actor_loss(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the loss of actor and temperature, and the first of its :data:`NUMBERS`.

        The actor is to earn much by the lower critic and to be random; the temperature falls while the entropy is
        above its target, that of a normal distribution of ``temp_target_sigma``. The normalizations see the following
        observations, too, as those of the critic do (CrossQ, arXiv 1902.05605).
        """
        size = len(batch.obs)
        both: Any = torch.cat([batch.obs, batch.next_obs])
        actions, log_density, std = self.actor.sample(both, learning=True)
        actions, log_density = actions[:size], log_density[:size]
        _, earned = self.critic(batch.obs, actions, learning=False)
        temperature, entropy = self.log_temperature.exp(), -log_density.mean()
        loss = (temperature.detach() * log_density - torch.minimum(*earned)).mean()
        of_temperature = temperature * (entropy.detach() - self.target_entropy)
        action_std = self.actor.action_bound * std[:size].mean()
        return loss + of_temperature, torch.stack([loss, entropy, action_std]).detach()

    def critic_loss(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return the cross-entropy of both critics with the distribution that they are to have, and itself."""
        size = len(batch.obs)
        with torch.no_grad():
            next_actions, log_density, _ = self.actor.sample(batch.next_obs, learning=False)
            obs: Any = torch.cat([batch.obs, batch.next_obs])
            actions = torch.cat([batch.actions, next_actions])
            log_probs, means = self.target(obs, actions, learning=True)
            following = lower_of(log_probs[:, size:], means[:, size:]).exp()
            soft_values = self.critic.values - (self.log_temperature.exp() * log_density).unsqueeze(1)
            rewards = (batch.rewards / self.reward_scale.scale()).unsqueeze(1)
            wanted = projected(following, rewards + batch.discounts.unsqueeze(1) * soft_values, self.critic.values)
        log_probs, _ = self.critic(obs, actions, learning=True)
        cross_entropy = -(wanted * log_probs[:, :size]).sum(dim=-1).mean(dim=0)
        loss = (batch.weights * cross_entropy).sum() / batch.weights.sum()
        return loss, loss.detach().unsqueeze(0)

    def _descend(self, name: str, batch: Batch, network: nn.Module) -> None:
        """Take a step of the optimizer ``name``, bound the weights of its network, and sum up the loss's numbers."""
        with torch.autocast("cuda", torch.bfloat16, enabled=self.uses_bfloat16):
            loss, numbers = self._parts[name](batch)
        optimizer = self.optimizers[name]
        parameters = optimizer.param_groups[0]["params"]
        optimizer.zero_grad()
        loss.backward(inputs=parameters)
        norm = nn.utils.get_total_norm([parameter.grad for parameter in parameters])
        self._skip.copy_(~torch.isfinite(norm))
        optimizer.step()
        self._parts["bound"](network)
        made = 1.0 - self._skip
        all_numbers = torch.cat([numbers, torch.stack([norm, made])])
        self._sums[name] += torch.where(self._skip.bool(), 0.0, all_numbers)

    # ---- state -------------------------------------------------------------------------------------------------------

    def _networks(self) -> dict[str, nn.Module]:
        """Return the networks and statistics by the names of their states."""
        networks = {"actor": self.actor, "critic": self.critic, "critic_target": self.target}
        return {**networks, "reward_scale": self.reward_scale}

    def state_dict(self) -> dict[str, Any]:
        """Return all but the replay and what belongs to worlds, each tensor in memory of its own."""
        parts: dict[str, Any] = {f"{name}_optimizer": part for name, part in self.optimizers.items()}
        parts |= self._networks()
        state: dict[str, Any] = {f"{name}_state_dict": part.state_dict() for name, part in parts.items()}
        state |= {"log_temperature": self.log_temperature.detach(), "num_updates": self.num_updates}
        return cloned(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load all parts of a :meth:`state_dict`."""
        self.load(state, None, True)

    def load(self, state: dict[str, Any], load_cfg: dict[str, bool] | None, strict: bool) -> bool:
        """Load parts of a :meth:`state_dict`, as rsl_rl does, and return whether to go on from its iteration.

        ``load_cfg`` may choose "actor" and "iteration"; None loads everything.
        """
        if load_cfg is not None:
            if load_cfg.get("actor"):
                self.actor.load_state_dict(state["actor_state_dict"], strict)
            return load_cfg.get("iteration", False)
        for name, network in self._networks().items():
            network.load_state_dict(state[f"{name}_state_dict"], strict)
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state[f"{name}_optimizer_state_dict"])
            self.learning_rate.copy_(optimizer.param_groups[0]["lr"])
            optimizer.param_groups[0]["lr"] = self.learning_rate  # the one tensor of both
        self.log_temperature.data.copy_(state["log_temperature"])
        self.num_updates = state["num_updates"]
        self._acts_at_random.fill_(self.num_updates == 0)
        self.close()  # the optimizers' tensors are new
        return True

    def world_state_dict(self) -> dict[str, Any]:
        """Return what belongs to the worlds: noise, returns, and with ``save_replay`` the replay."""
        state: dict[str, Any] = {"returns": self.returns, "noise": self.noise.tensors()}
        return state | ({"replay": self.replay.state_dict()} if self.settings["save_replay"] else {})

    def load_world_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`world_state_dict`; a line says so if it has no replay."""
        if "replay" in state:
            self.replay.load_state_dict(state["replay"])
        else:
            least = self.settings["buffer_min_length"]
            print(f"The replay starts empty, flashsac.save_replay was off: learning goes on after {least} steps.")
        self.returns.copy_(state["returns"])
        for name, tensor in self.noise.tensors().items():
            tensor.copy_(state["noise"][name])
