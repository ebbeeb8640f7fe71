"""Latency in plain MuJoCo: what an export says of it, and that sim2sim has it."""

import json
from itertools import product

import numpy as np
import pytest
from support.exports import XML, export_random
from support.scripts import run_here
from support.settings import BusCfg, error_of

from legged_torque.deploy.description import read
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.deploy.simulation import Latency, Simulation
from legged_torque.envs import A1TorqueCfgPPO, TorqueRobot, task_registry


def test_constant_delays(make_task, tmp_path):
    """Actions reach the motors 6 physics steps late, and steps of measurements the policy 15 ms, as in training."""
    changes = {"motors.delay.range": [6, 6], "sensing.delay.range": [15, 15], "sensing.delay.unit": "milliseconds"}
    changes |= {"motors.chain": ["delay", "encoder", "ideal"], "motors.encoder.velocity_resolution": 0.25}
    export_random(make_task, "a1_torque", tmp_path / "out", **changes, **{"env.history_length": 2})
    policy = Policy(tmp_path / "out")
    latency = policy.description["latency"]
    assert latency["actions"] == {"range": [6, 6], "unit": "physics_steps", "jitter": 0, "loss": 0.0}
    assert latency["measurements"] == {"range": [15, 15], "unit": "milliseconds", "jitter": 0, "loss": 0.0}
    robot = MujocoRobot(XML, policy.description)
    simulation = Simulation(policy, robot, command=(0.5, 0.0, 0.0))
    seen, torques, speeds = [], [], []
    observe, step, reset = policy.observation, robot.step, robot.reset
    policy.observation = lambda state, command: (seen.append(state.joint_velocities), observe(state, command))[1]
    robot.reset = lambda *start: (reset(*start), speeds.append(robot.joint_velocities()))
    robot.step = lambda applied: (torques.append(applied), step(applied), speeds.append(robot.joint_velocities()))
    sent = []
    act = policy.act
    policy.act = lambda obs: (sent.append(act(obs)), sent[-1])[1]
    simulation.run(10, seed=1)
    assert len(speeds) == 41  # of one episode: at its start, and after each physics step
    for number, velocities in enumerate(seen):
        assert np.array_equal(velocities, 0.25 * np.round(np.float32(speeds[max(4 * number - 3, 0)]) / 0.25))
    scale = np.float32(policy.description["actions"]["terms"][0]["scale"])
    for t, applied in enumerate(torques):
        expected = scale * sent[(t - 6) // 4] if t >= 6 else np.zeros(12)
        np.testing.assert_allclose(applied, expected, rtol=1e-6)


@pytest.mark.parametrize("link", ["delay", "bus"])
def test_delay_of_a_file_of_motors(make_task, tmp_path, monkeypatch, link):
    """sim2sim.py takes it in place of all of the export's, also if it is 0, or has another name."""
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    task_registry.register("a1_bus", TorqueRobot, BusCfg(), A1TorqueCfgPPO())
    for name, delay in (("late", [4, 4]), ("ideal", [0, 0])):
        task = "a1_bus" if link == "bus" else "a1_torque"
        export_random(make_task, task, tmp_path / name, **{f"motors.{link}.range": delay})
        (tmp_path / f"{name}.yaml").write_text(f"motors: {{{link}: {{range: {delay}}}}}")
    measured = {f"motors.{link}.range": [2, 2], "sensing.delay.range": [2, 2]}
    export_random(make_task, task, tmp_path / "measured", **measured)
    (tmp_path / "part.yaml").write_text("motors: {delay: {jitter: 0}}")
    found = {}
    for name, motors in product(("late", "ideal", "measured"), (None, "late.yaml", "ideal.yaml", "part.yaml")):
        words = [name, "--robots=1", "--steps=20", "--json=out.json", *([f"--motors={motors}"] if motors else [])]
        assert run_here("sim2sim.py", *words, root=tmp_path)[0] == 0
        found[name, motors] = json.loads((tmp_path / "out.json").read_text())["metrics"]
    assert found["late", "ideal.yaml"] == found["ideal", "ideal.yaml"] != found["late", None]
    assert found["late", "late.yaml"] == found["ideal", "late.yaml"] == found["late", None]
    assert found["measured", "late.yaml"] == found["late", None] != found["measured", None]
    if link == "delay":
        assert found["late", "part.yaml"] == found["late", None]


def test_a_file_of_motors_changes_what_it_names(make_task, tmp_path):
    """sim2sim.py starts from the motors of the export, not from those of its task as it is registered."""
    changes = {"motors.chain": ["delay", "drive", "ideal", "lag"], "motors.drive.damping": 1.5}
    changes |= {"motors.lag.time_constant": 0.01, "motors.delay.range": [2, 2]}
    export_random(make_task, "a1_torque", tmp_path / "own", **changes)
    (tmp_path / "same.yaml").write_text("motors: {lag: {time_constant: 0.01}}")
    (tmp_path / "slow.yaml").write_text("motors: {lag: {time_constant: 0.05}}")
    (tmp_path / "heavy.yaml").write_text("motors: {joints: {armature: 0.02}}")
    found = []
    for words in ([], ["--motors=same.yaml"], ["--motors=slow.yaml"]):
        words = ["own", "--robots=1", "--steps=20", "--json=out.json", *words]
        assert run_here("sim2sim.py", *words, root=tmp_path)[0] == 0
        found.append(json.loads((tmp_path / "out.json").read_text())["metrics"])
    assert found[0] == found[1] != found[2]
    said = run_here("sim2sim.py", "own", "--robots=1", "--steps=1", "--motors=heavy.yaml", root=tmp_path)[1]
    assert "armature of joints: 0.02 here, 0.01 in the training (all joints)" in said


def test_jitter_and_loss():
    """Shares of lost packets and times are those of the settings; a late packet does not replace a later one."""
    settings = {"range": [1, 3], "unit": "physics_steps", "jitter": 2, "loss": 0.25}
    timing = {"physics_frequency": 200.0, "decimation": 1}
    queue, ages = Latency({"latency": {"actions": settings}, "timing": timing}, "actions"), []
    for episode in range(300):
        queue.restart(np.random.default_rng(episode), -1)
        got = []
        for now in range(20):
            queue.send(now, now)
            got.append(queue.received(now))
        assert (np.diff(got) >= 0).all()
        ages.append(np.arange(20) - got)
    assert np.min(ages) == 1
    # P(age > a) is that of all packets sent up to a steps ago to be lost or under way, mean over the constant times
    for age in range(1, 7):
        on_time = lambda constant, steps: 0.75 * np.clip((steps - constant + 1) / 3, 0, 1)  # noqa: E731
        expected = np.mean([np.prod([1 - on_time(c, s) for s in range(age + 1)]) for c in (1, 2, 3)])
        assert np.mean(np.array(ages)[:, 12:] > age) == pytest.approx(expected, abs=0.04)


def test_bad_latency(make_task, tmp_path):
    """Times that are not whole physics steps are refused by name."""
    export_random(make_task, "a1_torque", tmp_path / "out", **{"sensing.delay.range": [2, 2]})
    description, _ = read(tmp_path / "out")
    for changes, name in [({"range": [7, 7], "unit": "milliseconds"}, "range"), ({"range": [3, 2]}, "range")]:
        latency = {"latency": {"measurements": description["latency"]["measurements"] | changes}}
        assert f"latency.measurements.{name}" in error_of(Latency, description | latency, "measurements")
