"""The paper's future work: approaches combined, a higher nominal pose, and positions and torques at two rates."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.control import CONVERGED, HIGH_UP, NOMINAL, TORQUE_LIMIT, mirror_policy, pd_by_hand, random_state, time_out
from support.settings import error_of, get_cfgs, torques_in_torch

from legged_torque.envs import A1TorqueCfg
from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.paper.gravity import pretraining as gravity_pretraining
from legged_torque.paper.gravity.pretraining import check_torques, pretrain

CURRICULUM, GRAVITY_CURRICULUM = "a1_torque_curriculum_multihead", "a1_torque_gravity_curriculum"
GRAVITY, HIGH, TWO_RATES = "a1_torque_gravity_multihead", "a1_torque_curriculum_high", "a1_multihead_two_rates"
PRETRAINING = {"num_configurations": 80, "num_steps": 6, "num_rounds": 2, "num_epochs": 20, "batch_size": 32}
INTERVAL = 4  # control steps of two rates for which position actions are held


def to_steps(task, total_steps):
    """Bring a task to a moment of training."""
    task.total_steps.fill_(total_steps)
    task.update_curriculum()


@pytest.mark.parametrize("total_steps", [0, 25_000_000, 60_000_000])
def test_actions_for_torques(make_task, total_steps):
    """At every weight of the PD part it gives nothing, and the torque part gives the wanted torques."""
    task = make_task(GRAVITY, 3)
    to_steps(task, total_steps)
    q, qd, _ = random_state(task)
    wanted = torch.linspace(-20.0, 20.0, 36).view(3, 12)
    actions = task.actions_for(wanted)
    np.testing.assert_allclose(pd_by_hand(actions[:, :12].numpy(), q, qd), 0.0, atol=1e-4)
    np.testing.assert_allclose(4.0 * actions[:, 12:], wanted, rtol=1e-5)
    torch.testing.assert_close(task._compute_torques(actions), wanted, rtol=1e-4, atol=1e-4)


def test_both_heads_are_pretrained(monkeypatch):
    """Actions of both heads come nearer to those for the controller's torques."""
    monkeypatch.setattr(gravity_pretraining, "STANDING_SECONDS", 0.1)  # of no interest here
    words = [f"--set=pretraining.{name}={value}" for name, value in PRETRAINING.items()]
    report = pretrain(GRAVITY, *get_cfgs("--num_envs=16", *words, task=GRAVITY), "cpu")[1]
    errors = report["rms_error"]["held_out"]
    assert len(errors) == 2 * 20 and errors[-1] < 0.8 * errors[0]


class Doubled(TorqueRobot):
    """A task whose torques are twice those that are wanted."""

    def _compute_torques(self, actions):
        return 2.0 * super()._compute_torques(actions)


def test_tasks_that_cannot_give_torques(make_task):
    """A task is refused by the name of its class if its actions are no torques or lead to others than wanted."""
    cfg, gravity = get_cfgs("--num_envs=1", task="a1_position")[0], get_cfgs(task="a1_torque_gravity")[1]
    message = "the actions of LeggedRobot are not torques"
    assert message in error_of(pretrain, "a1_position", cfg, gravity, "cpu")
    cfg = A1TorqueCfg()
    cfg.env.num_envs = 1
    message = "cannot give the torques that its actions_for is asked for"
    assert error_of(check_torques, Doubled(cfg)) == f"Doubled {message}"
    assert message in error_of(check_torques, make_task(GRAVITY, 1, **{"control.mixing.torque.start": 0.0}))
    for name in ("a1_torque", "a1_torque_curriculum", CURRICULUM, GRAVITY):
        check_torques(make_task(name, 1))


def test_higher_pose(make_task):
    """In MuJoCo's kinematics its feet touch the ground at 0.33 m, below the same places as in the lower pose."""
    task, low = make_task(HIGH, 1), make_task("a1_torque_curriculum", 1)
    model = task.sim.mj_model
    feet = [model.geom(name).id for name in task.foot_names]
    places = []
    for pose in (task.default_dof_pos, low.default_dof_pos):
        data = mujoco.MjData(model)
        data.qpos[:7], data.qpos[7:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], pose
        mujoco.mj_kinematics(model, data)
        places.append(data.geom_xpos[feet])
    np.testing.assert_allclose(0.02 - places[0][:, 2], 0.33, atol=5e-4)  # with the radius of a foot
    np.testing.assert_allclose(places[0][:, :2], places[1][:, :2], atol=4e-3)
    assert task.cfg.rewards.base_height_target == 0.33
    task.dof_pos.copy_(task.default_dof_pos)
    assert task._reward_nominal_position().item() == 1.0
    error = np.square(task.default_dof_pos.numpy() - NOMINAL).sum()
    task.dof_pos.copy_(low.default_dof_pos)
    assert task._reward_nominal_position().item() == pytest.approx(math.exp(-0.5 * error), rel=1e-4)


def held(sent):
    """The actions in force: positions of every fourth control step of an episode, torques of each."""
    result = sent.copy()
    for step in range(len(sent)):
        result[step, :, :12] = sent[step // INTERVAL * INTERVAL, :, :12]
    return result


@pytest.mark.parametrize("where", ["kernel", "torch"])
def test_positions_are_held(make_task, where):
    """Each control step is one of plain MuJoCo, with the newest torques and PD targets of every fourth step."""
    task = make_task(TWO_RATES, 2, **HIGH_UP, **CONVERGED)
    assert task.dt == pytest.approx(0.005) and task.max_episode_length == 4000
    if where == "torch":
        torques_in_torch(task)
    to_steps(task, 25_000_000)
    random_state(task)
    model, worlds = task.sim.mj_model, []
    for world in range(2):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = task.sim.qpos[world], task.sim.qvel[world]
        worlds.append(data)
    generator = np.random.default_rng(2)
    for step in range(2 * INTERVAL + 1):
        actions = generator.normal(size=(2, 24))
        if step % INTERVAL == 0:
            positions = actions[:, :12]
        task.step(torch.tensor(actions).float())
        for world, data in enumerate(worlds):
            torque = 0.55072 * pd_by_hand(positions[world], data.qpos[7:], data.qvel[6:]) + 4.0 * actions[world, 12:]
            data.ctrl[:] = np.clip(torque, -TORQUE_LIMIT, TORQUE_LIMIT)
            mujoco.mj_step(model, data)
            np.testing.assert_allclose(task.torques[world], data.ctrl, atol=3e-2)
            np.testing.assert_allclose(task.dof_pos[world], data.qpos[7:], atol=2e-3)


def test_observations_of_two_rates(make_task):
    """The phase of the interval and the actions in force are seen; both start anew with an episode, in its world."""
    task = make_task(TWO_RATES, 2, **HIGH_UP)
    (column,) = task.observations.policy_columns("position_phase")
    actions = task.observations.policy_columns("last_action")
    assert task.obs_buf["policy"].shape[1] == 58 and task.get_observations()["policy"][:, column].tolist() == [0.0, 0.0]
    phases, seen, sent = [], [], []
    for step in range(10):
        if step == 5:  # the last one of the first world's episode
            time_out(task, [0])
        sent.append(2.0 * torch.randn(2, 24))
        obs = task.step(sent[-1])[0]
        for group in ("policy", "critic"):
            torch.testing.assert_close(obs[group][:, column], obs["policy"][:, column])
        phases.append(obs["policy"][:, column].tolist())
        seen.append(obs["policy"][:, actions].numpy())
    first, second = zip(*phases, strict=True)
    assert first == (0.25, 0.5, 0.75, 0.0, 0.25, 0.0, 0.25, 0.5, 0.75, 0.0)
    assert second == (0.25, 0.5, 0.75, 0.0, 0.25, 0.5, 0.75, 0.0, 0.25, 0.5)
    sent = torch.stack(sent).numpy()
    expected = held(sent)
    expected[6:, 0] = held(sent[6:])[:, 0]
    expected[5, 0] = 0.0
    np.testing.assert_array_equal(np.stack(seen), expected)


def test_two_rates_in_the_mirror(make_task):
    """The phase is the same in the mirror; the rest is reflected, in every step of a history."""
    task = make_task(TWO_RATES, 2, **{"env.history_length": 2})
    seen = torch.randn(5, 2 * 58)
    mirrored = task.mirror("policy", seen).view(5, 2, 58)
    parts = seen.view(5, 2, 58)
    assert torch.equal(mirrored[..., 57], parts[..., 57])
    for step in range(2):
        torch.testing.assert_close(mirrored[:, step, :57], mirror_policy(parts[:, step, :57]))
