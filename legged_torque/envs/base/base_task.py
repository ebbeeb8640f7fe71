"""The interface of tasks to rsl_rl and to trainers: steps, observations, episodes, counters, checkpoints."""

import hashlib
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.commands import UniformCommands
from legged_torque.envs.base.evaluation import WalkingEvaluation
from legged_torque.envs.base.state import RobotState
from legged_torque.envs.base.step_meter import StepMeter
from legged_torque.sim.compiled import compiled
from legged_torque.sim.engine import Engine
from legged_torque.sim.graph import CudaGraph
from legged_torque.sim.health import Health
from legged_torque.terrain.terrain import Terrain
from legged_torque.utils.buffers import InPlace, check_tensor, copy_state
from legged_torque.utils.config import flat, successor, to_dict
from legged_torque.utils.errors import UserError


class BaseTask(InPlace, VecEnv):
    """The half of :class:`~legged_torque.envs.base.legged_robot.LeggedRobot` that faces a learner.

    A control step replays as one CUDA graph on a GPU. Hence the rules for everything that runs inside :meth:`_step`:
    fixed shapes, masks instead of lists of ids, nothing read back to the host, and what is kept from step to step is
    written in place (``copy_``, ``masked_fill_``), never bound to a new tensor.

    Attributes:
        state: The state of the robots.
        meter: What :meth:`measure_steps` measures: power of their motors, peaks of contact forces.
        obs_buf: Groups of observations: "policy" and "critic", each (num_envs, size), and others of a task's own.
        rew_buf: Rewards of the last step. Shape: (num_envs,).
        total_steps: Environment steps so far over all worlds of all processes: t of eq. 1. Scalar, int64.
        num_diverged: Worlds that were reset since something in them was not finite. Scalar, int64.
        num_processes: Processes that train together, each with as many worlds; the trainer sets it.
        keep_final_observations: Whether "final_observations" of the extras are computed, see :meth:`step`.

    Once a task is built, its tensors must be written in place: binding such an attribute to another is a UserError.
    """

    sim: Engine
    terrain: Terrain
    command_generator: UniformCommands
    state: RobotState
    meter: StepMeter
    health: Health
    obs_buf: TensorDict
    num_processes = 1
    _parts: Sequence[Callable[[], None]] = ()
    """What a step does with torch, in the order of the step, between what Warp's kernels do."""
    _is_compiled = False

    def __init__(self, num_envs: int, device: str) -> None:
        """Allocate rewards and counters of ``num_envs`` worlds on the device, "cpu" or "cuda:N"."""
        self.num_envs, self.device = num_envs, device
        self.rew_buf = torch.zeros(num_envs, device=device)
        self.total_steps, self.num_diverged = (torch.zeros((), dtype=torch.long, device=device) for _ in range(2))
        self._final: dict[str, Tensor] = {}
        self._keeps_final = False
        self._world_state: dict[str, Tensor] = {}
        self.step_graph = CudaGraph(self._step, device)

    def __getattr__(self, name: str) -> Any:
        """Refuse legged_gym's attributes with their successors; Python calls this for what does not exist."""
        if replaced := successor("attributes", name):
            raise UserError(replaced)
        if any(name in vars(base).get("__annotations__", ()) for base in type(self).__mro__):
            raise UserError(f"'{name}' does not exist yet: tensors of your own belong behind super().__init__()")
        raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")

    def compile(self) -> None:
        """Let a GPU with Triton run what a step does with torch as few kernels; trainings do this.

        It takes seconds, at the next step, which some ten thousand steps win back. Results are the same up to rounding.
        """
        if not self._is_compiled:
            self._is_compiled = True
            self._parts = [compiled(part, self.device) for part in self._parts]
            self.step_graph.reset()

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Apply actions for one control step. Shape: (num_envs, num_actions); one that is not finite resets its world.

        Returns observations (a copy), after the resets of worlds whose episode has ended; rewards (num_envs,); dones
        (num_envs,), bool; extras with "time_outs" (num_envs,), bool, and with ``keep_final_observations`` also
        "final_observations": those of all worlds before any reset. Rewards, dones and extras are buffers that the next
        step overwrites.
        """
        if actions.shape != (wanted := self._given_actions.shape):
            raise UserError(f"actions must have the shape {tuple(wanted)}, not {tuple(actions.shape)}")
        self._given_actions.copy_(actions)
        self.step_graph()
        extras: dict[str, Any] = {"time_outs": self.state.time_out_buf}
        if self._final:
            extras["final_observations"] = self._finite(self._final)
        return self.get_observations(), self.rew_buf, self.state.reset_buf, extras

    def get_observations(self) -> TensorDict:
        """Return a copy of the current observations, see :attr:`obs_buf`.

        Numbers that are not finite are 0 in it; their worlds are reset in the next step.
        """
        return self._finite({str(name): self.obs_buf[name] for name in self.obs_buf.keys()})  # noqa: SIM118

    def reset(self, world: int | None = None) -> TensorDict:
        """Start a new episode in every world, or in a single one, and return the observations.

        A single one is for viewers: the others are observed once more, and random events may occur there.
        """
        self.state.reset_buf.fill_(world is None)
        if world is not None:
            self.state.reset_buf[world] = True
        self._reset_worlds()
        self._finish_step()
        return self.get_observations()

    @property
    def keep_final_observations(self) -> bool:
        """Whether steps keep the observations of all worlds before any reset."""
        return self._keeps_final

    @keep_final_observations.setter
    def keep_final_observations(self, value: bool) -> None:
        """Say whether they do; the step is captured anew."""
        self._keeps_final, self._final = value, {}
        self.step_graph.reset()

    def try_step(self) -> None:
        """Update curricula, make a step, undo it: trainings find mistakes in a user's code before they make a folder.

        Tensors of the task, what its worlds keep, and random numbers are afterwards as before.
        """
        named = vars(self) | vars(self.health)
        tensors = [value for value in named.values() if isinstance(value, Tensor)]
        tensors += flat(self.world_state_dict()).values()
        before = [tensor.clone() for tensor in tensors]
        with torch.random.fork_rng([self.device] if torch.device(self.device).type == "cuda" else []):
            self.update_curriculum()
            for name, value in self.curriculum_values().items():
                check_tensor(f"'{name}' of curriculum_values()", value, (), self.device)
            if type(self).step is BaseTask.step:
                self._step()
            else:
                self.step(torch.zeros_like(self._given_actions))
        for tensor, copy in zip(tensors, before, strict=True):
            if not torch.equal(tensor, copy):
                tensor.copy_(copy)

    def measure_steps(self) -> None:
        """Let :attr:`meter` measure all steps from now on; the step is captured anew."""
        self.meter.is_on = True
        self.step_graph.reset()

    @property
    def episode_length_buf(self) -> Tensor:
        """Control steps since the start of each world's episode. Shape: (num_envs,), int64."""
        return self.state.episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        """Write the counters in place: rsl_rl sets them to random values when training starts."""
        self.state.episode_length.copy_(value)

    # ---- checkpoints -------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a checkpoint must keep of the task: what its curricula depend on, and counters."""
        ranges = self.command_generator.curriculum
        share = {"command_ranges": ranges.share.clone()} if ranges else {}
        return {"total_steps": self.total_steps.clone(), "num_diverged": self.num_diverged.clone(), **share}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from the :meth:`state_dict` of a checkpoint."""
        self.total_steps.copy_(state["total_steps"])
        self.num_diverged.copy_(state["num_diverged"])
        if (ranges := self.command_generator.curriculum) and "command_ranges" in state:
            ranges.go_on(state["command_ranges"])
        self.update_curriculum()

    def keep(self, name: str, tensor: Tensor) -> Tensor:
        """Make a tensor of a task of your own a part of :meth:`world_state_dict`, and return it.

        Steps write it in place. Worlds in which it is finite now, but not after a step, begin a new episode. A
        UserError if the name is taken, or the tensor is not contiguous. Shape: (num_envs, ...).
        """
        if tensor.shape[:1] != (self.num_envs,) or not tensor.is_contiguous():
            raise UserError(f"task.keep takes contiguous tensors with a row per world; '{name}' is none")
        if name in self._world_state:
            raise UserError(f"task.keep has '{name}' twice; give the second tensor a name of its own")
        self._world_state[name] = tensor
        return tensor

    @abstractmethod
    def world_state_dict(self) -> dict[str, Any]:
        """Return all that worlds keep from step to step, in nested dictionaries: the tensors in use, not copies."""

    def load_world_state_dict(self, state: Any) -> None:
        """Go on with the worlds of a :meth:`world_state_dict`; a UserError, and nothing changed, if it does not fit."""
        copy_state(self.world_state_dict(), state)

    def identity(self) -> dict[str, Any]:
        """Return what must be the same for worlds to go on after a stop: settings, and hashes of robot and map."""
        robot = np.zeros(mujoco.mj_sizeModel(self.sim.mj_model), np.uint8)
        mujoco.mj_saveModel(self.sim.mj_model, None, robot)
        parts = {"robot's model or the version of MuJoCo": robot}
        if self.terrain.map:  # a user's own kinds of tiles are no settings
            parts["map of the ground"] = self.terrain.map.heights
        hashes = {name: hashlib.sha256(part.data).hexdigest() for name, part in parts.items()}
        return {"settings": flat(to_dict(self.cfg)), **hashes}

    def check_buffers(self) -> str | None:
        """Return a warning if the simulator has dropped contacts; waits for the device."""
        return self.sim.check_buffers()

    def make_evaluation(self, num_envs: int, perturbation: str) -> WalkingEvaluation:
        """Return worlds of their own in which to measure a policy; an empty name is the environment of these worlds."""
        return WalkingEvaluation(self, num_envs, perturbation)

    # ---- what a task does --------------------------------------------------------------------------------------------

    def _post_physics_step_callback(self) -> None:
        """Hook at every control step, with the new state, before terminations and rewards; as in legged_gym."""

    def update_curriculum(self) -> None:
        """Curriculum hook for what may only change between rollouts; the trainer calls it before each of them."""

    @abstractmethod
    def _step(self) -> None:
        """Do one control step under ``_given_actions``."""

    @abstractmethod
    def _reset_worlds(self) -> None:
        """Put the worlds of ``reset_buf`` into the state in which an episode starts."""

    @abstractmethod
    def _finish_step(self) -> None:
        """Begin the episodes of ``reset_buf``, compute the observations, and keep what the next step compares with."""

    def _finite(self, groups: dict[str, Tensor]) -> TensorDict:
        """Return a copy of observations with 0 for what is not finite."""
        copies = {name: group.nan_to_num() for name, group in groups.items()}
        return TensorDict(copies, [self.num_envs], device=self.device)
