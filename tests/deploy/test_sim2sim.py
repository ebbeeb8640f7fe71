"""An exported policy in plain MuJoCo: joints by name, metrics and physics as in the task, mistakes in one line."""

import json
import math
import re
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import torch
from support.exports import XML, export_random
from support.scripts import assert_told_in_one_line, run_here

from legged_torque.deploy.description import check
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.deploy.simulation import Simulation, quaternion
from legged_torque.utils.metrics import ratios
from legged_torque.viewer import video

STILL = (np.zeros(3), np.zeros(3), np.zeros(12))


def test_imports_neither_torch_nor_warp():
    """What runs on a robot needs none of the packages of training."""
    modules = [*(f"deploy.{name}" for name in ("description", "ground", "policy", "robot", "simulation"))]
    modules += ["utils.cli", "utils.metrics", "viewer.native", "viewer.video"]
    code = "import sys\n" + "".join(f"import legged_torque.{name}\n" for name in modules)
    code += "print([name for name in sys.modules if name.split('.')[0] in ('torch', 'warp', 'mujoco_warp', 'rsl_rl')"
    code += " or name.removeprefix('legged_torque.').split('.')[0] in ('envs', 'checks', 'learning', 'sim')])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=XML.parents[3])
    assert (result.stdout.strip(), result.stderr) == ("[]", "")


def test_physics_is_the_task_s(make_task, policy):
    """From the states of the task, the same actions lead to the same states and forces, on the ground too."""
    converged = {"sim.solver_iterations": 100, "sim.ls_iterations": 50}
    task = make_task("a1_torque_multihead", num_envs=3, **converged)
    task.load_state_dict({"total_steps": torch.tensor(20_000_000), "num_diverged": torch.tensor(0)})
    robots = [MujocoRobot(XML, policy.description) for _ in range(task.num_envs)]
    for i, robot in enumerate(robots):
        q, v = task.sim.qpos[i].numpy(), task.sim.qvel[i].numpy()
        robot.reset(q[:3], q[3:7], q[7:], (v[:3], v[3:6], v[6:]))
    on_ground = 0
    for _ in range(15):
        actions = 0.3 * torch.randn(task.num_envs, 24)
        task.step(actions)
        assert not task.reset_buf.any()
        for i, robot in enumerate(robots):
            for _ in range(4):
                torques = policy.torques(actions[i].numpy(), robot.joint_positions(), robot.joint_velocities())
                robot.step(torques)
            np.testing.assert_allclose(robot.data.qpos, task.sim.qpos[i].numpy(), atol=1e-3)
            force = float(task.sim.contact_force[i].norm(dim=1).sum())
            assert robot.contact_force() == pytest.approx(force, rel=0.02, abs=1.0)
            on_ground += force > 20.0
    assert on_ground > 5


def test_velocity_in_the_frame_of_the_trunk(policy):
    """A robot that is turned to the left by 1 rad and moves that way walks forwards."""
    robot = MujocoRobot(XML, policy.description)
    robot.reset(np.zeros(3), quaternion(0, 0, 1.0), policy.nominal_pose, STILL)
    robot.velocity[:] = [math.cos(1.0), math.sin(1.0), 0.0]
    np.testing.assert_allclose(robot.planar_velocity(), [1.0, 0.0, 0.0], atol=1e-12)


def test_random_numbers(policy):
    """A robot's walk depends on its seed alone, and commands are drawn from their ranges or fixed."""
    robot = MujocoRobot(XML, policy.description)
    simulation = Simulation(policy, robot, push_velocity=1.0, push_probability=0.1)
    runs = [simulation.run(30, seed) for seed in ([1, 0], [1, 1], [1, 0])]
    np.testing.assert_array_equal(runs[0], runs[2])
    assert not np.array_equal(runs[0], runs[1])
    drawn = []
    for seed in range(200):
        simulation.run(0, seed)
        drawn.append(np.concatenate([simulation.command, robot.joint_positions() / policy.nominal_pose]))
    low, high = np.min(drawn, axis=0), np.max(drawn, axis=0)
    assert (low[:3] > -1).all() and (low[:3] < -0.9).all() and (high[:3] < 1).all() and (high[:3] > 0.9).all()
    assert (low[3:] < 0.7).all() and (low[3:] > 0.499).all() and (high[3:] > 1.4).all() and (high[3:] < 1.501).all()
    simulation = Simulation(policy, robot, command=(0.5, 0.0, -0.2))
    simulation.run(3, 1)
    assert simulation.command.tolist() == [0.5, 0.0, -0.2]


def test_what_is_not_simulated(make_task, tmp_path):
    """Commands and ends of episodes that this simulation does not have are named."""
    changes = {"commands.zero_below": 0.2, "terminations.tilt": 1.0, "terminations.contact": False}
    export_random(make_task, "a1_position", tmp_path, **changes)
    policy = Policy(tmp_path)
    simulation = Simulation(policy, MujocoRobot(XML, policy.description))
    assert any("commands.zero_below, terminations.tilt" in note for note in simulation.notes)
    assert policy.description["episode"]["ends_on_contact_of"] == []


@pytest.mark.parametrize(("refresh", "computed"), [(True, 4), (False, 1)])
def test_torques_are_refreshed(policy, monkeypatch, refresh, computed):
    """Torques are computed anew at every physics step, or once per control step, as the description says."""
    calls, own = [], policy.wanted_torques
    monkeypatch.setattr(policy, "wanted_torques", lambda *values: calls.append(values) or own(*values))
    monkeypatch.setitem(policy.description["timing"], "refresh_torques", refresh)
    Simulation(policy, MujocoRobot(XML, policy.description)).run(1, 1)
    assert len(calls) == computed


def test_recorder(policy):
    """A video shows the states and commands of every step."""
    robot = MujocoRobot(XML, policy.description)
    simulation = Simulation(policy, robot, command=(0.5, -0.1, 0.2))
    recorder = video.SimulationRecorder(simulation)
    simulation.run(3, 1, recorder.add_step)
    qpos, command, velocity = recorder.steps[-1]
    assert len(recorder.steps) == 3 and qpos[0].tolist() == robot.data.qpos.tolist()
    assert command[0].tolist() == [0.5, -0.1, 0.2] and velocity[0].tolist() == robot.planar_velocity().tolist()


@pytest.mark.parametrize("factor", [None, 1.5])
def test_pushes(policy, monkeypatch, factor):
    """Half of the pushes add a draw to the trunk's velocity, the others set it to factor x draw (old exports: 1)."""
    pushes = {"pushes": {"set_factor": factor}} if factor else {}
    others = {key: value for key, value in policy.description.items() if key != "pushes"}
    monkeypatch.setattr(policy, "description", others | pushes)
    check(policy.description)
    robot = MujocoRobot(XML, policy.description)
    simulation = Simulation(policy, robot, push_velocity=0.5, push_probability=1.0)
    assert len(simulation.notes) == (factor is None) and all("pushes.set_factor" in note for note in simulation.notes)
    simulation.run(1, 1)
    after = np.empty((1000, 3))
    for velocity in after:
        robot.velocity[:] = 10.0
        simulation._push()
        velocity[:] = robot.velocity
    is_added = after.min(axis=1) > 5.0
    assert 0.45 < is_added.mean() < 0.55
    for draws, largest in ((after[is_added] - 10.0, 0.5), (after[~is_added], 0.5 * (factor or 1.0))):
        assert 0.98 * largest < np.abs(draws).max() <= largest
        assert np.std(draws, axis=0) == pytest.approx(largest / math.sqrt(3.0), rel=0.1), "uniform"


def test_power_of_all_physics_steps(policy, monkeypatch):
    """Work and heat are those of all physics steps of a plain MuJoCo loop with the same torques."""
    copper, applied = np.linspace(0.1, 0.3, 12), []
    by_joint = dict(zip(policy.joint_order, copper.tolist(), strict=True))
    monkeypatch.setitem(policy.description, "copper_loss", by_joint)
    check(policy.description)
    robot = MujocoRobot(XML, policy.description)
    step = robot.step
    monkeypatch.setattr(robot, "step", lambda torques: applied.append(torques.copy()) or step(torques))
    simulation, data = Simulation(policy, robot), mujoco.MjData(robot.model)
    simulation.run(0, 1)
    data.qpos[:], data.qvel[:] = robot.data.qpos, robot.data.qvel
    sums = sum(simulation._control_step() or simulation._finish_step(simulation.command) for _ in range(20))
    work = heat = 0.0
    change = np.abs(np.diff(np.array(applied, float), axis=0)).mean(axis=1).sum() / 0.4  # in 20 control steps
    for torques in applied:
        data.ctrl[:] = torques
        mujoco.mj_step(robot.model, data)
        work += np.abs(torques * data.qvel[6:]).sum() / 4
        heat += copper @ torques**2 / 4
    assert sums[0] == 20 and len(applied) == 80 and work > 1.0
    of = ratios(sums, 1.0, 0.02, simulation.has_losses)
    power, total, rate = of["mechanical_power"][0], of["electrical_power"][0], np.divide(*of["torque_rate"])
    assert (power, total, rate) == pytest.approx((work, work + heat, change), rel=1e-9)


def test_episodes_end(policy):
    """After 20 s, or with the trunk on the ground, an episode starts anew; such steps count only as falls."""
    robot = MujocoRobot(XML, policy.description)
    simulation = Simulation(policy, robot)
    assert simulation._max_steps == 1000
    simulation.run(0, 1)
    robot.reset([0.0, 0.0, 0.03], quaternion(0.1, 0.2, 0.0), policy.nominal_pose, STILL)
    simulation._control_step()
    *others, fell, ended, peak = simulation._finish_step(simulation.command)
    assert (others, fell, ended) == ([0.0] * 11, 1.0, 1.0) and peak > simulation.robot.weight
    assert robot.position[2] == 0.4 and simulation._steps == 0 and (policy.last_action == 0).all()
    simulation._control_step()
    simulation._steps = 1000
    assert simulation._finish_step(simulation.command).tolist()[:13] == [0.0] * 12 + [1.0]
    assert simulation._steps == 0


def test_script(exported, tmp_path, monkeypatch):
    """It prints the metrics and writes them; any of the three paths names the policy; mistakes are one line."""
    words = ["--steps=20", "--robots=2", "--push_velocity=0.5", "--command", "0.5", "0", "-0.2"]
    outputs = []
    for path in (exported, exported / "policy.yaml", exported / "policy.onnx"):
        file = tmp_path / "results" / "result.json"
        status, output, error = run_here("sim2sim.py", str(path), *words, f"--json={file}", root=tmp_path)
        assert (status, error) == (0, "")
        outputs.append(output)
    assert outputs[0] == outputs[1] == outputs[2]
    result = json.loads(file.read_text())
    for name in ("track_percentage", "track_xy", "track_angular", "collision_force", "cost_of_transport"):
        mean, error = (float(number) for number in re.search(rf"{name} +(\S+) \+- (\S+)", output).groups())
        assert result["metrics"][name] == pytest.approx({"mean": mean, "standard_error": error}, abs=1e-4)
    assert (result["robots"], result["command"], result["task"]) == (2, [0.5, 0.0, -0.2], "a1_torque_multihead")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for words, message in {
        "--video=walk.webm": "a video is an mp4 or a gif, by the end of its name, not 'walk.webm'",
        "--push_probability=0.1": "--push_probability needs --push_velocity",
        "--push_velocity=1 --push_probability=2": "--push_probability must be from 0 to 1",
        "--viewer": "MuJoCo's window needs a screen; --video works without one",
        "--xml=nothing.xml": "cannot load the robot 'nothing.xml': there is no such file",
    }.items():
        assert_told_in_one_line(run_here("sim2sim.py", str(exported), *words.split(), root=tmp_path), message)


def test_quaternion():
    """Turns are about fixed axes, first x, then y, then z."""
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation.from_euler("xyz", (0.3, -0.4, 1.2))
    np.testing.assert_allclose(np.roll(quaternion(0.3, -0.4, 1.2), -1), rotation.as_quat(), atol=1e-12)
