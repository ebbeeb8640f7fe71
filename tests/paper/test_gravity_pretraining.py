"""Gravity pre-training: the pairs, the supervision, and the report."""

import itertools

import pytest
import torch
from support.control import TORQUE_LIMIT, WEIGHT, mirror_joints, mirror_policy
from support.gravity import FEW, STD, TASK, words_of
from support.settings import error_of, get_cfgs, parse
from tensordict import TensorDict

from legged_torque.envs import task_registry
from legged_torque.paper.gravity.dynamics import RobotDynamics
from legged_torque.paper.gravity.pretrained import read_pretrained
from legged_torque.paper.gravity.pretraining import (
    Collection,
    act_by_controller,
    follow,
    make_controller,
    select,
    supervise,
)
from legged_torque.paper.gravity.standing import use_standing_trials
from legged_torque.paper.gravity.whole_body import WholeBodyController, WholeBodySettings
from legged_torque.terrain.layout import Layout
from legged_torque.utils.config import to_dict

TORQUE_SCALE = 8.0
LAST_ACTION = slice(33, 45)
"""Columns of the last action in the observations: after 9 numbers of the trunk, 12 angles and 12 velocities."""


def settings_of(**changes):
    """The task's settings of pre-training, some of them changed."""
    return get_cfgs(*words_of(**changes), task=TASK)[1].pretraining


def make_actor(task):
    """The policy of a training, with random weights that are the same every time."""
    torch.manual_seed(0)
    return task_registry.make_alg_runner(task, train_cfg=get_cfgs(task=TASK)[1], log_root=None)[0].alg.actor


@pytest.fixture(scope="module")
def task():
    """A task of 16 worlds as pre-training has it."""
    env_cfg, _ = get_cfgs("--num_envs=16", task=TASK)
    use_standing_trials(env_cfg, env_cfg.control.decimation)
    torch.manual_seed(0)
    return task_registry.make_env(TASK, parse(), env_cfg)[0]


@pytest.fixture(scope="module")
def controller(task):
    """The controller that is imitated, for the worlds of the task."""
    return make_controller(task, WholeBodySettings(**to_dict(settings_of().controller)))


def follow_noting(task, controller, act, num_configurations, num_steps):
    """Follow configurations, and note the task's state at each action.

    Returns:
        The result of :func:`follow`; positions, velocities, contacts of the feet, control steps since the start of the
        episode, and actions, each (num_steps, configurations, ...).
    """
    noted = []

    def noting(task):
        actions = act(task)
        state = (task.sim.qpos, task.sim.qvel, task.feet_contact > 0, task.episode_length_buf, actions)
        noted.append([part.clone() for part in state])
        return actions

    pairs = follow(task, controller, noting, num_configurations, num_steps)
    parts = [torch.stack(part).unflatten(0, (-1, num_steps)) for part in zip(*noted, strict=True)]
    return pairs, [part.transpose(0, 1).flatten(1, 2)[:, :num_configurations] for part in parts]


def test_report(made):
    """Every pair is kept or dropped for a reason, each configuration counts once, and errors fall."""
    root, file, report, output = made
    kept, dropped = report["pairs"], report["dropped"]
    assert set(dropped) == {"after a fall", "mean torque over 30 N m", "wrench residual over 3"}
    assert kept + sum(dropped.values()) == 41 * 6 and kept > 200
    for numbers in report["histograms"].values():
        assert sum(numbers["counts"]) == 41 * 6 and len(numbers["edges"]) == len(numbers["counts"]) + 1
    for errors in report["rms_error"].values():
        assert len(errors) == 2 * 3 and all(0.0 < error < TORQUE_LIMIT for error in errors)
    training = report["rms_error"]["training"]
    assert training[2] < training[0] and training[5] < training[3]
    assert report["standing"]["controller"] > 0.7 and 0.0 <= report["standing"]["policy"] <= 1.0
    given = {**FEW, "num_configurations": 41, "num_steps": 6, "seed": 1, "max_mean_torque": 30.0}
    assert {name: report["settings"][name] for name in given} == given and report["task"] == TASK
    assert f"Kept {kept} of 246 pairs; dropped: " in output and f"The policy is in {file.relative_to(root)}" in output
    assert read_pretrained(file)["report"] == report
    assert {path for path in root.rglob("*") if path.is_file()} == {file, root / "report.json"}


@pytest.mark.parametrize("actor", ["controller", "policy"])
def test_pairs(task, controller, actor):
    """Actions are the controller's torques over 8 N m in exactly the states of the observations, for both actors."""
    act = act_by_controller(controller) if actor == "controller" else lambda task: torch.randn(16, 12)
    torch.manual_seed(1)
    pairs, (qpos, qvel, touching, _, given) = follow_noting(task, controller, act, 21, 5)
    dynamics = RobotDynamics(task.sim.mj_model, 21 * 5, "cpu", task.foot_names)
    fresh = WholeBodyController(dynamics, task.default_dof_pos.tolist(), controller.settings)
    decided = fresh(qpos.flatten(0, 1), qvel.flatten(0, 1), touching.flatten(0, 1))
    torques = decided.total.unflatten(0, (5, 21))
    assert touching.any(dim=2)[-1].float().mean() > 0.2 and torques.abs().max() > 5.0
    torch.testing.assert_close(TORQUE_SCALE * pairs["actions"], torques, rtol=0, atol=1e-3)
    assert (torch.allclose(TORQUE_SCALE * given, torques, atol=1e-3)) == (actor == "controller")
    torch.testing.assert_close(pairs["mean_torque"], torques.abs().sum(dim=2) / 12, rtol=0, atol=1e-3)
    force, moment = decided.wrench_residual.unflatten(0, (5, 21)).split(3, dim=2)
    residuals = (force.square().sum(dim=2) + (moment / 0.2).square().sum(dim=2)).sqrt() / WEIGHT
    torch.testing.assert_close(pairs["residual"], residuals, rtol=0, atol=1e-3)

    w, x, y, z = qpos[..., 3:7].unbind(dim=2)
    gravity = torch.stack([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1], dim=2)
    angles = qpos[..., 7:] - torch.tensor([task.cfg.init_state.default_joint_angles[name] for name in task.dof_names])
    seen = pairs["observations"]
    assert seen.shape == (5, 21, 45) and pairs["upright"].all()
    torch.testing.assert_close(seen[..., :3], gravity, rtol=0, atol=1e-5)
    torch.testing.assert_close(seen[..., 3:6], 0.25 * qvel[..., 3:6])
    torch.testing.assert_close(seen[..., 9:21], angles)
    torch.testing.assert_close(seen[..., 21:33], 0.05 * qvel[..., 6:])
    assert (seen[0, :, LAST_ACTION] == 0.0).all()
    torch.testing.assert_close(seen[1:, :, LAST_ACTION], given[:-1])


def test_on_rough_ground():
    """Trials on rough ground start on level tiles at z = 0, which a policy that sees the ground sees, too."""
    env_cfg, _ = get_cfgs("--set=terrain.mesh_type=heightfield", "--set=terrain.measure_heights=True", task=TASK)
    use_standing_trials(env_cfg, 4)
    assert env_cfg.terrain.mesh_type == "heightfield" and env_cfg.terrain.measure_heights
    assert not env_cfg.terrain.curriculum and not Layout.of(env_cfg.terrain).heights().any()


def test_falls(task, controller):
    """Limp robots collapse; from the reset on, which starts their clocks anew, none of them counts as upright."""
    torch.manual_seed(3)
    pairs, (*_, clocks, _) = follow_noting(task, controller, lambda task: torch.zeros(16, 12), 20, 40)
    whole = clocks == torch.arange(40).unsqueeze(1)
    assert torch.equal(pairs["upright"], whole)
    assert whole[:5].all() and whole[-1].float().mean() < 0.5


def some_pairs(first, last):
    """Three steps of the configurations from the first number to the last: each pair knows its configuration."""
    numbers = torch.arange(first, last, dtype=torch.float32).expand(3, -1)
    steps = torch.arange(3.0).unsqueeze(1).expand_as(numbers)
    seen, upright = torch.stack([numbers, steps], dim=2), torch.ones_like(numbers, dtype=torch.bool)
    parts = {"mean_torque": 0.1 * steps, "residual": 0.0 * steps, "upright": upright}
    return TensorDict({"observations": seen, "actions": -seen, **parts}, numbers.shape)


def test_dropped_pairs(capsys):
    """A pair is dropped for the first reason that holds; limits themselves are allowed; all rounds are kept."""
    first, second = rounds = [some_pairs(0, 300), some_pairs(300, 400)]
    first["upright"][1:, 0] = False
    first["mean_torque"][1, 0] = first["residual"][2, 0] = 99.0  # counts as fallen
    first["mean_torque"][:, 1] = 30.01
    first["residual"][0, 1] = 99.0  # counts as a large torque
    first["mean_torque"][:, 2] = 30.0
    second["residual"][2, 3] = 3.01
    second["residual"][1, 4] = 3.0
    collection = select(rounds, settings_of())
    assert collection.dropped == {"after a fall": 2, "mean torque over 30 N m": 3, "wrench residual over 3": 1}
    assert "Kept 1194 of 1200 pairs; dropped: 2 after a fall, 3 mean torque over 30 N m, 1 " in capsys.readouterr().out
    pairs = torch.cat([collection.training, collection.held_out])
    assert torch.equal(pairs["actions"], -pairs["observations"])
    everything = {(number, step) for number in range(400) for step in range(3)}
    missing = {(0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (303, 2)}
    assert sorted(map(tuple, pairs["observations"].tolist())) == sorted(everything - missing)
    assert collection.everything.shape == (3, 400)  # dropped ones included
    second["upright"][:] = first["upright"][:] = False
    assert "pre-training has kept too few pairs" in error_of(select, rounds, settings_of())


def test_held_out_configurations_stay_so():
    """The pairs that measure the policy in the end are never learned from in an earlier round, and some are new."""
    starts = (0, 200, 300, 330)
    rounds = [some_pairs(*ends) for ends in itertools.pairwise(starts)]
    collections = [select(rounds[:count], settings_of()) for count in (1, 2, 3)]
    measured = collections[-1].held_out["observations"][:, 0].unique()
    assert not any(torch.isin(collection.training["observations"][:, 0], measured).any() for collection in collections)
    assert torch.histogram(measured, torch.tensor(starts).float()).hist.tolist() == [20, 10, 3]


def collection_of(observations, actions):
    """Pairs of which the first 50 are held out."""
    pairs = TensorDict({"observations": observations, "actions": actions}, [len(actions)])
    return Collection(pairs[50:], pairs[:50], pairs, {})


def test_supervision(task):
    """A spring is learned from its pairs; errors are those of the policy, in N m; exploration stays what it was."""
    actor, observations = make_actor(task), torch.randn(400, 45)
    observations[:, LAST_ACTION] = 0.0  # so that exchanging them changes nothing
    collection = collection_of(observations, -observations[:, 9:21])
    errors = supervise(task, actor, collection, settings_of(num_epochs=20, batch_size=50))
    assert {name: len(values) for name, values in errors.items()} == {"training": 20, "held_out": 20}
    assert errors["training"][-1] < 0.5 * errors["training"][0]
    assert errors["held_out"][-1] < 0.6 * TORQUE_SCALE  # without learning: 8 N m, since actions are standard normal
    assert errors["held_out"][-1] > errors["training"][-1]
    seen, wanted = collection.held_out["observations"], collection.held_out["actions"]
    with torch.no_grad():
        wrong = [actor({"policy": seen}) - wanted, actor({"policy": mirror_policy(seen)}) - mirror_joints(wanted)]
    expected = TORQUE_SCALE * torch.cat(wrong).square().mean().sqrt().item()
    assert errors["held_out"][-1] == pytest.approx(expected, rel=1e-3)
    assert (dict(actor.named_parameters())[STD] == 0.0).all()


def test_the_last_action_is_no_help(task):
    """A policy cannot learn to copy its last action, even where that gives the answer and nothing else does."""
    actor, observations, actions = make_actor(task), torch.zeros(400, 45), torch.randn(400, 12)
    observations[:, LAST_ACTION] = actions
    errors = supervise(task, actor, collection_of(observations, actions), settings_of(num_epochs=10, batch_size=50))
    assert errors["held_out"][-1] > 0.95 * TORQUE_SCALE
