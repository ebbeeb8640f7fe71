"""State that a task keeps from step to step, and its log."""

import mujoco
import numpy as np
import pytest
import torch
from support.settings import error_of

from legged_torque.learning.worlds import check_identity
from legged_torque.terrain.tiles import TILES


def test_velocities_and_gravity_in_the_trunk_frame(make_task):
    """Turned at random, velocities are those of mj_objectVelocity, and gravity is the world's, turned back."""
    task, rng = make_task("a1_torque", 8), np.random.default_rng(0)
    quats = rng.normal(size=(8, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    velocities = rng.normal(size=(8, 6))
    task.base_quat.copy_(torch.tensor(quats))
    task.sim.qvel[:, :6] = torch.tensor(velocities)
    task.state.update()
    model, local = task.sim.mj_model, np.zeros(6)
    data, trunk = mujoco.MjData(model), model.body("trunk").id
    for world in range(8):
        data.qpos[3:7], data.qvel[:6] = quats[world], velocities[world]
        mujoco.mj_forward(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, trunk, local, 1)
        np.testing.assert_allclose(task.base_ang_vel[world], local[:3], atol=2e-6)
        np.testing.assert_allclose(task.base_lin_vel[world], local[3:], atol=2e-6)
        gravity = data.xmat[trunk].reshape(3, 3).T @ (0, 0, -1)
        np.testing.assert_allclose(task.projected_gravity[world], gravity, atol=1e-6)


def test_state_dict(make_task):
    """A task that loads the state of another one has its counters and curricula, and goes on from there."""
    task, other = make_task("a1_multihead", 2), make_task("a1_multihead", 3)
    task.total_steps.fill_(4_321_098)
    task.sim.qpos[1, 0] = np.nan
    task.step(torch.zeros(2, 24))
    state = task.state_dict()
    task.step(torch.zeros(2, 24))  # must not change what was saved
    other.load_state_dict(state)
    assert other.total_steps.item() == 4_321_100 and other.num_diverged.item() == 1
    values = {key: value.item() for key, value in other.curriculum_values().items()}
    share = 4_321_100 / 10e6
    expected = {"weight_tracking_lin_vel": 4 - 2 * share, "weight_tracking_ang_vel": 0.1 + 0.9 * share}
    expected |= {"mixing_pd": 1 - 0.9 * 67 * 64_000 / 50e6, "mixing_torque": 1.0}
    assert values == pytest.approx(expected, rel=1e-6)
    other.step(torch.zeros(3, 24))
    assert other.total_steps.item() == 4_321_103


def test_a_name_is_kept_once(make_task):
    """A second tensor under a name would leave the first one out of checkpoints."""
    task = make_task("a1_torque", 2)
    phase = task.keep("phase", torch.zeros(2, 1))
    assert "task.keep has 'phase' twice" in error_of(task.keep, "phase", torch.ones(2, 1))
    assert task.world_state_dict()["task"]["phase"] is phase
    for other in (torch.zeros(()), torch.zeros(3, 2), torch.zeros(3, 2).T):  # no rows of worlds that lie in one piece
        assert "takes contiguous tensors with a row per world; 'other' is none" in error_of(task.keep, "other", other)


def test_actions_of_another_shape(make_task):
    """They are refused, also those that torch would repeat in all worlds."""
    task = make_task("a1_torque", 2)
    for shape in ((12,), (1, 12), (2, 1), (3, 12)):
        assert f"must have the shape (2, 12), not {shape}" in error_of(task.step, torch.zeros(shape))


def test_robots_that_are_put_into_the_air(make_task):
    """They touch nothing any more, as those of a new episode."""
    task = make_task("a1_torque", 2)
    task.base_pos[:, 2] = 0.2
    task.step(torch.zeros(2, 12))
    assert task.contacts.any() and task.state.contact_force.any()
    qpos = task.sim.qpos.clone()
    qpos[:, 2] = 2.0
    task.set_state(qpos, task.sim.qvel)
    assert torch.equal(task.sim.qpos, qpos)
    for name in ("contacts", "feet_contact", "contact_force"):
        assert not getattr(task.state, name).any(), name


def test_air_time_ends_with_a_touch(make_task):
    """The touching step is rewarded for the swing that it ends; then the count starts anew."""
    task = make_task("a1_torque", 1)
    task.feet_air_time.zero_()
    seen = []
    for touches in (0.0, 0.0, 0.0, 1.0, 1.0, 0.0):
        task.feet_contact.fill_(touches)
        seen.append(task._reward_feet_air_time().item())
        task.state.update_feet_air_time()
    np.testing.assert_allclose(seen, [0.0, 0.0, 0.0, 4 * (0.06 - 0.5), 4 * -0.5, 0.0], rtol=1e-5)
    np.testing.assert_allclose(task.feet_air_time, 0.02, rtol=1e-5)


def test_actions_and_joint_speeds_of_the_last_step(make_task):
    """Action rate and joint acceleration compare with the step before, with zero at the start of an episode."""
    task = make_task("a1_torque", 2, **{"init_state.pos": [0.0, 0.0, 2.0]})
    last_action, last_speed = torch.zeros(2, 12), torch.zeros(2, 12)
    rate, acceleration = (task.reward_names.index(term) for term in ("action_rate", "dof_acc"))
    for _ in range(3):
        before = task.episode_sums.clone()
        action = torch.randn(2, 12)
        task.step(action)
        gained = task.episode_sums - before
        np.testing.assert_allclose(gained[rate], -1e-6 * 0.02 * (action - last_action).square().sum(dim=1), rtol=2e-3)
        speed = task.sim.qvel[:, 6:].clone()
        change = ((speed - last_speed) / 0.02).square().sum(dim=1)
        np.testing.assert_allclose(gained[acceleration], -2.5e-7 * 0.02 * change, rtol=1e-3)
        last_action, last_speed = action, speed


def test_log(make_task):
    """The log gives mean tracking errors per step, and return, length and terms per ended episode, and starts anew."""
    task = make_task(
        "a1_torque",
        3,
        **{"env.episode_length_s": 0.1, "init_state.pos": [0.0, 0.0, 2.0], "rewards.only_positive_rewards": False},
    )
    task.episode_length_buf = torch.tensor([1, 0, 0])  # the first world's episode ends a step earlier
    returns, errors = torch.zeros(3), []
    for step in range(1, 6):
        commands, running = task.commands.clone(), task.episode_length_buf > 0
        task.step(torch.randn(3, 12))
        returns += task.rew_buf * (running | (step == 1))
        if step <= 3:
            velocity = torch.cat([task.base_lin_vel[:, :2], task.base_ang_vel[:, 2:]], dim=1)
            errors.append((velocity - commands).square())
        if step == 3:
            means = torch.cat(errors).mean(dim=0).tolist()
            assert task.log.read(0.1) == pytest.approx(
                {
                    "Tracking/error_xy": means[0] + means[1],
                    "Tracking/error_yaw": means[2],
                    "Health/diverged_worlds": 0.0,
                },
                rel=1e-4,
            )
    log = task.log.read(0.1)
    assert log["length"] == 5.0
    assert log["return"] == pytest.approx(returns.mean().item(), rel=1e-4)
    terms = {name: value for name, value in log.items() if name.startswith("Episode_Reward/")}
    assert set(terms) == {f"Episode_Reward/{term}" for term in task.reward_names}
    assert 0.1 * sum(terms.values()) == pytest.approx(log["return"], rel=1e-4)
    assert task.log.read(0.1) == {"Health/diverged_worlds": 0.0}


def test_worlds_know_their_map(make_task, monkeypatch):
    """Worlds do not go on where a kind of tile has changed: robots would be in the ground."""
    ground = {"num_rows": 1, "max_init_terrain_level": 0, "border_size": 1.0}
    changes = {f"terrain.{name}": value for name, value in ground.items()}

    def now():
        return make_task("a1_rough_position", 2, **changes).identity()

    was = now()
    check_identity(was, now())
    monkeypatch.setitem(TILES, "stairs_up", lambda difficulty, rng, grid: grid.flat() + 0.4)
    assert error_of(check_identity, was, now()) == "the map of the ground is another one"
