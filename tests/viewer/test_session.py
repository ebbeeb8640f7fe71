"""A live session: requests take effect between steps, mistakes do no harm, and steps come in real time."""

import math
import shutil
import threading
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from rsl_rl.models import RNNModel
from support.clock import Clock, wait_for
from support.sessions import new_session, tilted

from legged_torque.learning.memory import acting
from legged_torque.utils.errors import UserError
from legged_torque.viewer import session as session_module
from legged_torque.viewer.pacing import MAX_LAG, Pacer
from legged_torque.viewer.session import AS_LOADED, SCAN_INTERVAL

NUM_ENVS = 2
STEPS = (10_000_000, 20_000_000)  # of the checkpoints 0 and 1


@pytest.fixture
def make_session(tmp_path):
    """Factory of sessions, each with a folder and a clock of its own."""

    def make(name="a1_torque_multihead", steps=STEPS, **settings):
        clock = Clock()
        return new_session(
            tmp_path / f"{name}_{len(steps)}", name, NUM_ENVS, steps=steps, clock=clock, **settings
        ), clock

    return make


def ticks(session, count=1):
    """Carry out requests and step some times."""
    for _ in range(count):
        session.tick()


def ask(request, *args, count=1):
    """Request something of a session, and let it carry that out and step some times."""
    request(*args)
    ticks(request.__self__, count)


def actor_weights(session):
    """All numbers of the policy in one row."""
    return torch.cat([weight.flatten() for weight in session._runner.alg.actor.state_dict().values()])


def test_steps(make_session):
    """Each tick is one control step, and the snapshot is the task's state."""
    session, _ = make_session()
    assert session.snapshot is None and session.checkpoints == (0, 1)
    assert (session.checkpoint, session.trained_steps) == (1, 20_000_000)
    ticks(session, 3)
    snapshot, task = session.snapshot, session.task
    assert session.sim_time == pytest.approx(3 * task.dt)
    np.testing.assert_array_equal(snapshot.qpos, task.sim.qpos.numpy())
    np.testing.assert_array_equal(snapshot.torques, task.torques[0].numpy())
    np.testing.assert_array_equal(snapshot.velocities[:, :2], task.base_lin_vel[:, :2].numpy())
    assert [one.time for one in session.history] == pytest.approx([task.dt, 2 * task.dt, 3 * task.dt])
    assert session.history[-1] is snapshot and snapshot.world == 0
    assert int(task.total_steps) == 20_000_000  # curricula stay where they were
    session.follow_world(7)  # the last one there is
    session.tick()
    assert session.world == NUM_ENVS - 1 and len(session.history) == 1
    np.testing.assert_array_equal(session.snapshot.torques, task.torques[-1].numpy())


def test_rewards_of_a_last_step(make_session):
    """Where an episode ends, the terms are still those of the step, weighted and per second."""
    session, _ = make_session("a1_torque", **{"env.episode_length_s": 0.06, "rewards.only_positive_rewards": False})
    ticks(session, 3)
    assert session.task.episode_length_buf[0] == 0 and session.snapshot.falls == 0
    total = session.task.rew_buf[0].item() / session.task.dt
    assert total < 0.0 and session.snapshot.rewards.sum() == pytest.approx(total, rel=1e-4)


def test_command(make_session):
    """A command holds in all worlds, through resets, until commands are drawn again."""
    session, _ = make_session(**{"commands.resampling_probability": 0.5})
    session.set_command((0.5, -0.25, 0.75))
    assert session.command is None  # only requested
    ticks(session, 2)
    ask(session.reset, count=2)
    assert session.command == (0.5, -0.25, 0.75) and not session.requests
    np.testing.assert_array_equal(session.snapshot.commands, [[0.5, -0.25, 0.75]] * NUM_ENVS)
    ask(session.set_command, None, count=4)
    drawn = session.task.commands
    assert drawn.abs().max() <= 1.0 and len(drawn.unique()) == 3 * NUM_ENVS
    torch.manual_seed(3)
    session.task.command_generator.hold(None)
    once = session.task.commands.clone(), torch.get_rng_state()
    torch.manual_seed(3)
    session.hold(None)
    assert torch.equal(session.task.commands, once[0]) and torch.equal(torch.get_rng_state(), once[1])


def test_a_task_with_one_command(make_session):
    """It is that of the training, unless another is set."""
    session, _ = make_session(**{"commands.fixed": [0.5, 0.0, -0.25]})
    ticks(session, 2)
    np.testing.assert_array_equal(session.snapshot.commands, [[0.5, 0.0, -0.25]] * NUM_ENVS)
    ask(session.set_command, (0.25, 0.0, 0.0), count=2)
    np.testing.assert_array_equal(session.snapshot.commands, [[0.25, 0.0, 0.0]] * NUM_ENVS)
    ask(session.set_command, None, count=2)
    np.testing.assert_array_equal(session.snapshot.commands, [[0.5, 0.0, -0.25]] * NUM_ENVS)


@pytest.mark.parametrize(("angle", "expected"), [(0.0, 0.4), (math.pi / 2, 0.4 + math.pi / 2)])
def test_push(make_session, angle, expected):
    """A push adds a velocity along the trunk's heading, to which it has been turned before it was tilted."""
    session, _ = make_session()
    ask(session.set_paused, True)
    session.task.base_quat.copy_(torch.from_numpy(tilted(yaw=0.4)))
    before = session.task.sim.qvel.clone()
    ask(session.push, angle, 1.5, count=2)
    change = session.task.sim.qvel - before
    assert change[:, 2:].abs().max() == 0.0
    direction = torch.tensor([math.cos(expected), math.sin(expected)])
    torch.testing.assert_close(change[:, :2], 1.5 * direction.expand(NUM_ENVS, 2), atol=1e-5, rtol=0.0)


def test_pause_and_reset(make_session):
    """While paused nothing moves and requests still count; a reset starts episodes in all worlds."""
    session, _ = make_session()
    session.tick()
    session.set_paused(True)
    qpos, sim_time = session.task.sim.qpos.clone(), session.sim_time
    ticks(session, 3)
    assert session.is_paused and session.sim_time == sim_time and torch.equal(session.task.sim.qpos, qpos)
    ask(session.reset)
    torch.testing.assert_close(session.task.base_pos[:, 2], torch.full((NUM_ENVS,), 0.4))
    np.testing.assert_allclose(session.snapshot.qpos[:, 2], 0.4)
    assert session.task.episode_length_buf.tolist() == [0] * NUM_ENVS
    ask(session.set_paused, False)
    assert session.sim_time > sim_time


def test_mixing(make_session):
    """Weights can be set and given back to the curriculum, and stay set in a rebuilt task."""
    session, _ = make_session()
    trained = session.task.mixing.clone()
    assert session.mixing == pytest.approx({"position_residual": trained[0].item(), "torque": 1.0})
    assert 0.0 < trained[0] < 1.0
    ask(session.set_mixing, (0.25, 0.5))
    assert session.task.mixing.tolist() == [0.25, 0.5] and session.chosen_mixing
    session.set_perturbation("low")
    ask(session.load_checkpoint, 0)
    assert session.task.mixing.tolist() == [0.25, 0.5] and list(session.mixing.values()) == [0.25, 0.5]
    ask(session.set_mixing, None)
    assert session.task.mixing[0] > trained[0] and session.chosen_mixing is None  # checkpoint 0 is an earlier one


def test_companion(make_session, monkeypatch):
    """Another policy walks with the first one: step by step, under its command, pushed and reset with it."""
    session, _ = make_session("a1_torque", **{"commands.resampling_probability": 0.5})
    other = session.companion = make_session("a1_position")[0]
    assert session.mixing == {}
    for count in range(1, 7):
        session.tick()
        np.testing.assert_array_equal(other.snapshot.commands[0], session.snapshot.commands[0])
        assert other.sim_time == session.sim_time and int(other.task.episode_length_buf[0]) == count
    ask(session.set_paused, True, count=2)
    assert other.sim_time == session.sim_time
    before = other.task.sim.qvel[0, :2].clone()
    session.set_paused(False)
    ask(session.push, 0.0, 5.0)
    assert (other.task.sim.qvel[0, :2] - before).norm() > 3.0
    ask(session.reset)
    assert int(other.task.episode_length_buf[0]) == 1
    other.load_checkpoint(0)
    session.tick()
    assert other.checkpoint == 0 and session.checkpoint == 1
    monkeypatch.setattr(session, "_make_task", Mock(side_effect=UserError("no room")))
    ask(session.set_perturbation, "high", count=2)
    assert session.perturbation == other.perturbation == AS_LOADED and "no room" in session.message.text


def test_checkpoints(make_session, tmp_path):
    """Another checkpoint acts after a switch, while the robots walk on and curricula follow it; new ones are found."""
    session, clock = make_session()
    ticks(session, 2)
    before = actor_weights(session)
    ask(session.load_checkpoint, 0)
    assert (session.checkpoint, session.trained_steps) == (0, 10_000_000) and "model_0" in session.message.text
    assert not torch.equal(actor_weights(session), before)
    assert session.task.episode_length_buf.min() == 3  # no reset
    ask(session.load_checkpoint, 1)
    assert torch.equal(actor_weights(session), before)
    make_session(steps=(0, 0, 30_000_000))
    shutil.copy(tmp_path / "a1_torque_multihead_3" / "model_2.pt", tmp_path / "a1_torque_multihead_2")
    session.tick()
    assert session.checkpoints == (0, 1)  # it does not look all the time
    clock.now += SCAN_INTERVAL
    session.tick()
    assert session.checkpoints == (0, 1, 2) and session.checkpoint == 1
    ask(session.follow_newest, True, count=2)
    assert (session.checkpoint, session.trained_steps) == (2, 30_000_000)


def test_broken_checkpoint(make_session, tmp_path):
    """A checkpoint that cannot be loaded is reported in one line, and the old one acts on."""
    session, clock = make_session()
    (tmp_path / "a1_torque_multihead_2" / "model_3.pt").write_bytes(b"no checkpoint\n")
    session.tick()
    weights, steps = actor_weights(session), int(session.task.total_steps)
    ask(session.load_checkpoint, 3)
    text = session.message.text
    assert session.message.is_error and "model_3.pt" in text and "\n" not in text
    session.follow_newest(True)
    messages = []
    for _ in range(4):
        clock.now += SCAN_INTERVAL
        session.tick()
        messages.append(session.message)
    assert messages[-1] is messages[1]  # it is tried once, not every second
    assert session.checkpoint == 1 and torch.equal(actor_weights(session), weights)
    assert int(session.task.total_steps) == steps


def test_perturbation(make_session):
    """The task is rebuilt with the preset, with command and counters kept; a wrong name changes nothing."""
    session, _ = make_session()
    old = session.task
    session.set_command((0.5, 0.0, 0.0))
    ask(session.set_perturbation, "high", count=2)
    task = session.task
    assert task is not old and task.cfg.domain_rand.push_robots and not old.cfg.domain_rand.push_robots
    assert session.perturbation == "high" and int(task.total_steps) == 20_000_000
    np.testing.assert_array_equal(session.snapshot.commands, [[0.5, 0.0, 0.0]] * NUM_ENVS)
    assert len(session.history) == 2
    ask(session.set_perturbation, "hihg")
    assert session.message.is_error and "did you mean 'high'" in session.message.text
    assert session.task is task and session.perturbation == "high"
    ask(session.set_perturbation, AS_LOADED)
    assert not session.task.cfg.domain_rand.push_robots and session.perturbation == AS_LOADED


def test_tiles(make_session):
    """A policy that was trained on a plane walks on a tile; only the followed robot moves to another one."""
    kinds = {"stairs_up": 0.5, "pits": 0.5}
    session, _ = make_session("a1_torque", ground={"terrain_proportions": kinds, "curriculum": False})
    ticks(session, 3)
    ground, snapshot = session.task.terrain, session.snapshot
    assert snapshot.tile == (0, 0) and ground.levels.tolist() == [0, 1] and ground.columns.tolist() == [0, 1]
    assert snapshot.scan.shape == (17 * 11, 3)
    np.testing.assert_allclose(snapshot.scan[:, 2], ground.map.height(torch.from_numpy(snapshot.scan)), atol=1e-5)
    np.testing.assert_allclose(snapshot.scan[:, :2].mean(axis=0), snapshot.qpos[0, :2], atol=1e-5)
    other = session.task.sim.qpos[1].clone()
    session.set_paused(True)
    ask(session.set_tile, 2, 1)
    task = session.task
    assert ground.levels.tolist() == [2, 1] and ground.columns.tolist() == [1, 1]
    middle = torch.tensor([6.0, 3.0, -2 / 3 + 0.4])  # of a pit in the last of three rows and the second of two columns
    torch.testing.assert_close(task.base_pos[0], middle, atol=1e-4, rtol=0.0)
    np.testing.assert_allclose(session.snapshot.qpos[0, :3], middle, atol=1e-4)
    assert session.snapshot.tile == (2, 1)
    assert torch.equal(task.sim.qpos[1], other) and task.episode_length_buf.tolist() == [0, 3]
    session.set_tile(99, -1)
    ask(session.set_perturbation, "low")
    assert session.task is not task and session.task.terrain.levels.tolist() == [2, 1]
    for is_paused in (True, False):
        ask(session.set_paused, is_paused)
        assert session.task.terrain.columns.tolist() == [0, 1] and session.snapshot.tile == (2, 0)


def test_memory(make_session):
    """A recurrent policy starts each episode with nothing, also if a tile is chosen between a reset and its step."""
    session, _ = make_session("a1_torque", ground={"curriculum": False})
    obs = session.task.get_observations()
    model = RNNModel(obs, {"actor": ["policy"]}, "actor", session.task.num_actions, rnn_hidden_dim=8)
    session._policy = acting(model, lambda: session.task)
    ask(session.set_paused, False, count=3)
    session.set_paused(True)
    session.reset()
    ask(session.set_tile, 1, 0)
    seen = session._obs["policy"]
    ask(session.set_paused, False)
    torch.testing.assert_close(session.task.actions, model.mlp(model.rnn.rnn(seen[None])[0][0]))


def test_requests_from_other_threads(make_session, monkeypatch):
    """Many threads may ask while another one steps; every request is carried out, in that thread."""
    session, _ = make_session("a1_torque")
    pushes, rotate = [], session_module.quat_rotate_yaw
    watched = lambda *args: pushes.append(threading.current_thread()) or rotate(*args)  # noqa: E731
    monkeypatch.setattr(session_module, "quat_rotate_yaw", watched)
    stepping = threading.Thread(target=session.run)
    stepping.start()
    asking = [threading.Thread(target=lambda: [session.push(0.0, 0.0) for _ in range(10)]) for _ in range(3)]
    for thread in asking:
        thread.start()
    for thread in asking:
        thread.join()
    wait_for(lambda: not session.requests)
    session.stop()
    stepping.join(timeout=120)
    assert not stepping.is_alive() and pushes == 30 * [stepping]


def test_unexpected_errors(make_session, monkeypatch, capsys):
    """A request that cannot be carried out, for a known reason or another, is reported, and the robots walk on."""
    session, _ = make_session("a1_torque")
    ask(session.set_tile, 0, 0)
    assert session.message.text == "there are no tiles on a plane" and session.snapshot.tile is None
    monkeypatch.setattr(session_module, "quat_rotate_yaw", None)
    ask(session.push, 0.0, 1.0, count=2)
    assert session.message.is_error and "TypeError: 'NoneType'" in session.message.text
    assert len(session.history) == 3 and "Traceback" in capsys.readouterr().err


def test_pacer_real_time():
    """Steps come in time, however long they take, as long as that is shorter than a step."""
    clock = Clock()
    pacer = Pacer(0.02, clock, clock.sleep)
    begun = []
    for work in [0.005, 0.015, 0.0, 0.019] * 10:
        pacer.wait()
        begun.append(clock.now)
        clock.now += work
    assert begun == pytest.approx([100.0 + 0.02 * i for i in range(40)])
    assert pacer.rate == pytest.approx(1.0)


def test_pacer_behind():
    """A short delay is caught up, a long one forgotten; a machine that is too slow never sleeps and says how slow."""
    clock = Clock()
    pacer = Pacer(0.02, clock, clock.sleep)
    pacer.wait()
    clock.now += 0.05
    for _ in range(3):
        pacer.wait()
    assert clock.now == pytest.approx(100.06)
    clock.now += 2 * MAX_LAG
    begun = len(clock.slept)
    pacer.wait()
    pacer.wait()
    assert len(clock.slept) == begun + 1  # no rush of steps
    pacer.restart()
    clock.slept.clear()
    for _ in range(60):
        pacer.wait()
        clock.now += 0.04
    assert not clock.slept and pacer.rate == pytest.approx(0.5)
