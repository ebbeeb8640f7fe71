"""The replay: past steps of all worlds, on the device."""

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_torque.learning.protocols import Transition
from legged_torque.utils.devices import free_memory
from legged_torque.utils.errors import UserError


@dataclass(frozen=True)
class Batch:
    """Samples of the replay, each of some steps in a row.

    Attributes:
        obs: Observations before the first step. Shape: (samples, size) per group.
        actions: Of the first step, in [-1, 1]. Shape: (samples, num_actions).
        rewards: Discounted sum over the steps. Shape: (samples,).
        discounts: Of what follows them; 0 after a fall. Shape: (samples,).
        next_obs: Observations after the last step, before any reset. Shape: (samples, size) per group.
        weights: 1; 0 where the replay has no step, see :class:`Replay`. Shape: (samples,).
    """

    obs: TensorDict
    actions: Tensor
    rewards: Tensor
    discounts: Tensor
    next_obs: TensorDict
    weights: Tensor


class Replay:
    """A ring of the last steps of all worlds, in tensors of fixed addresses.

    Observations are kept once: those after a step are those before the next one. After a time-out they would belong to
    a new episode, so the one before the reset stands in place of the first step of that episode, which is left out.

    Attributes:
        num_envs: Number of worlds.
        num_actions: Actions of a world.
        device: Where it is.
        count: Steps of each world so far. Scalar, int64.
        rows: Steps of each world that there is room for.
    """

    def __init__(
        self, obs: TensorDict, groups: list[str], num_actions: int, size: int, dtype: torch.dtype, device: str
    ) -> None:
        """Prepare for observations like ``obs`` of some ``groups``; :meth:`allocate` makes room for ``size`` steps."""
        self.num_envs, self.num_actions, self.rows = len(obs), num_actions, size // len(obs)
        self.device, self._dtype = device, dtype
        self._sizes = {group: obs[group].shape[1] for group in groups}
        self.count = torch.zeros((), dtype=torch.long, device=device)
        self._steps: dict[str, Tensor] = {}
        zeros = {group: torch.zeros(len(obs), length, device=device) for group, length in self._sizes.items()}
        self._final = zeros  # observations after the last step, before any reset
        self._timed_out = torch.zeros(len(obs), dtype=torch.bool, device=device)  # whether that was a time-out

    def allocate(self) -> None:
        """Make room, if that has not been done; a UserError if the device has too little."""
        if self._steps:
            return
        per_step = self._dtype.itemsize * sum(self._sizes.values()) + 4 * (self.num_actions + 1) + 3
        needed, free = per_step * self.rows * self.num_envs, free_memory(self.device)
        if needed > free:
            raise UserError(
                f"the replay of flashsac.replay_buffer_size = {self.rows * self.num_envs} steps needs "
                f"{needed / 2**30:.1f} GiB, and {self.device} has {free / 2**30:.1f} left: lower it, or set "
                "flashsac.buffer_obs_dtype=bfloat16"
            )
        kinds = {group: (self._dtype, length) for group, length in self._sizes.items()}
        kinds |= {"_actions": (torch.float32, self.num_actions), "_rewards": (torch.float32, 1)}
        kinds |= dict.fromkeys(("_fell", "_ended", "_is_step"), (torch.bool, 1))
        self._steps = {
            name: torch.zeros(self.rows, self.num_envs, length, dtype=dtype, device=self.device)
            for name, (dtype, length) in kinds.items()
        }

    def add(self, transition: Transition, actions: Tensor) -> None:
        """Keep a step, with ``actions`` in [-1, 1], once there is room; nothing waits for the host."""
        assert transition.next_obs is not None
        dones, time_outs = transition.dones, transition.time_outs
        timed_out = torch.zeros_like(dones) if time_outs is None else dones & time_outs
        is_late = self._timed_out.unsqueeze(1)
        step = {name: torch.where(is_late, self._final[name], transition.obs[name]) for name in self._sizes}
        step |= {"_actions": actions, "_rewards": transition.rewards, "_is_step": ~self._timed_out}
        step |= {"_fell": dones & ~timed_out, "_ended": dones}
        row = (self.count % self.rows).unsqueeze(0)
        for name, values in step.items():
            kept = self._steps[name]
            kept.index_copy_(0, row, values.view(1, self.num_envs, -1).to(kept.dtype))
        for group, final in self._final.items():
            final.copy_(transition.next_obs[group])
        self._timed_out.copy_(timed_out)
        self.count.add_(1)

    def sample(self, size: int, num_steps: int, gamma: float) -> Batch:
        """Return random samples of up to ``num_steps`` steps, fewer where an episode has ended.

        The replay must hold more steps of each world than that. Nothing waits for the host.
        """
        kept = self.count.clamp(max=self.rows)
        age = (torch.rand(size, dtype=torch.float64, device=self.device) * (kept - num_steps)).long()
        world = torch.randint(self.num_envs, (size,), device=self.device)
        first = self.count - kept + age

        def pick(name: str, step: Tensor) -> Tensor:
            """Return what there is of a step of each sample, counted like :attr:`count`."""
            return self._steps[name].flatten(0, 1)[step % self.rows * self.num_envs + world]

        goes_on = torch.ones(size, device=self.device)  # 0 after the end of the sample's episode
        rewards, length, fell = torch.zeros_like(goes_on), torch.zeros_like(goes_on), torch.zeros_like(goes_on)
        for number in range(num_steps):
            step = first + number
            rewards += gamma**number * goes_on * pick("_rewards", step).squeeze(1)
            fell += goes_on * pick("_fell", step).squeeze(1)
            length += goes_on
            goes_on = goes_on * ~pick("_ended", step).squeeze(1)
        after = first + length.long()
        return Batch(
            obs=TensorDict({group: pick(group, first).float() for group in self._sizes}, [size]),
            actions=pick("_actions", first),
            rewards=rewards,
            discounts=gamma**length * (1.0 - fell),
            next_obs=TensorDict({group: pick(group, after).float() for group in self._sizes}, [size]),
            weights=pick("_is_step", first).squeeze(1).float(),
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return all that it holds, in its own memory."""
        held = {name: kept[: int(self.count)] for name, kept in self._steps.items()}
        last = {f"_final.{group}": final for group, final in self._final.items()}
        return {**held, **last, "_timed_out": self._timed_out, "count": self.count}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue with a :meth:`state_dict` of as many worlds; a ValueError if its rows are not those of this ring."""
        rows = len(state["_rewards"])
        if rows != min(int(state["count"]), self.rows):
            had, room = rows * self.num_envs, self.rows * self.num_envs
            raise ValueError(f"flashsac.replay_buffer_size is {room} steps, and {had} of another size were kept")
        self.allocate()
        for name, kept in self._steps.items():
            kept[: len(state[name])] = state[name].to(kept.device)
        for group, final in self._final.items():
            final.copy_(state[f"_final.{group}"])
        self._timed_out.copy_(state["_timed_out"])
        self.count.copy_(state["count"])
