"""The interfaces between the trainer, what learns, and the task in which it learns."""

from dataclasses import dataclass
from typing import Any, Protocol

from tensordict import TensorDict
from torch import Tensor, nn

from legged_torque.sim.health import Watched
from legged_torque.utils.errors import UserError


@dataclass(frozen=True)
class Transition:
    """One control step in every world, in tensors that the next step may overwrite: copy what is kept.

    Attributes:
        obs: Observations from which the actions were chosen. Shape: (num_envs, size) per group.
        actions: Shape: (num_envs, num_actions).
        rewards: Shape: (num_envs,).
        dones: Worlds whose episode has ended. Shape: (num_envs,), bool.
        time_outs: Those of them whose time was over, if the task reports them. Shape: (num_envs,), bool.
        obs_after: Observations from which the next actions are chosen, in ended worlds those of the new episode.
        next_obs: Observations before any reset, for a learner with ``needs_next_obs``; otherwise None.
        extras: All else that the task's step has returned.
    """

    obs: TensorDict
    actions: Tensor
    rewards: Tensor
    dones: Tensor
    time_outs: Tensor | None
    obs_after: TensorDict
    next_obs: TensorDict | None
    extras: dict[str, Any]


class Stateful(Protocol):
    """An object with a state that files keep."""

    def state_dict(self) -> dict[str, Any]:
        """Return tensors and plain values, in nested dictionaries."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`, which may have further entries."""


class Learner(Stateful, Protocol):
    """A reinforcement learning algorithm, built by ``construct_algorithm(obs, env, cfg, device)`` as in rsl_rl.

    Tensors of its :meth:`state_dict` have memory of their own. Some methods are optional. ``allocate()`` takes or
    refuses what only training needs, before the run's folder is made. ``set_progress(iteration, num_iterations)`` is
    called before each update. ``broadcast_parameters()`` gives all processes the parameters of the first one; a learner
    without it trains in one process only. ``world_state_dict()`` and ``load_world_state_dict(state)`` are for what
    belongs to the worlds, such as a replay: only the newest checkpoint keeps it. ``close()`` is called when training is
    over.

    Attributes:
        capturable: Whether :meth:`act` and :meth:`observe` may be captured in a CUDA graph: fixed shapes and addresses,
            and no wait for the host. Their Python code then runs for the first two rollouts only.
        needs_next_obs: Whether transitions need observations before resets, which cost the task time.
    """

    capturable: bool
    needs_next_obs: bool

    def act(self, obs: TensorDict) -> Tensor:
        """Return the actions of all worlds, with exploration. Shape: (num_envs, num_actions)."""

    def observe(self, transition: Transition) -> None:
        """Keep what followed the last actions."""

    def due(self) -> bool:
        """Return whether to update now; asked after each rollout of ``runner.num_steps_per_env`` steps."""

    def update(self) -> dict[str, Any]:
        """Learn, and return numbers or scalar tensors to be logged as losses.

        Some names have a meaning: "learning_rate"; "action_std", the mean standard deviation of actions;
        "skipped_updates", gradient steps that were not made since numbers were not finite; "all_skipped", true if
        none was made.
        """

    def policy(self) -> nn.Module:
        """Return the network from observations to mean actions, always the same object."""


class EpisodeLog(Protocol):
    """Sums over the steps of a task."""

    def read(self, max_episode_length_s: float) -> dict[str, float]:
        """Return means since the last call, with "return" and "length" [steps] of ended episodes if there are any."""


class Health(Protocol):
    """Counts of numbers that were not finite."""

    def read(self) -> tuple[float, dict[Watched, int]]:
        """Return the share of worlds that have diverged since the last call, and resets by tensor that caused them."""


class Task(Stateful, Protocol):
    """A batch of worlds, with the counters that a checkpoint keeps as its state.

    Some methods are optional. ``make_evaluation(num_envs, perturbation)`` returns an :class:`Evaluation`; without it,
    ``evaluation.interval`` must be 0. ``control_law.weights()`` are those of actions in PPO's entropy. Worlds of a task
    with these three go on in a resumed training, others start anew: ``identity()`` returns "settings" by dotted path
    and hashes by what they are of, which must not change, as plain values; ``world_state_dict()`` and
    ``load_world_state_dict(state)`` are for tensors, in nested dictionaries.

    Attributes:
        device: "cpu" or "cuda:N".
        dt: Length of a control step [s].
        max_episode_length: Length of an episode [steps].
        num_processes: Processes that train together, set by the trainer.
        total_steps: Steps so far over all worlds of all processes. Scalar, int64.
        episode_length_buf: Steps since the start of each world's episode. Shape: (num_envs,), int64.
    """

    num_envs: int
    num_actions: int
    device: str
    dt: float
    max_episode_length: int
    num_processes: int
    total_steps: Tensor
    episode_length_buf: Tensor
    log: EpisodeLog
    health: Health

    def get_observations(self) -> TensorDict:
        """Return the current observations."""

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Return observations, rewards, dones and extras: "time_outs", and "final_observations" if they are kept."""

    def compile(self) -> None:
        """Prepare for speed; called before each rollout."""

    def update_curriculum(self) -> None:
        """Change what may change between rollouts only; called before each of them."""

    def curriculum_values(self) -> dict[str, Tensor]:
        """Return scalars of curricula to be logged."""

    def check_buffers(self) -> str | None:
        """Return a warning if the simulation has dropped anything; called with each checkpoint."""


class Evaluation(Protocol):
    """Worlds of their own in which a policy is measured while it trains.

    Attributes:
        task: The worlds, a :class:`Task` that keeps its worlds, which should not all time out at once.
    """

    task: Any

    def step(self, actions: Tensor) -> TensorDict:
        """Make a step, count it, and return the observations; may be captured in a CUDA graph."""

    def clear(self) -> None:
        """Forget the steps so far."""

    def means(self) -> dict[str, float]:
        """Return the metrics of the steps so far."""

    def levels(self) -> dict[str, float]:
        """Return the present levels of the curricula of the training's ground."""


def annealed(iteration: int, num_iterations: int, start: float) -> float:
    """Return 1 until the share ``start`` of a training is over, and from then on what falls linearly to 0."""
    return min(1.0, (1.0 - iteration / num_iterations) / max(1.0 - start, 1e-9))


def check_methods(learner: type) -> None:
    """Raise a UserError if a class lacks methods of a :class:`Learner`."""
    methods = (name for name in ["construct_algorithm", *vars(Learner), *vars(Stateful)] if name[0] != "_")
    if missing := [name for name in methods if not callable(getattr(learner, name, None))]:
        raise UserError(f"algorithm.class_name: {learner.__name__} is no learner, it lacks {', '.join(missing)}")


def check_learner(alg: Any, env: Any, num_processes: int) -> None:
    """Raise a UserError if an object is no :class:`Learner`, or needs what the task or several processes lack."""
    check_methods(type(alg))
    name = type(alg).__name__
    if missing := [attribute for attribute in Learner.__annotations__ if not hasattr(alg, attribute)]:
        raise UserError(f"{name} lacks {', '.join(missing)}")
    if not callable(alg.policy()):
        raise UserError(f"{name}.policy must return what computes actions, not {alg.policy()}")
    if alg.needs_next_obs and not hasattr(env, "keep_final_observations"):
        raise UserError(f"{name} needs observations before resets, which {type(env).__name__} does not keep")
    if num_processes > 1 and not hasattr(alg, "broadcast_parameters"):
        raise UserError(f"{name} trains in one process only: it has no broadcast_parameters()")
