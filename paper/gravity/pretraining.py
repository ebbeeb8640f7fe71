"""Gravity pre-training (paper, III-A): a torque policy learns to stand from what the whole-body controller does.

It works for every approach that says which actions lead to given torques (``TorqueRobot.actions_for``).
"""

from __future__ import annotations

import copy
import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Any

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.learning.random_state import own_random_numbers, seeded_state
from legged_torque.paper.gravity.dynamics import RobotDynamics
from legged_torque.paper.gravity.standing import (
    Act,
    actions_for,
    check_torques,
    measure_standing,
    place_on_ground,
    use_standing_trials,
)
from legged_torque.paper.gravity.threads import single_threaded
from legged_torque.paper.gravity.whole_body import WholeBodyController, WholeBodySettings, WholeBodyTorques
from legged_torque.utils.config import to_dict
from legged_torque.utils.devices import device_name
from legged_torque.utils.display import Counter
from legged_torque.utils.errors import UserError
from legged_torque.utils.task_registry import task_registry

STANDING_SECONDS = 5.0  # time after which the learned policy must stand
HIGHEST_FORCE = 1.6  # of a contact of the controller, as share of the robot's weight; no less than its settings have


@dataclass
class Pairs:
    """What the policy sees, and the actions that the controller takes there."""

    observations: Tensor  # group "policy" of the task's observations. Shape: (pairs, size)
    actions: Tensor  # those that lead to the controller's torques. Shape: (pairs, num_actions)

    def split(self, size: int) -> list[Pairs]:
        """Return the pairs in parts of at most ``size``."""
        return [Pairs(*part) for part in zip(self.observations.split(size), self.actions.split(size), strict=True)]

    def shuffled(self) -> Pairs:
        """Return the pairs in random order."""
        order = torch.randperm(len(self.actions), device=self.actions.device)
        return Pairs(self.observations[order], self.actions[order])


@dataclass
class Collection:
    """What came of following random configurations."""

    training: Pairs  # to learn from
    held_out: Pairs  # of other configurations, to measure what was learned
    dropped: dict[str, int]  # how many pairs were dropped, by reason
    mean_torques: Tensor  # mean absolute torque [N m], of dropped pairs too. Shape: (all pairs,)
    residuals: Tensor  # see :func:`residual_share`, of dropped pairs too. Shape: (all pairs,)


def pretrain(name: str, env_cfg: Any, train_cfg: Any, device: str) -> tuple[MLPModel, dict[str, Any]]:
    """Make a policy that stands: the ``pretraining.function`` of ``a1_torque_gravity``.

    Its random numbers are its own, so that a training is the same whether it had to make its policy or found one. Its
    settings are ``pretraining`` of ``train_cfg``. Returns the actor, and a report of plain values.
    """
    cfg, settings = copy.deepcopy(env_cfg), train_cfg.pretraining
    check_settings(settings)
    use_standing_trials(cfg, env_cfg.control.decimation)
    with own_random_numbers(device, seeded_state(device, settings.seed)):
        task = task_registry.get_task_class(name)(cfg, device)
        check_torques(task)
        actor = task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=None)[0].alg.actor
        controller = make_controller(task, WholeBodySettings(**to_dict(settings.controller)))
        start = time.perf_counter()
        collection, errors = learn_to_stand(task, controller, actor, settings)
        seconds = time.perf_counter() - start
        standing = {}
        for who, act in {"controller": act_by_controller(controller), "policy": act_by_policy(actor)}.items():
            place_on_ground(task, controller.dynamics)
            standing[who] = measure_standing(task, act, STANDING_SECONDS).share
    print(f"Standing after 5 s: {' and '.join(f'the {who} {share:.1%}' for who, share in standing.items())}.")
    torques, residuals = histogram(collection.mean_torques, 40.0), histogram(collection.residuals, 5.0)
    report = {
        "task": name,
        "device": device_name(task.device),
        "settings": to_dict(settings),
        "pairs": len(collection.training.actions) + len(collection.held_out.actions),
        "dropped": collection.dropped,
        "rms_error": errors,
        "standing": standing,
        "seconds": seconds,
        "histograms": {"mean_torque": torques, "residual": residuals},
    }
    return actor, report


def check_settings(settings: Any) -> None:
    """Raise a UserError that names the first setting that makes no sense."""
    if not hasattr(settings, "num_configurations"):
        raise UserError("these training settings have no gravity pre-training; inherit those of a1_torque_gravity")
    for name in ("num_configurations", "num_steps", "num_rounds", "num_epochs", "batch_size"):
        if getattr(settings, name) < 1:
            raise UserError(f"pretraining.{name} must be at least 1, not {getattr(settings, name)}")
    for name in ("learning_rate", "max_mean_torque", "max_residual"):
        if not getattr(settings, name) > 0.0:
            raise UserError(f"pretraining.{name} must be greater than 0, not {getattr(settings, name)}")
    if settings.num_rounds > settings.num_configurations:
        raise UserError(f"pretraining.num_rounds is {settings.num_rounds}, more than there are configurations")
    if not 0.0 < settings.held_out < 1.0:
        raise UserError(f"pretraining.held_out must be between 0 and 1, not {settings.held_out}")


def learn_to_stand(
    task: LeggedRobot, controller: WholeBodyController, actor: MLPModel, settings: Any
) -> tuple[Collection, dict[str, list[float]]]:
    """Let the actor imitate the controller, first where that goes, then also where the actor itself goes (DAgger).

    The task's episodes start from random states, the actor changes in place. Returns all pairs, and the errors after
    every epoch of every round, see :func:`supervise`.
    """
    followed: list[Followed] = []
    errors: dict[str, list[float]] = {"training": [], "held_out": []}
    for i in range(settings.num_rounds):
        act = act_by_policy(actor) if i else None
        count = settings.num_configurations * (i + 1) // settings.num_rounds - sum(p.upright.shape[1] for p in followed)
        print(f"Round {i + 1} of {settings.num_rounds}: following {count} configurations.", flush=True)
        followed.append(follow(task, controller, act, count, settings.num_steps))
        collection = select(followed, settings)
        for name, values in supervise(task, actor, collection, settings).items():
            errors[name] += values
    return collection, errors


@dataclass
class Followed:
    """Configurations followed in closed loop, and the controller's opinion at each step, whoever was acting."""

    # All shapes begin with (num_steps, configurations).
    observations: Tensor  # what the policy sees. Shape: (..., size)
    actions: Tensor  # those that lead to the controller's torques. Shape: (..., num_actions)
    mean_torques: Tensor  # mean absolute torque of the controller [N m]
    residuals: Tensor  # see :func:`residual_share`
    upright: Tensor  # whether the robot has not fallen before, bool


@single_threaded()
def follow(
    task: LeggedRobot, controller: WholeBodyController, act: Act | None, num_configurations: int, num_steps: int
) -> Followed:
    """Follow random configurations for some control steps; ``act`` moves them if given, otherwise the controller."""
    parts: list[list[Tensor]] = []
    starts = range(0, num_configurations, task.num_envs)
    with Counter("following, step", len(starts) * num_steps) as counter:
        for start in starts:
            place_on_ground(task, controller.dynamics)
            upright = torch.ones_like(task.reset_buf)
            steps = []
            for _ in range(num_steps):
                decided = controller(task.sim.qpos, task.sim.qvel, task.feet_contact > 0)
                observations = task.get_observations()["policy"]
                actions, residuals = actions_for(task, decided.total), residual_share(controller, decided)
                steps.append([observations, actions, decided.total.abs().mean(dim=1), residuals, upright])
                task.step(act(task) if act else actions)  # they hold for a control step
                upright = upright & ~task.reset_buf
                counter.add()
            count = min(task.num_envs, num_configurations - start)
            parts.append([torch.stack(numbers)[:, :count] for numbers in zip(*steps, strict=True)])
    return Followed(*(torch.cat(numbers, dim=1) for numbers in zip(*parts, strict=True)))


def select(followed: list[Followed], settings: Any) -> Collection:
    """Keep the pairs that are worth learning, and hold back those of some configurations, of the same ones every time.

    As in the paper, pairs of large torques are dropped, and so are those whose contacts cannot bear what the controller
    wants by far, and what comes after a fall.
    """
    names = [field.name for field in dataclasses.fields(Followed)]
    everything = Followed(*(torch.cat([getattr(part, name) for part in followed], dim=1) for name in names))
    reasons = {
        "after a fall": ~everything.upright,
        f"mean torque over {settings.max_mean_torque:g} N m": ~(everything.mean_torques <= settings.max_mean_torque),
        f"wrench residual over {settings.max_residual:g}": ~(everything.residuals <= settings.max_residual),
    }
    keep, dropped = torch.ones_like(everything.upright), {}
    for reason, mask in reasons.items():  # comparisons are written so that NaN fails them
        dropped[reason] = int((keep & mask).sum())
        keep = keep & ~mask
    counts = [part.upright.shape[1] for part in followed]
    held_out = torch.cat([torch.arange(count, device=keep.device) < settings.held_out * count for count in counts])
    sets = [keep & ~held_out, keep & held_out]
    training, measured = (Pairs(everything.observations[chosen], everything.actions[chosen]) for chosen in sets)
    if not len(training.actions) or not len(measured.actions):
        raise UserError("pre-training has kept too few pairs: raise pretraining.num_configurations or its limits")
    texts = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
    print(f"Kept {int(keep.sum())} of {keep.numel()} pairs; dropped: {texts}.", flush=True)
    return Collection(training, measured, dropped, everything.mean_torques.flatten(), everything.residuals.flatten())


def residual_share(controller: WholeBodyController, decided: WholeBodyTorques) -> Tensor:
    """Return what the limits of the contacts leave out of the wanted wrench, as a share of the weight. Shape: (n,)."""
    model = controller.dynamics.mj_model
    weight = float(model.body_mass.sum() * abs(model.opt.gravity[2]))
    force, moment = decided.wrench_residual.split(3, dim=1)
    return torch.cat([force, moment / controller.settings.arm], dim=1).norm(dim=1) / weight


def supervise(task: LeggedRobot, actor: MLPModel, collection: Collection, settings: Any) -> dict[str, list[float]]:
    """Train the actor's mean on the pairs and on their mirror images by their mean square error.

    Last actions are shuffled; otherwise the policy would copy them and could not correct its own mistakes. Returns the
    root mean square errors of the torque actions after every epoch [N m], "training" and "held_out".
    """
    num_batches = math.ceil(len(collection.training.actions) / settings.batch_size)
    optimizer = torch.optim.Adam(actor.parameters(), lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.num_epochs * num_batches)
    errors: dict[str, list[float]] = {"training": [], "held_out": []}
    with Counter("learning, epoch", settings.num_epochs) as counter:
        for _ in range(settings.num_epochs):
            losses = []
            for pairs in collection.training.shuffled().split(settings.batch_size):
                wrong = imitation_errors(task, actor, pairs)
                optimizer.zero_grad()
                wrong.square().mean().backward()
                optimizer.step()
                schedule.step()
                losses.append(of_torques(task, wrong.detach()))
            with torch.no_grad():
                batches = collection.held_out.split(settings.batch_size)
                held_out = [of_torques(task, imitation_errors(task, actor, pairs)) for pairs in batches]
            for name, values in (("training", losses), ("held_out", held_out)):
                errors[name].append(task.cfg.control.torque_scale * float(torch.stack(values).mean().sqrt()))
            now = ", ".join(f"{name.replace('_', ' ')} {values[-1]:.2f} N m" for name, values in errors.items())
            counter.activity = f"root mean square error {now}"
            counter.add()
    print(f"Learned in {settings.num_epochs} epochs: root mean square error {now}.", flush=True)
    return errors


def imitation_errors(task: LeggedRobot, actor: MLPModel, pairs: Pairs) -> Tensor:
    """Return the errors of the actor's mean actions on pairs and their mirror images. Shape: (2 pairs, num_actions)."""
    observations = exchange(pairs.observations, task.observations.policy_columns("last_action"))
    observations = torch.cat([observations, task.mirror("policy", observations)])
    actions = torch.cat([pairs.actions, task.mirror("actions", pairs.actions)])
    predicted = actor(TensorDict({"policy": observations}, [len(observations)]))
    return predicted - actions


def of_torques(task: LeggedRobot, wrong: Tensor) -> Tensor:
    """Return the mean square of the errors of torque actions, which are the last ones. Scalar."""
    return wrong[:, -task.num_dof :].square().mean()


def exchange(observations: Tensor, columns: list[int]) -> Tensor:
    """Return observations with some columns of other samples, drawn at random. Shapes: (samples, size)."""
    others = observations[torch.randperm(len(observations), device=observations.device)]
    result = observations.clone()
    result[:, columns] = others[:, columns]
    return result


def make_controller(task: LeggedRobot, settings: WholeBodySettings | None = None) -> WholeBodyController:
    """Return the whole-body controller for the worlds of a task; without settings, with its own defaults.

    Its height is the task's, and one contact may always carry the robot. A UserError if a foot has several geoms: the
    forces on them are not determined.
    """
    points, feet = len(task.foot_names), len(task.foot_geoms)
    if points != feet:
        raise UserError(
            f"gravity pre-training needs a point per foot; '{task.cfg.asset.file}' has {points} for {feet} feet"
        )
    dynamics = RobotDynamics(task.sim.mj_model, task.num_envs, task.device, task.foot_names)
    settings, model = settings or WholeBodySettings(), task.sim.mj_model
    weight = float(model.body_mass.sum()) * abs(float(model.opt.gravity[2]))
    force, height = max(settings.highest_force, HIGHEST_FORCE * weight), task.cfg.rewards.base_height_target
    settings = dataclasses.replace(settings, height=height, highest_force=force)
    return WholeBodyController(dynamics, task.default_dof_pos.tolist(), settings)


def act_by_controller(controller: WholeBodyController) -> Act:
    """Return the function that asks the controller for the torques of a task's state, and gives them."""
    return lambda task: actions_for(task, controller(task.sim.qpos, task.sim.qvel, task.feet_contact > 0).total)


def act_by_policy(actor: MLPModel) -> Act:
    """Return the function that asks a policy for its mean actions."""

    def actions(task: LeggedRobot) -> Tensor:
        with torch.no_grad():
            return actor(task.get_observations())

    return actions


def histogram(values: Tensor, highest: float, bins: int = 50) -> dict[str, list[float]]:
    """Return how many values fall into equal bins from 0; those beyond the highest count in the last one."""
    counts = torch.histc(values.clamp(max=highest), bins, 0.0, highest)
    return {"edges": torch.linspace(0.0, highest, bins + 1).tolist(), "counts": counts.tolist()}
