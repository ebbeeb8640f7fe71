"""Gravity pre-training (paper, III-A): a torque policy learns to stand by imitating the whole-body controller.

It works for every approach that gives the actions for torques (``TorqueRobot.actions_for``).
"""

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

from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.learning.random_state import own_random_numbers, seeded_state
from legged_torque.paper.gravity.dynamics import RobotDynamics, single_threaded
from legged_torque.paper.gravity.standing import Act, measure_standing, place_on_ground, use_standing_trials
from legged_torque.paper.gravity.whole_body import WholeBodyController, WholeBodySettings, WholeBodyTorques
from legged_torque.utils.config import to_dict
from legged_torque.utils.devices import device_name
from legged_torque.utils.display import Counter
from legged_torque.utils.errors import UserError
from legged_torque.utils.task_registry import task_registry

STANDING_SECONDS = 5.0  # time after which the learned policy must stand
HIGHEST_FORCE = 1.6  # of a contact of the controller, as a share of the robot's weight; its settings may allow more


@dataclass
class Collection:
    """The results of following random configurations. Pairs are TensorDicts, see :func:`follow`."""

    training: TensorDict  # pairs to learn from
    held_out: TensorDict  # pairs of other configurations, which measure what was learned
    everything: TensorDict  # pairs with those that were dropped
    dropped: dict[str, int]  # number of pairs that were dropped, by reason


def pretrain(name: str, env_cfg: Any, train_cfg: Any, device: str) -> tuple[MLPModel, dict[str, Any]]:
    """Make a policy that stands: the ``pretraining.function`` of ``a1_torque_gravity``.

    Its settings are ``pretraining`` of ``train_cfg``. Its random numbers are its own, so that a training is the same
    whether it had to make its policy or found one.

    Returns:
        The actor, and a report of plain values.
    """
    cfg, settings = copy.deepcopy(env_cfg), train_cfg.pretraining
    check_settings(settings)
    if train_cfg.obs_groups.actor != ["policy"]:
        raise UserError(f"gravity pre-training needs obs_groups.actor=[policy], not {train_cfg.obs_groups.actor}")
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
        for acting, act in {"controller": act_by_controller(controller), "policy": act_by_policy(actor)}.items():
            place_on_ground(task, controller.dynamics)
            standing[acting] = measure_standing(task, act, STANDING_SECONDS).share
    print(f"Standing after 5 s: {' and '.join(f'the {acting} {share:.1%}' for acting, share in standing.items())}.")
    everything = collection.everything
    report = {
        "task": name,
        "device": device_name(task.device),
        "settings": to_dict(settings),
        "pairs": len(collection.training) + len(collection.held_out),
        "dropped": collection.dropped,
        "rms_error": errors,
        "standing": standing,
        "seconds": seconds,
        "histograms": {
            "mean_torque": histogram(everything["mean_torque"], 40.0),
            "residual": histogram(everything["residual"], 5.0),
        },
    }
    return actor, report


def check_settings(settings: Any) -> None:
    """Raise a UserError for settings whose types and limits do not say that they make no sense."""
    if not hasattr(settings, "num_configurations"):
        raise UserError("these training settings have no gravity pre-training; inherit those of a1_torque_gravity")
    if settings.num_rounds > settings.num_configurations:
        raise UserError(f"pretraining.num_rounds is {settings.num_rounds}, more than there are configurations")
    if not 0.0 < settings.held_out < 1.0:
        raise UserError(f"pretraining.held_out must be between 0 and 1, not {settings.held_out:g}")


def check_torques(task: Any) -> None:
    """Raise a UserError if a task's actions are not torques, or ``actions_for`` does not lead to the given ones."""
    if not isinstance(task, TorqueRobot):
        raise UserError(f"the actions of {type(task).__name__} are not torques, as those of TorqueRobot are")
    wanted = torch.linspace(-5.0, 5.0, task.num_dof, device=task.device).expand_as(task.dof_pos)
    if not torch.allclose(task._compute_torques(task.actions_for(wanted)), wanted, atol=1e-3):
        raise UserError(f"{type(task).__name__} cannot give the torques that its actions_for is asked for")


def learn_to_stand(
    task: TorqueRobot, controller: WholeBodyController, actor: MLPModel, settings: Any
) -> tuple[Collection, dict[str, list[float]]]:
    """Let the actor imitate the controller, first along the controller's paths, then along its own (DAgger).

    The task's episodes start from random states; the actor changes in place. Returns all pairs, and the errors after
    every epoch of every round, see :func:`supervise`.
    """
    times, fewer = settings.num_rounds, max(settings.num_rounds, settings.num_configurations // 10)
    print(
        f"All of it takes {times} to {times + 1} times as long as following in round 1. In a tenth of that, it makes a "
        f"policy that stands less well: --set pretraining.num_configurations={fewer}",
        flush=True,
    )
    rounds: list[TensorDict] = []
    errors: dict[str, list[float]] = {"training": [], "held_out": []}
    for i in range(settings.num_rounds):
        act = act_by_policy(actor) if i else None
        count = settings.num_configurations * (i + 1) // settings.num_rounds - sum(each.shape[1] for each in rounds)
        print(f"Round {i + 1} of {settings.num_rounds}: following {count} configurations.", flush=True)
        rounds.append(follow(task, controller, act, count, settings.num_steps))
        collection = select(rounds, settings)
        for name, values in supervise(task, actor, collection, settings).items():
            errors[name] += values
    return collection, errors


@single_threaded()
def follow(
    task: TorqueRobot, controller: WholeBodyController, act: Act | None, num_configurations: int, num_steps: int
) -> TensorDict:
    """Follow random configurations in closed loop; ``act`` moves them if given, otherwise the controller does.

    Returns:
        Pairs of shape (num_steps, num_configurations): ``observations`` of the group "policy" and the ``actions`` that
        lead to the controller's torques there (vectors), the ``mean_torque`` of the controller (mean absolute torque
        [N m]), the ``residual`` (:func:`residual_share`), and whether the robot is still ``upright`` (bool).
    """
    parts = []
    starts = range(0, num_configurations, task.num_envs)
    with Counter("following, step", len(starts) * num_steps) as counter:
        for start in starts:
            place_on_ground(task, controller.dynamics)
            upright = torch.ones_like(task.reset_buf)
            steps = []
            for _ in range(num_steps):
                decided = controller(task.sim.qpos, task.sim.qvel, task.feet_contact > 0)
                pairs = {
                    "observations": task.get_observations()["policy"],
                    "actions": task.actions_for(decided.total),
                    "mean_torque": decided.total.abs().mean(dim=1),
                    "residual": residual_share(controller, decided),
                    "upright": upright,
                }
                steps.append(TensorDict(pairs, [task.num_envs]))
                task.step(act(task) if act else pairs["actions"])  # they hold for a control step
                upright = upright & ~task.reset_buf
                counter.add()
            parts.append(TensorDict.stack(steps)[:, : num_configurations - start])
    return TensorDict.cat(parts, dim=1)


def select(rounds: list[TensorDict], settings: Any) -> Collection:
    """Keep the pairs that are worth learning, and hold back those of some configurations, the same ones every time.

    As in the paper, pairs of large torques are dropped; so are those whose contacts cannot nearly bear the wanted
    wrench, and those after a fall. ``rounds`` are those of :func:`follow`.
    """
    everything = TensorDict.cat(rounds, dim=1)
    reasons = {
        "after a fall": ~everything["upright"],
        f"mean torque over {settings.max_mean_torque:g} N m": ~(everything["mean_torque"] <= settings.max_mean_torque),
        f"wrench residual over {settings.max_residual:g}": ~(everything["residual"] <= settings.max_residual),
    }
    keep, dropped = torch.ones_like(everything["upright"]), {}
    for reason, mask in reasons.items():  # comparisons are written so that NaN fails them
        dropped[reason] = int((keep & mask).sum())
        keep = keep & ~mask
    counts = [each.shape[1] for each in rounds]
    held_out = torch.cat([torch.arange(count, device=keep.device) < settings.held_out * count for count in counts])
    pairs = everything.select("observations", "actions")
    training, measured = pairs[keep & ~held_out], pairs[keep & held_out]
    if not len(training) or not len(measured):
        raise UserError("pre-training has kept too few pairs: raise pretraining.num_configurations or its limits")
    texts = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
    print(f"Kept {int(keep.sum())} of {keep.numel()} pairs; dropped: {texts}.", flush=True)
    return Collection(training, measured, everything, dropped)


def residual_share(controller: WholeBodyController, decided: WholeBodyTorques) -> Tensor:
    """Return the part of the wanted wrench that the contacts cannot give, as a share of the weight. Shape: (n,)."""
    model = controller.dynamics.mj_model
    weight = float(model.body_mass.sum() * abs(model.opt.gravity[2]))
    force, moment = decided.wrench_residual.split(3, dim=1)
    return torch.cat([force, moment / controller.settings.arm], dim=1).norm(dim=1) / weight


def supervise(task: TorqueRobot, actor: MLPModel, collection: Collection, settings: Any) -> dict[str, list[float]]:
    """Train the actor's mean on the pairs and on their mirror images by their mean square error.

    Last actions are shuffled; otherwise the policy would copy them and could not correct its own mistakes.

    Returns:
        Root mean square errors of the torque actions after every epoch [N m], "training" and "held_out".
    """
    num_batches = math.ceil(len(collection.training) / settings.batch_size)
    optimizer = torch.optim.Adam(actor.parameters(), lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.num_epochs * num_batches)
    errors: dict[str, list[float]] = {"training": [], "held_out": []}
    with Counter("learning, epoch", settings.num_epochs) as counter:
        for _ in range(settings.num_epochs):
            losses = []
            order = torch.randperm(len(collection.training), device=task.device)
            for pairs in collection.training[order].split(settings.batch_size):
                error = imitation_errors(task, actor, pairs)
                optimizer.zero_grad()
                error.square().mean().backward()
                optimizer.step()
                schedule.step()
                losses.append(torque_loss(task, error.detach()))
            with torch.no_grad():
                batches = collection.held_out.split(settings.batch_size)
                held_out = [torque_loss(task, imitation_errors(task, actor, pairs)) for pairs in batches]
            for name, values in (("training", losses), ("held_out", held_out)):
                errors[name].append(task.cfg.control.torque_scale * float(torch.stack(values).mean().sqrt()))
            now = ", ".join(f"{name.replace('_', ' ')} {values[-1]:.2f} N m" for name, values in errors.items())
            counter.activity = f"root mean square error {now}"
            counter.add()
    print(f"Learned in {settings.num_epochs} epochs: root mean square error {now}.", flush=True)
    return errors


def imitation_errors(task: TorqueRobot, actor: MLPModel, pairs: TensorDict) -> Tensor:
    """Return the errors of the actor's mean actions on pairs and their mirror images. Shape: (2 pairs, num_actions)."""
    observations = exchange(pairs["observations"], task.observations.policy_columns("last_action"))
    observations = torch.cat([observations, task.mirror("policy", observations)])
    actions = torch.cat([pairs["actions"], task.mirror("actions", pairs["actions"])])
    return actor(TensorDict({"policy": observations}, [len(observations)])) - actions


def torque_loss(task: TorqueRobot, error: Tensor) -> Tensor:
    """Return the mean square of the errors of torque actions, which are the last ones. Scalar."""
    return error[:, -task.num_dof :].square().mean()


def exchange(observations: Tensor, columns: list[int]) -> Tensor:
    """Return observations with some columns of other samples, drawn at random. Shapes: (samples, size)."""
    others = observations[torch.randperm(len(observations), device=observations.device)]
    result = observations.clone()
    result[:, columns] = others[:, columns]
    return result


def make_controller(task: TorqueRobot, settings: WholeBodySettings | None = None) -> WholeBodyController:
    """Return the whole-body controller for the worlds of a task; without settings, with its own defaults.

    Its height is the task's, and one contact may always carry the robot.

    Raises:
        UserError: If a foot has several geoms, on which the forces are not determined.
    """
    points, feet = len(task.foot_names), len(task.foot_geoms)
    if points != feet:
        own = f"'{task.cfg.asset.file}' has {points} for {feet} feet"
        raise UserError(f"gravity pre-training needs a point per foot; {own}")
    dynamics = RobotDynamics(task.sim.mj_model, task.num_envs, task.device, task.foot_names)
    settings, model = settings or WholeBodySettings(), task.sim.mj_model
    weight = float(model.body_mass.sum()) * abs(float(model.opt.gravity[2]))
    force, height = max(settings.highest_force, HIGHEST_FORCE * weight), task.cfg.rewards.base_height_target
    settings = dataclasses.replace(settings, height=height, highest_force=force)
    return WholeBodyController(dynamics, task.default_dof_pos.tolist(), settings)


def act_by_controller(controller: WholeBodyController) -> Act:
    """Return the function that gives the actions for the controller's torques."""
    return lambda task: task.actions_for(controller(task.sim.qpos, task.sim.qvel, task.feet_contact > 0).total)


def act_by_policy(actor: MLPModel) -> Act:
    """Return the function that gives a policy's mean actions."""

    def actions(task: TorqueRobot) -> Tensor:
        with torch.no_grad():
            return actor(task.get_observations())

    return actions


def histogram(values: Tensor, highest: float, bins: int = 50) -> dict[str, list[float]]:
    """Return how many values fall into equal bins from 0; those beyond the highest count in the last one."""
    counts = torch.histc(values.clamp(max=highest), bins, 0.0, highest)
    return {"edges": torch.linspace(0.0, highest, bins + 1).tolist(), "counts": counts.tolist()}
