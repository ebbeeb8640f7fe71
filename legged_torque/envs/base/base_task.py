"""What rsl_rl asks of every task: steps, observations, episodes, counters."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from legged_torque.sim.compiled import compiled
from legged_torque.sim.graph import CudaGraph


class BaseTask(VecEnv):
    """A batch of worlds whose control step replays as one CUDA graph on a GPU.

    Hence the rules for everything that runs inside :meth:`_step`: fixed shapes, masks instead of lists of ids, nothing
    read back to the host, and what is kept from step to step is written in place (``copy_``, ``masked_fill_``), never
    bound to a new tensor.

    Attributes:
        obs_buf: Groups "policy" and "critic" of the observations, each (num_envs, size).
        rew_buf: Rewards of the last step. Shape: (num_envs,).
        reset_buf: Worlds whose episode has ended with the last step. Shape: (num_envs,), bool.
        time_out_buf: Those of them whose time was over. Shape: (num_envs,), bool.
        episode_return: Sum of the rewards of the episode so far. Shape: (num_envs,).
        total_steps: Environment steps so far over all worlds of all processes: t of eq. 1. Scalar, int64.
        num_diverged: Worlds that were reset since something in them was not finite. Scalar, int64.
    """

    obs_buf: TensorDict
    _parts: Sequence[Callable[[], None]] = ()
    """What a step does with torch, in the order of the step, between what Warp's kernels do."""
    _is_compiled = False
    num_processes = 1
    """Processes that train together, each with as many worlds; the runner sets it."""

    def __init__(self, num_envs: int, device: str) -> None:
        """Allocate rewards, ends and counters of ``num_envs`` worlds on the device, "cpu" or "cuda:N"."""
        self.num_envs, self.device = num_envs, device
        self.rew_buf, self.episode_return = (torch.zeros(num_envs, device=device) for _ in range(2))
        self.reset_buf, self.time_out_buf = (torch.zeros_like(self.rew_buf, dtype=torch.bool) for _ in range(2))
        self._episode_length_buf = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.total_steps, self.num_diverged = (torch.zeros((), dtype=torch.long, device=device) for _ in range(2))
        self.extras = {"time_outs": self.time_out_buf}
        self.step_graph = CudaGraph(self._step, device)

    def compile(self) -> None:
        """Let a GPU with Triton run what a step does with torch as few kernels; trainings do this.

        It takes seconds, at the next step, which some ten thousand steps win back. Results are the same up to rounding.
        """
        if not self._is_compiled:
            self._is_compiled = True
            self._parts = [compiled(part, self.device) for part in self._parts]
            self.step_graph.reset()

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Apply actions for one control step. Shape: (num_envs, num_actions); one that is not finite resets its world.

        Returns observations (a copy); rewards (num_envs,); dones (num_envs,), bool; extras with "time_outs"
        (num_envs,), bool. Rewards, dones and extras are buffers that the next step overwrites.
        """
        self._given_actions.copy_(actions)
        self.step_graph()
        return self.get_observations(), self.rew_buf, self.reset_buf, self.extras

    def get_observations(self) -> TensorDict:
        """Return a copy of the current observations: groups "policy" and "critic", each (num_envs, size).

        Numbers that are not finite are 0 in it; their worlds are reset in the next step.
        """
        groups = {name: self.obs_buf[name].nan_to_num() for name in map(str, self.obs_buf.keys())}
        return TensorDict(groups, [self.num_envs], device=self.device)

    def reset(self, world: int | None = None) -> TensorDict:
        """Start a new episode in every world, or in a single one, and return the observations.

        A single one is for viewers: the others are observed once more, and what happens at random may happen there.
        """
        self.reset_buf.fill_(world is None)
        if world is not None:
            self.reset_buf[world] = True
        self._reset_worlds()
        self._finish_step()
        return self.get_observations()

    @property
    def episode_length_buf(self) -> Tensor:
        """Control steps since the start of each world's episode. Shape: (num_envs,), int64."""
        return self._episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        """Write the counters in place: rsl_rl sets them to random values when training starts."""
        self._episode_length_buf.copy_(value)

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a checkpoint must keep of the task: its counters, on which all curricula depend."""
        return {"total_steps": self.total_steps.clone(), "num_diverged": self.num_diverged.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from the counters of a checkpoint."""
        self.total_steps.copy_(state["total_steps"])
        self.num_diverged.copy_(state["num_diverged"])
        self.update_curriculum()

    def update_curriculum(self) -> None:
        """Curriculum hook for what may only change between rollouts; the runner calls it before each of them."""

    @abstractmethod
    def _step(self) -> None:
        """Do one control step under ``_given_actions``."""

    @abstractmethod
    def _reset_worlds(self) -> None:
        """Put the worlds of ``reset_buf`` into the state in which an episode starts."""

    @abstractmethod
    def _finish_step(self) -> None:
        """Begin the episodes of ``reset_buf``, compute the observations, and keep what the next step compares with."""
