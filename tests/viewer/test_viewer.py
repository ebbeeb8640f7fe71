"""A session that is watched live: what can be asked of it takes effect between steps, and mistakes do no harm."""

import argparse
import dataclasses
import math
import runpy
import shutil
import sys
import threading

import numpy as np
import pytest
import torch
from support.clock import Clock

from legged_torque import SCRIPTS_DIR
from legged_torque.envs import task_registry
from legged_torque.utils.config import set_by_path, to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.runs import checkpoint_file
from legged_torque.utils.task_registry import LoadedRun
from legged_torque.viewer import native
from legged_torque.viewer.reading import watched
from legged_torque.viewer.session import FASTEST, SCAN_INTERVAL, SLOWEST, Session
from legged_torque.viewer.state import AS_LOADED

NUM_ENVS = 2


def make_runner(make_task, name, **overrides):
    """A runner of a task with two worlds, and the task's settings."""
    env = make_task(name, num_envs=NUM_ENVS, **overrides)
    return task_registry.make_alg_runner(env, name, log_root=None)[0]


def save(runner, folder, number, steps=0, seed=0):
    """Save a checkpoint of random weights after a number of steps."""
    torch.manual_seed(seed + number)
    with torch.no_grad():
        for parameter in runner.alg.actor.parameters():
            parameter.normal_(0.0, 0.02)
    runner.env.total_steps.fill_(steps)
    runner.current_learning_iteration, runner.logger.tot_timesteps = number, steps
    runner.save(str(folder / f"model_{number}.pt"))


@pytest.fixture(scope="module")
def runs(make_task, tmp_path_factory):
    """Folders of runs with checkpoints 1 and 2, by task."""
    folders = {}
    for name in ("a1_position", "a1_torque", "a1_torque_multihead"):
        folders[name] = tmp_path_factory.mktemp(name)
        runner = make_runner(make_task, name)
        for number in (1, 2):
            save(runner, folders[name], number, steps=number * 10_000_000)
    return folders


@pytest.fixture
def make_session(runs, make_task, tmp_path):
    """Factory of sessions with checkpoint 2 of a task in a folder of their own, and a clock that does not run."""

    def make(name="a1_torque_multihead", **overrides):
        folder = shutil.copytree(runs[name], tmp_path / "run")
        clock = Clock()
        env_cfg, train_cfg = task_registry.get_cfgs(name)
        for path, value in {"env.num_envs": NUM_ENVS, **overrides}.items():
            set_by_path(env_cfg, path, value)
        run = LoadedRun(folder, {}, env_cfg, train_cfg, checkpoint_file(folder, 2))
        torch.manual_seed(1)
        session = Session(task_registry.get_task_class(name), run, "cpu", clock, clock.sleep)
        return session, clock, folder

    return make


def ticks(session, count):
    """Step some times."""
    for _ in range(count):
        session.tick()


def actor_weights(session):
    """All numbers of the policy, in one row."""
    return torch.cat([weight.flatten() for weight in session._runner.alg.actor.state_dict().values()])


def test_steps_and_readings(make_session):
    """Each tick is one control step, and what is read is the task's state."""
    session, _, _ = make_session()
    assert session.state.reading is None and session.state.checkpoints == (1, 2)
    assert (session.state.checkpoint, session.state.trained_steps) == (2, 20_000_000)
    ticks(session, 3)
    state, task = session.state, session.task
    assert state.time == pytest.approx(3 * task.dt)
    np.testing.assert_array_equal(state.reading.qpos, task.sim.qpos.numpy())
    np.testing.assert_array_equal(state.reading.torques, task.torques[0].numpy())
    np.testing.assert_array_equal(state.reading.velocities[:, :2], task.base_lin_vel[:, :2].numpy())
    assert [reading.time for reading in session.history] == pytest.approx([task.dt, 2 * task.dt, 3 * task.dt])
    assert session.history[-1] is state.reading and state.reading.world == 0
    assert int(task.total_steps) == 20_000_000  # curricula stay where they were


def test_reward_terms(make_session):
    """The terms are those of one step, weighted and per second; where an episode ends, they are still its own."""
    session, _, _ = make_session("a1_torque", **{"env.episode_length_s": 0.06})
    for step in range(1, 5):
        before = session.task.episode_sums.clone()
        session.tick()
        rewards, task = session.state.reading.rewards, session.task
        assert rewards.shape == (len(task.reward_names),)
        if step % 3:
            expected = (task.episode_sums - before)[:, 0] / task.dt
            np.testing.assert_allclose(rewards, expected.numpy(), rtol=1e-4, atol=1e-6)
    assert set(session.state.rewards) == set(task.reward_names)


@pytest.mark.parametrize("name", ["a1_position", "a1_torque", "a1_torque_multihead"])
def test_torque_parts(make_session, name):
    """The parts of weighted action terms sum to the torque, and a task without weights has no parts."""
    session, _, _ = make_session(name)
    task = session.task
    task.motors.strength.fill_(0.9)
    ticks(session, 3)
    reading = session.state.reading
    if name != "a1_torque_multihead":
        assert reading.torque_parts.shape == (0, 12)
        return
    low, high = task.torque_limits.numpy()
    pd, direct = reading.torque_parts
    np.testing.assert_allclose(np.clip(pd + direct, low, high), reading.torques, rtol=1e-5, atol=1e-5)
    assert np.any(pd) and np.any(direct)
    expected = 0.9 * task.mixing[1] * task.torque_scale[0] * task.actions[0, 12:]
    np.testing.assert_allclose(direct, expected.numpy(), rtol=1e-4, atol=1e-4)


NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=NEEDS_GPU)])
def test_watching_changes_nothing(device):
    """A watched task does what the task does, and its parts are right in a CUDA graph too.

    On a CPU the bits are the same; on a GPU torch computes the torques, which the physics kernel rounds otherwise.
    """
    task_class = task_registry.get_task_class("a1_torque_multihead")
    env_cfg, _ = task_registry.get_cfgs("a1_torque_multihead")
    env_cfg.env.num_envs = NUM_ENVS
    results = []
    for made_of in (task_class, watched(task_class)):
        torch.manual_seed(2)
        task = made_of(env_cfg, device)
        for step in range(5):
            obs = task.step(torch.sin(step + torch.arange(NUM_ENVS * 24.0, device=device)).view(NUM_ENVS, 24))[0]
        results.append(obs["critic"])
    tolerance = 0.0 if device == "cpu" else 1e-3
    torch.testing.assert_close(*results, rtol=tolerance, atol=tolerance)
    total = task.torque_parts.sum(dim=0).clamp(*task.torque_limits)
    torch.testing.assert_close(total, task.torques, rtol=1e-5, atol=1e-4)


def test_command(make_session):
    """A command holds in all worlds, through resets, until commands are drawn again."""
    session, _, _ = make_session(**{"commands.resampling_probability": 0.5})
    session.set_command((0.5, -0.25, 0.75))
    assert session.state.command is None  # only a note so far
    ticks(session, 2)
    session.reset()
    ticks(session, 2)
    assert session.state.command == (0.5, -0.25, 0.75)
    np.testing.assert_array_equal(session.state.reading.commands, [[0.5, -0.25, 0.75]] * NUM_ENVS)
    scales = session.task.cfg.normalization.obs_scales
    observed = session._obs["policy"][:, 6:9] / torch.tensor([scales.lin_vel, scales.lin_vel, scales.ang_vel])
    torch.testing.assert_close(observed, session.task.commands)
    session.set_command(None)
    ticks(session, 4)
    drawn = session.task.commands
    assert drawn.abs().max() <= 1.0 and len(drawn.unique()) == 3 * NUM_ENVS


def test_push(make_session):
    """A push adds a velocity in the direction in which each trunk looks, once."""
    session, _, _ = make_session()
    session.set_paused(True)
    session.tick()
    for world, yaw in enumerate((0.0, math.pi / 2)):
        session.task.base_quat[world] = torch.tensor([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    before = session.task.sim.qvel.clone()
    session.push(0.0, 1.5)
    ticks(session, 2)
    change = session.task.sim.qvel - before
    expected = torch.zeros_like(change)
    expected[0, 0] = expected[1, 1] = 1.5
    torch.testing.assert_close(change, expected, atol=1e-5, rtol=0.0)
    session.push(math.pi / 2, 1.0)
    session.tick()
    torch.testing.assert_close((session.task.sim.qvel - before)[0, :2], torch.tensor([1.5, 1.0]), atol=1e-5, rtol=0.0)


def test_pause_and_reset(make_session):
    """While paused nothing moves and requests still count; a reset starts episodes in all worlds."""
    session, _, _ = make_session()
    ticks(session, 2)
    session.set_paused(True)
    session.tick()
    qpos, simulated = session.task.sim.qpos.clone(), session.state.time
    ticks(session, 3)
    assert session.state.is_paused and session.state.time == simulated
    torch.testing.assert_close(session.task.sim.qpos, qpos, rtol=0.0, atol=0.0)
    session.reset()
    session.tick()
    assert not torch.equal(session.task.sim.qpos, qpos)
    torch.testing.assert_close(session.task.base_pos[:, 2], torch.full((NUM_ENVS,), 0.4))
    assert session.task.episode_length_buf.tolist() == [0] * NUM_ENVS
    session.set_paused(False)
    session.tick()
    assert session.state.time > simulated


def test_follow_world(make_session):
    """History, torques and rewards are those of the followed world; a world that does not exist is the last one."""
    session, _, _ = make_session()
    ticks(session, 2)
    session.follow_world(7)
    session.tick()
    assert session.state.world == NUM_ENVS - 1
    np.testing.assert_array_equal(session.state.reading.torques, session.task.torques[-1].numpy())
    assert len(session.history) == 1


def test_mixing(make_session):
    """Weights can be set and given back to the curriculum, and stay set in a rebuilt task."""
    session, _, _ = make_session()
    trained = session.task.mixing.clone()
    assert session.state.mixing == pytest.approx({"position_residual": trained[0].item(), "torque": 1.0})
    assert 0.0 < trained[0] < 1.0
    session.set_mixing((0.25, 0.5))
    session.tick()
    assert session.task.mixing.tolist() == [0.25, 0.5] and session.state.is_mixing_set
    session.set_perturbation("low")
    session.load_checkpoint(1)
    session.tick()
    assert session.task.mixing.tolist() == [0.25, 0.5] and list(session.state.mixing.values()) == [0.25, 0.5]
    session.set_mixing(None)
    session.tick()
    assert session.task.mixing[0] > trained[0] and not session.state.is_mixing_set  # checkpoint 1 is an earlier one


def test_companion(make_session, runs, tmp_path):
    """Another policy walks with the first one: step by step, under its command, pushed and reset with it."""
    session, _, _ = make_session("a1_torque", **{"commands.resampling_probability": 0.5})
    env_cfg, train_cfg = task_registry.get_cfgs("a1_position")
    env_cfg.env.num_envs = 1
    run = LoadedRun(runs["a1_position"], {}, env_cfg, train_cfg, checkpoint_file(runs["a1_position"], 1))
    other = session.companion = Session(task_registry.get_task_class("a1_position"), run, "cpu")
    for count in range(1, 7):
        session.tick()
        np.testing.assert_array_equal(other.state.reading.commands[0], session.state.reading.commands[0])
        assert other.state.time == session.state.time and int(other.task.episode_length_buf[0]) == count
    session.set_paused(True)
    ticks(session, 2)
    assert other.state.time == session.state.time
    before = other.task.sim.qvel[0, :2].clone()
    session.set_paused(False)
    session.push(0.0, 5.0)
    session.tick()
    assert (other.task.sim.qvel[0, :2] - before).norm() > 3.0
    session.reset()
    session.tick()
    assert int(other.task.episode_length_buf[0]) == 1
    other.load_checkpoint(2)
    session.tick()
    assert other.state.checkpoint == 2 and session.state.checkpoint == 2


def test_no_mixing(make_session):
    """Other tasks have no weights."""
    session, _, _ = make_session("a1_torque")
    session.set_mixing(())
    session.tick()
    assert session.state.mixing == {}


def test_checkpoints(make_session):
    """Another checkpoint acts after a switch, while the robots walk on and curricula follow it."""
    session, _, _ = make_session()
    ticks(session, 2)
    before, simulated = actor_weights(session), session.state.time
    session.load_checkpoint(1)
    session.tick()
    assert (session.state.checkpoint, session.state.trained_steps) == (1, 10_000_000)
    assert not torch.equal(actor_weights(session), before)
    assert session.state.time == pytest.approx(simulated + session.task.dt) and "model_1" in session.state.message
    assert session.task.episode_length_buf.min() == 3  # no reset
    session.load_checkpoint(2)
    session.tick()
    assert torch.equal(actor_weights(session), before)


def test_new_checkpoint(make_session, make_task):
    """A checkpoint that appears is found, and acts if the newest one is wanted."""
    session, clock, folder = make_session()
    session.tick()
    save(make_runner(make_task, "a1_torque_multihead"), folder, 10, steps=30_000_000)
    session.tick()
    assert session.state.checkpoints == (1, 2)  # it does not look all the time
    clock.now += SCAN_INTERVAL
    session.tick()
    assert session.state.checkpoints == (1, 2, 10) and session.state.checkpoint == 2
    session.follow_newest(True)
    ticks(session, 2)
    assert (session.state.checkpoint, session.state.trained_steps) == (10, 30_000_000)


@pytest.mark.parametrize("content", ["text", "half", "other task", "gone"])
def test_broken_checkpoint(make_session, runs, content):
    """A checkpoint that cannot be loaded is told in one line, and the old one acts on."""
    session, clock, folder = make_session()
    good = (folder / "model_2.pt").read_bytes()
    other = (runs["a1_torque"] / "model_2.pt").read_bytes()
    broken = {"text": b"no checkpoint\n", "half": good[: len(good) // 2], "other task": other}
    if content in broken:
        (folder / "model_3.pt").write_bytes(broken[content])
    session.tick()
    weights, steps = actor_weights(session), int(session.task.total_steps)
    session.load_checkpoint(3)
    session.tick()
    assert session.state.is_error and "model_3.pt" in session.state.message and "\n" not in session.state.message
    assert session.state.checkpoint == 2 and torch.equal(actor_weights(session), weights)
    assert int(session.task.total_steps) == steps
    session.follow_newest(True)
    numbers = []
    for _ in range(4):
        clock.now += SCAN_INTERVAL
        session.tick()
        numbers.append(session.state.message_number)
    assert session.state.checkpoint == 2 and numbers[-1] == numbers[1]  # it is tried once, not every second


def test_perturbation(make_session):
    """The task is rebuilt with the preset, in place, with command and counters kept; a wrong name changes nothing."""
    session, _, _ = make_session()
    old = session.task
    assert session.perturbations()[0] == AS_LOADED and "high" in session.perturbations()
    session.set_command((0.5, 0.0, 0.0))
    session.set_perturbation("high")
    ticks(session, 2)
    task = session.task
    assert task is not old and task.cfg.domain_rand.push_robots and not old.cfg.domain_rand.push_robots
    assert (session.state.perturbation, session.state.task_number) == ("high", 2)
    assert int(task.total_steps) == 20_000_000 and session._runner.env is task
    np.testing.assert_array_equal(session.state.reading.commands, [[0.5, 0.0, 0.0]] * NUM_ENVS)
    assert len(session.history) == 2
    session.set_perturbation("hihg")
    session.tick()
    assert session.state.is_error and "did you mean 'high'" in session.state.message
    assert session.task is task and session.state.perturbation == "high"
    session.set_perturbation(AS_LOADED)
    session.tick()
    assert not session.task.cfg.domain_rand.push_robots and session.state.perturbation == AS_LOADED


ROUGH = {"mesh_type": "heightfield", "num_rows": 3, "num_cols": 2, "tile_size": 6.0, "border_size": 1.0}
ROUGH |= {"curriculum": False, "terrain_proportions": {"stairs_up": 0.5, "pits": 0.5}}


def rough(shares):
    """Dotted paths and values of a small rough map."""
    ground = {f"terrain.{name}": value for name, value in ROUGH.items() if name != "terrain_proportions"}
    return ground | {
        f"terrain.terrain_proportions.{kind}": ROUGH["terrain_proportions"].get(kind, 0.0) for kind in shares
    }


def test_tiles(make_session):
    """A policy that was trained on a plane is watched on a tile; only the followed robot moves to another one."""
    shares = to_dict(task_registry.get_cfgs("a1_torque")[0].terrain.terrain_proportions)
    session, _, _ = make_session("a1_torque", **rough(shares))
    ticks(session, 3)
    ground, reading = session.task.terrain, session.state.reading
    assert reading.tile.tolist() == [0, 0] and ground.levels.tolist() == [0, 1] and ground.columns.tolist() == [0, 1]
    assert reading.scan.shape == (17 * 11, 3)
    np.testing.assert_allclose(reading.scan[:, 2], ground.height(torch.from_numpy(reading.scan)).numpy(), atol=1e-5)
    np.testing.assert_allclose(reading.scan[:, :2].mean(axis=0), reading.qpos[0, :2], atol=1e-5)
    other = session.task.sim.qpos[1].clone()
    session.set_paused(True)
    session.set_tile(2, 1)
    session.tick()
    task = session.task
    assert ground.levels.tolist() == [2, 1] and ground.columns.tolist() == [1, 1]
    middle = torch.tensor([6.0, 3.0, -2 / 3 + 0.4])  # of a pit in the last of three rows and the second of two columns
    torch.testing.assert_close(task.base_pos[0], middle, atol=1e-4, rtol=0.0)
    assert torch.equal(task.sim.qpos[1], other) and task.episode_length_buf.tolist() == [0, 3]
    session.set_tile(99, -1)
    session.set_perturbation("low")
    session.set_paused(False)
    ticks(session, 2)
    assert session.task is not task and session.task.terrain.levels.tolist() == [2, 1]
    assert session.task.terrain.columns.tolist() == [0, 1] and session.state.reading.tile.tolist() == [2, 0]


def test_no_tiles_on_a_plane(make_session):
    """There are none to choose, and nothing is scanned."""
    session, _, _ = make_session("a1_torque")
    session.set_tile(0, 0)
    session.tick()
    assert session.state.is_error and "plane" in session.state.message
    assert session.state.reading.tile.shape == (0,) and session.state.reading.scan.shape == (0, 3)


def test_requests_from_other_threads(make_session):
    """Many threads may ask while another one steps; every request is carried out, in that thread."""
    session, _, _ = make_session("a1_torque")
    threads_seen = set()
    tell = session._tell
    session._tell = lambda *args: (threads_seen.add(threading.current_thread().name), tell(*args))
    stepping = threading.Thread(target=session.run, name="stepping")
    stepping.start()

    def ask():
        for _ in range(10):
            session.push(0.0, 0.0)

    asking = [threading.Thread(target=ask) for _ in range(3)]
    for thread in asking:
        thread.start()
    for thread in asking:
        thread.join()
    session.set_paused(True)
    while not session.state.is_paused:
        pass
    session.stop()
    stepping.join(timeout=10)
    assert not stepping.is_alive() and threads_seen == {"stepping"} and session.state.message_number >= 30


def test_speed_of_a_session(make_session):
    """The speed stays within its limits, and the clock shows it."""
    session, clock, _ = make_session("a1_torque")
    for asked, speed in ((0.5, 0.5), (0.0, SLOWEST), (9.0, FASTEST)):
        session.set_speed(asked)
        session.tick()
        start = clock.now
        ticks(session, 3)
        assert session.state.speed == speed == pytest.approx(3 * session.task.dt / (clock.now - start))


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf, 1e30])
def test_numbers_that_no_slider_sends(make_session, number):
    """A page of somebody else's making may send them: they are refused in red, and nothing changes."""
    session, _, _ = make_session()
    session.set_paused(True)
    session.tick()
    before, velocities = session.state, session.task.sim.qvel.clone()
    asked = {
        "a command": lambda: session.set_command((0.1, number, 0.0)),
        "a push": lambda: session.push(0.0, number),
        "a speed": lambda: session.set_speed(number),
        "a weight": lambda: session.set_mixing([0.5, number]),
    }
    for count, (what, ask) in enumerate(asked.items(), start=1):
        ask()
        session.tick()
        assert session.state.message.startswith(what) and session.state.is_error
        shown = {"message": session.state.message, "is_error": True, "message_number": before.message_number + count}
        assert dataclasses.replace(before, **shown) == session.state
    assert torch.equal(session.task.sim.qvel, velocities) and session.task.commands.isfinite().all()


def test_keys(make_session):
    """The keys of the native viewer ask for what stands beside them, within the limits of the training."""
    session, _, _ = make_session("a1_torque")
    keyboard = native.Keyboard(session)
    for key, count in ((265, 3), (264, 1), (44, 15), (46, 1), (263, 2), (262, 3)):
        for _ in range(count):
            keyboard.press(key)
    session.tick()
    assert session.state.command == pytest.approx((0.2, 0.9, -0.1))
    keyboard.press(ord("0"))
    keyboard.press(ord("P"))
    keyboard.press(ord("A"))  # means nothing
    session.tick()
    assert session.state.command == (0.0, 0.0, 0.0) and "pushed" in session.state.message
    keyboard.press(ord(" "))
    keyboard.press(ord("R"))
    session.tick()
    assert session.state.is_paused and session.state.message == "reset"


def test_joints_by_leg():
    """Legs follow from the robot's settings, whatever their number of joints; joints of no leg are "other" ones."""
    plots = pytest.importorskip("legged_torque.viewer.plots", reason="the extra 'viewer' is not installed")
    joints = ["R_hip", "R_knee", "waist", "L_hip", "L_knee", "L_ankle"]
    assert plots.joints_by_leg(joints, [["R", "L"]]) == {"R": [0, 1], "other": [2], "L": [3, 4, 5]}
    assert plots.joints_by_leg(joints[:2], []) == {"other": [0, 1]}


def test_no_display(monkeypatch):
    """Without a screen the native viewer says so."""
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(UserError, match="needs a screen; --viewer web works without one"):
        native.check_display("--viewer web")


def test_missing_extra(monkeypatch):
    """Without the extra, one line says which one it is; the session needs none."""
    monkeypatch.setenv("MUJOCO_GL", "disable")  # given back afterwards: play.py chooses another one
    monkeypatch.setitem(sys.modules, "viser", None)
    for name in ("web", "scene", "controls", "plots"):
        monkeypatch.delitem(sys.modules, f"legged_torque.viewer.{name}", raising=False)
    play = runpy.run_path(str(SCRIPTS_DIR / "play.py"))
    args = argparse.Namespace(viewer="web", task="a1_torque", host="127.0.0.1", port=8080)
    with pytest.raises(UserError, match=r"pip install 'legged_torque\[viewer\]'"):
        play["import_viewer"](args)
