"""Students: policies that imitate others, which may see more (DAgger, arXiv 1011.0686)."""

from pathlib import Path
from typing import Any

import torch
from rsl_rl import algorithms
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules import HiddenState
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor, nn
from torch.utils._pytree import tree_map

from legged_torque.envs import task_registry
from legged_torque.learning.checkpoint import cloned
from legged_torque.learning.memory import RememberingPolicy
from legged_torque.learning.protocols import Transition, annealed
from legged_torque.sim.graph import CudaGraph
from legged_torque.terrain.rough import RoughGround
from legged_torque.utils import distributed
from legged_torque.utils.config import flat, to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.options import LAW, Options, law_of_motors
from legged_torque.utils.runs import checkpoint_number, find_checkpoint_of

SAME = ["asset.file", "control.", "init_state.", LAW, "motors.drive.", "motors.muscle.", "normalization.", "sim.dt"]
SAME += ["terrain.measured_points_"]
"""Beginnings of the paths of settings in which a teacher's run must agree: they say what actions and numbers mean."""
LEAST_WEIGHT = 0.01  # of actions without effect, as of a PD part that has faded: policies observe their last actions
DISTRIBUTION = "legged_torque.learning.distribution:GaussianDistribution"


class Distillation(algorithms.Distillation):
    """rsl_rl's Distillation with another update: the student acts, and learns what its teachers would have done.

    Each gradient step learns from a few control steps in a row, in a part of the worlds. It runs on the device from end
    to end, so that it replays as a CUDA graph.

    Attributes:
        student: The policy.
        teacher: The :class:`Teachers`, once :meth:`allocate` has loaded them.
        update_graph: The gradient step.
    """

    capturable = False
    needs_next_obs = False

    def __init__(self, student: MLPModel, env: Any, cfg: dict[str, Any], device: str) -> None:
        """Create the learner of a student in a task, from settings in rsl_rl's layout."""
        settings, num_steps, obs = cfg["distillation"], cfg["num_steps_per_env"], env.get_observations()
        names = ("learning_rate", "num_learning_epochs", "max_grad_norm", "loss_type")
        length, minibatches = settings["gradient_length"], settings["num_mini_batches"]
        seen = obs.select(*student.obs_groups)
        storage = RolloutStorage("distillation", env.num_envs, num_steps, seen, [env.num_actions], device)
        chosen = {name: settings[name] for name in names}
        chosen["gradient_length"] = 1  # of rsl_rl's update, which is not used
        super().__init__(student, Teachers([], env), storage, device=device, multi_gpu_cfg=cfg["multi_gpu"], **chosen)
        self._env, self._task_name, self._files = env, cfg.get("task"), settings["teachers"]
        self._first_rate, self.annealing_start = settings["learning_rate"], settings["annealing_start"]
        self.learning_rate = torch.tensor(self._first_rate, device=device)
        self.optimizer = torch.optim.Adam(student.parameters(), lr=self.learning_rate, fused=True, capturable=True)
        self._skip = torch.zeros((), device=device)  # 1 if the last gradient was not finite
        self.optimizer.found_inf = self._skip  # type: ignore[attr-defined] # where it is 1, a fused optimizer skips
        self.num_mini_batches, self._sums = minibatches, torch.zeros(2, device=device)  # of losses, and of steps made
        worlds = max(env.num_envs // minibatches, 1)
        self._worlds = torch.zeros(worlds, dtype=torch.long, device=device)  # of a gradient step
        self._steps = torch.zeros(length, 1, dtype=torch.long, device=device)
        self._at_start: tuple[Tensor, ...] = ()  # what the student remembered when the rollout began
        self._memory: tuple[Tensor, ...] = ()  # what it remembers of the worlds of a gradient step
        self.update_graph = CudaGraph(self._learn, device, cfg["capture"])

    @classmethod
    def construct_algorithm(cls, obs: TensorDict, env: Any, cfg: dict[str, Any], device: str) -> "Distillation":
        """Build the learner from settings in rsl_rl's layout; teachers are loaded when training needs them."""
        if cfg["pretraining"]["function"]:
            raise UserError("a student does not start from pretraining.function: it learns from its teachers")
        settings = dict(cfg["distillation"]["student"])
        distribution = {"class_name": DISTRIBUTION, "init_std": settings.pop("init_std"), "std_type": "scalar"}
        network = RNNModel
        if settings["rnn_type"] == "none":
            settings = {name: settings[name] for name in ("hidden_dims", "activation")}
            network = MLPModel
        student = network(obs, cfg["obs_groups"], "actor", env.num_actions, distribution_cfg=distribution, **settings)
        return cls(student.to(device), env, cfg, device)

    # ---- for the trainer, see protocols.Learner --------------------------------------------------------------------

    def allocate(self) -> None:
        """Load the teachers; a UserError if none is given, one does not fit, or settings fit no rollout of the task."""
        check_student(self._files, self.storage.num_transitions_per_env, len(self._steps))
        if self.num_mini_batches > self._env.num_envs:
            given = f"distillation.num_mini_batches is {self.num_mini_batches}"
            raise UserError(f"{given}, more than the {self._env.num_envs} worlds")
        # the first one last: the counters of the task, and so its curricula, become those of the last that is loaded
        members = [Teacher(file, self._env, self._task_name) for file in reversed(self._files)]
        self.teacher = Teachers(members[::-1], self._env)

    @torch.no_grad()
    def act(self, obs: TensorDict) -> Tensor:
        """Return the student's actions with noise, and keep its teachers'. Shape: (num_envs, num_actions)."""
        if not self.teacher.members:
            self.allocate()  # of a training that keeps no run
        seen = obs.select(*self.student.obs_groups)
        if self.storage.step == 0:
            self._at_start = self._remembered()
        self.transition.observations, self.transition.privileged_actions = seen, self.teacher(obs)
        self.transition.actions = self.student(seen, stochastic_output=True)
        return self.transition.actions

    def observe(self, transition: Transition) -> None:
        """Keep a step, and forget the worlds whose episodes have ended."""
        self.process_env_step(transition.obs_after, transition.rewards, transition.dones, transition.extras)

    def due(self) -> bool:
        """Return that an update is due: the storage holds one rollout."""
        return True

    def policy(self) -> MLPModel:
        """Return the student."""
        return self.student

    def set_progress(self, iteration: int, num_iterations: int) -> None:
        """Set the learning rate of an iteration, which falls linearly to 0 after the share ``annealing_start``."""
        self.learning_rate.fill_(annealed(iteration, num_iterations, self.annealing_start) * self._first_rate)

    def update(self) -> dict[str, float]:
        """Learn from the rollout, worlds in random order; return the loss "behavior", and what the guard wants to know.

        The loss is the mean over the rollout, in all processes, where actions count by the weights of their torques.
        Each epoch starts from what the student remembered when the rollout began. It leaves out as many worlds, other
        ones each time, as minibatches of the same size do not hold.
        """
        count, num_steps = len(self._worlds), self.storage.num_transitions_per_env
        windows = torch.arange(num_steps, device=self.device).unsqueeze(1).split(len(self._steps))
        self._sums.zero_()
        self._memory = self._memory or tuple(part[:, :count].clone() for part in self._at_start)
        for _ in range(self.num_learning_epochs):
            order = torch.randperm(self.storage.num_envs, device=self.device)
            for worlds in order[: count * self.num_mini_batches].split(count):
                self._worlds.copy_(worlds)
                for memory, at_start in zip(self._memory, self._at_start, strict=True):
                    memory.copy_(at_start[:, worlds])
                for steps in windows:
                    self._steps.copy_(steps)
                    self.update_graph()
        self.storage.clear()
        if self.is_multi_gpu:
            distributed.average([self._sums])
        loss, made = self._sums.tolist()
        skipped = self.num_learning_epochs * self.num_mini_batches * len(windows) - made
        std = float(self.student.output_std.detach().mean())
        numbers = {"behavior": loss / (made * len(self._steps))} if made else {}
        numbers |= {"learning_rate": self.learning_rate.item(), "action_std": std}
        return {**numbers, "skipped_updates": skipped, "all_skipped": not made}

    def _learn(self) -> None:
        """Take a gradient step on the losses of some steps of some worlds, summed over time, and keep the memory."""
        storage, chosen = self.storage, (self._steps, self._worlds)
        obs = TensorDict({name: values[chosen] for name, values in storage.observations.items()})
        actions, memory = self._replay(obs, 1.0 - storage.dones[chosen].float())
        errors = self.loss_fn(actions, storage.privileged_actions[chosen], reduction="none")
        weights = self._env.control_law.weights().clamp(min=LEAST_WEIGHT)
        loss = len(actions) * (errors * weights).mean() / weights.mean()
        self.optimizer.zero_grad()
        loss.backward()
        if self.is_multi_gpu:
            distributed.average([value.grad for value in self.student.parameters() if value.grad is not None])
        norm = nn.utils.clip_grad_norm_(self.student.parameters(), self.max_grad_norm)
        self._skip.copy_(~torch.isfinite(norm))
        self.optimizer.step()
        self._sums += torch.where(self._skip.bool(), 0.0, torch.stack([loss.detach(), 1.0 - self._skip]))
        for own, last in zip(self._memory, memory, strict=True):
            own.copy_(last.detach())

    def _replay(self, obs: TensorDict, goes_on: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Return mean actions for steps in a row, and what the student remembers after them.

        ``goes_on`` is 0 after the last step of an episode, else 1. Shapes begin with (steps, worlds).
        """
        student, memory, outputs = self.student, self._memory, []
        latent = MLPModel.get_latent(student, obs)
        if student.is_recurrent:
            for step, kept in zip(latent.split(1), goes_on, strict=True):
                output, state = student.rnn.rnn(step, memory if len(memory) > 1 else memory[0])
                memory = tuple(kept * part for part in _parts(state))
                outputs.append(output)
            latent = torch.cat(outputs)
        return student.distribution.deterministic_output(student.mlp(latent)), memory

    def _remembered(self) -> tuple[Tensor, ...]:
        """Return what the student remembers of its worlds: a tensor for a GRU, two for an LSTM, else none."""
        if not self.student.is_recurrent:
            return ()
        network, state = self.student.rnn.rnn, self.student.get_hidden_state()
        if state is None:  # nothing yet
            shape = (network.num_layers, self.storage.num_envs, network.hidden_size)
            return tuple(torch.zeros(shape, device=self.device) for _ in range(1 + isinstance(network, nn.LSTM)))
        return tuple(part.clone() for part in _parts(state))

    def close(self) -> None:
        """Free the graph of the gradient step."""
        self.update_graph.reset()

    def broadcast_parameters(self) -> None:
        """Give all processes the student of the first one; teachers are the same files."""
        for tensor in self.student.state_dict().values():
            torch.distributed.broadcast(tensor, src=0)

    # ---- state -------------------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Return student and optimizer, each tensor in memory of its own."""
        parts = {"actor_state_dict": self.student.state_dict(), "optimizer_state_dict": self.optimizer.state_dict()}
        return cloned(parts)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load all parts of a :meth:`state_dict`."""
        self.load(state, None, True)

    def load(self, state: dict[str, Any], load_cfg: dict | None, strict: bool) -> bool:
        """Load parts of a :meth:`state_dict`, and return whether to go on from its iteration.

        ``load_cfg`` may choose "actor" and "iteration"; None loads everything.
        """
        if load_cfg is None or load_cfg.get("actor"):
            self.student.load_state_dict(state["actor_state_dict"], strict)
        if load_cfg is None:
            self.optimizer.load_state_dict(state["optimizer_state_dict"])
            self.optimizer.param_groups[0].update(lr=self.learning_rate, fused=True, capturable=True)
            self.update_graph.reset()  # the optimizer's tensors are new
        return load_cfg is None or load_cfg.get("iteration", False)

    def world_state_dict(self) -> dict[str, Any]:
        """Return what student and teachers remember of the worlds, between two rollouts."""
        teachers = [policy.memory for policy in self.teacher.recurrent()]
        return {"student": self.student.get_hidden_state(), "teachers": teachers}

    def load_world_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`world_state_dict`."""
        state = tree_map(lambda value: value.to(self.device) if isinstance(value, Tensor) else value, state)
        self.student.reset(hidden_state=state["student"])
        for policy, memory in zip(self.teacher.recurrent(), state["teachers"], strict=True):
            policy.memory = memory


def check_student(teachers: list[str], steps: int, length: int) -> None:
    """Raise a UserError without teachers, or if a rollout's steps are no multiple of the length of a gradient step."""
    if steps % length:
        given = f"distillation.gradient_length must divide runner.num_steps_per_env, {steps}"
        raise UserError(f"{given}, not be {length}")
    if not teachers:
        raise UserError("a student needs teachers: --set 'distillation.teachers=[RUN]' names the run of a trained one")


def _parts(state: HiddenState) -> tuple[Tensor, ...]:
    """Return the tensors of a memory: one of a GRU, two of an LSTM."""
    return state if isinstance(state, tuple) else (state,)


class Teacher:
    """A policy in a student's task, with the observations that it knows.

    Its own runner is built with this in place of the task: what the runner sets stays here, the rest is the task's.

    Attributes:
        cfg: Settings of the task of its run.
        policy: From its observations to mean actions.
    """

    policy: Any

    def __init__(self, name: str, env: Any, task: str | None) -> None:
        """Load the policy of a run or checkpoint for a task.

        The counters of the task become those of the teacher's training: they say how far curricula are. A UserError if
        the run is of another task, or its actions or observations have another meaning.
        """
        file = find_checkpoint_of(Path(name).parent, name)
        options = Options(task=task or "", load_run=str(file.parent), checkpoint=checkpoint_number(file))
        options.device = env.device.partition(":")[0]  # each process has but one GPU
        run = task_registry.load_run(options)
        task_registry.check_ranges(run, env.cfg)
        own, theirs = (flat(to_dict(cfg)) | law_of_motors(cfg) for cfg in (env.cfg, run.env_cfg))
        for path in sorted(own.keys() | theirs.keys()):
            if path.startswith(tuple(SAME)) and own.get(path) != theirs.get(path):
                raise UserError(f"the teacher '{name}' has {path}={theirs.get(path)}, its student {own.get(path)}")
        given, needed = env.cfg.env.history_length, run.env_cfg.env.history_length
        if given < needed:
            raise UserError(f"env.history_length must be at least that of the teacher '{name}', {needed}, not {given}")
        self._env, self.cfg = env, run.env_cfg
        self._size = env.observations.policy_size * run.env_cfg.env.history_length
        run.train_cfg.algorithm.symmetry_cfg.use_data_augmentation = False  # images are of the student's observations
        runner = run.train_cfg.make_runner(self, run.task, None)
        runner.load(str(run.checkpoint), {"actor": True, "iteration": False})
        self.policy = runner.get_inference_policy(env.device)

    def __getattr__(self, name: str) -> Any:
        """Return what is the task's; its graph of steps is not for the teacher's runner."""
        if name in ("_env", "step_graph"):
            raise AttributeError(name)
        return getattr(self._env, name)

    def __call__(self, obs: TensorDict) -> Tensor:
        """Return mean actions. Shape: (num_envs, num_actions)."""
        return self.policy(self.seen(obs))

    def get_observations(self) -> TensorDict:
        """Return the task's observations as the policy sees them."""
        return self.seen(self._env.get_observations())

    def seen(self, obs: TensorDict) -> TensorDict:
        """Return observations whose history is as long as in the teacher's training."""
        newest = obs["policy"][:, : self._size]
        return TensorDict({**obs, "policy": newest}, obs.batch_size)


class Teachers(nn.Module):
    """Teachers of one student, each in the worlds on whose kind of ground it has trained.

    Attributes:
        members: The teachers.
    """

    def __init__(self, members: list[Teacher], env: Any) -> None:
        """Share out the worlds of a task; where several or none have trained on a kind of ground, they take turns."""
        super().__init__()
        self.members = members
        self._chosen = torch.tensor(shared_out([member.cfg for member in members], env), device=env.device)

    def forward(self, obs: TensorDict) -> Tensor:
        """Return the actions of each world's teacher. Shape: (num_envs, num_actions)."""
        with torch.no_grad():
            result, *others = (member(obs) for member in self.members)
        for number, actions in enumerate(others, 1):
            result = torch.where((self._chosen == number).unsqueeze(1), actions, result)
        return result

    def reset(self, dones: Tensor | None = None, hidden_state: Any = None) -> None:
        """Do nothing: recurrent teachers know their worlds, see :class:`RememberingPolicy`."""

    def get_hidden_state(self) -> None:
        """Return nothing, for the same reason."""

    def recurrent(self) -> list[RememberingPolicy]:
        """Return the policies that have a memory."""
        return [member.policy for member in self.members if isinstance(member.policy, RememberingPolicy)]


def shared_out(cfgs: list[Any], env: Any) -> list[int]:
    """Return the number of each world's teacher, from the settings of the teachers' tasks."""
    everyone, ground = list(range(len(cfgs))), env.terrain
    if len(cfgs) < 2 or not isinstance(ground, RoughGround):
        return [world % max(len(cfgs), 1) for world in range(env.num_envs)]
    shares = [to_dict(cfg.terrain.terrain_proportions) for cfg in cfgs]
    kinds = ground.layout.kinds()
    able = {kind: [i for i in everyone if shares[i].get(kind)] or everyone for kind in kinds}
    of_worlds = (able[kinds[column]] for column in ground.columns.tolist())
    rows = ground.layout.num_rows  # on the same level are worlds whose numbers differ by so many
    return [teachers[sum(divmod(world, rows)) % len(teachers)] for world, teachers in enumerate(of_worlds)]
