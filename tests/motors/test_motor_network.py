"""A network as motor: torques as of a torch module with histories by hand; runs and exports have its numbers."""

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from support.control import HIGH_UP, NOMINAL, pd_by_hand, time_out
from support.settings import error_of

from legged_torque.envs import task_registry
from legged_torque.envs.base.legged_robot import IN_TORCH
from legged_torque.motors.twin import MotorTwin
from legged_torque.utils.config import to_dict
from legged_torque.utils.options import Options
from legged_torque.utils.plain_yaml import parse_yaml

NETWORKS = yaml.safe_load(Path(__file__).with_name("motors.yaml").read_text("utf-8"))["networks"]
ACTIVATIONS = {
    "softsign": torch.nn.Softsign,
    "tanh": torch.nn.Tanh,
    "relu": torch.nn.ReLU,
    "elu": torch.nn.ELU,
    "softplus": torch.nn.Softplus,
}


def perceptron(sizes, activation="softsign", seed=0):
    """A multilayer perceptron with large weights."""
    torch.manual_seed(seed)
    layers = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [torch.nn.Linear(inputs, outputs), ACTIVATIONS[activation]()]
        torch.nn.init.normal_(layers[-2].weight)
    return torch.nn.Sequential(*layers[:-1])


def write(file, network, activation="softsign"):
    """Write a network as docs/howto/motor.md says; return the setting that names it."""
    linear = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
    layers = [torch.cat([layer.weight, layer.bias[:, None]], dim=1).tolist() for layer in linear]
    file.write_text(json.dumps({"activation": activation, "layers": layers}))
    return {"motors.network.file": str(file)}


CHAIN = {"motors.chain": ["delay", "network", "ideal"], **HIGH_UP}
SCALES = {"position_scale": -1.0, "velocity_scale": {"hip": 0.2, "joint": 0.1}, "torque_scale": 4.0}
BY_JOINT = np.array([0.2, 0.1, 0.1] * 4)


class Histories:
    """What a network sees of an A1's joints, by hand: lists of errors and speeds, newest first."""

    def __init__(self, worlds):
        self.errors, self.speeds = (np.zeros((5, worlds, 12)) for _ in range(2))

    def see(self, error, speed):
        """Add a physics step."""
        self.errors = np.concatenate([-error[None], self.errors[:-1]])
        self.speeds = np.concatenate([BY_JOINT * speed[None], self.speeds[:-1]])

    def inputs(self):
        """Those of this step, two and four before. Shape: (worlds, 12, 6)."""
        return torch.tensor(np.stack([*self.errors[[0, 2, 4]], *self.speeds[[0, 2, 4]]], axis=-1), dtype=torch.float32)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_as_the_module(make_task, tmp_path, activation):
    """It sees the policy's targets, whatever gains a world has, and no earlier episode; numpy has the same torques."""
    network = perceptron([6, 16, 8, 1], activation)
    options = {f"motors.network.{name}": value for name, value in SCALES.items()}
    options |= write(tmp_path / "net.json", network, activation)
    options |= {"motors.network.history": [0, 2, 4], "control.decimation": 1, "domain_rand.randomize_parameters": True}
    fixed = [
        name
        for name in task_registry.get_cfgs("a1_position")[0].random_parameters()
        if name not in ("stiffness", "damping")
    ]
    task = make_task("a1_position", 5, **options, **CHAIN, **{"domain_rand.keep_fixed": fixed})
    assert task.p_gains.std() > 0.1 and any(IN_TORCH in note for note in task.notes)
    names = task.dof_names
    description = {"joint_order": names, "motors": parse_yaml(json.dumps(task.motors.describe()), "policy.yaml")}
    description |= {"timing": {"decimation": 1, "physics_frequency": 200.0}}
    description |= {"nominal_pose": dict(zip(names, NOMINAL, strict=True))}
    description |= {"torque_limits": dict.fromkeys(names, (-33.5, 33.5))}
    description |= {"gains": {"stiffness": dict.fromkeys(names, 20.0), "damping": dict.fromkeys(names, 0.5)}}
    twin, seen, rng = MotorTwin(description), Histories(5), np.random.default_rng(0)
    for step in range(12):
        if step == 7:
            time_out(task, [0, 3])
        q, qd, actions = task.dof_pos.numpy().copy(), task.dof_vel.numpy().copy(), rng.normal(size=(5, 12))
        task.step(torch.tensor(actions, dtype=torch.float32))
        seen.see(NOMINAL + 0.25 * actions - q, qd)
        with torch.no_grad():
            expected = np.clip(4.0 * network(seen.inputs())[..., 0].numpy(), -33.5, 33.5)
        kept = ~task.reset_buf.numpy()
        assert kept.tolist() == [step != 7, True, True, step != 7, True]
        np.testing.assert_allclose(task.torques[kept], expected[kept], rtol=1e-4, atol=2e-4)
        in_numpy = twin.apply(pd_by_hand(actions[0], q[0], qd[0]), q[0], qd[0])
        np.testing.assert_allclose(in_numpy, expected[0], rtol=1e-4, atol=2e-4)
        if step == 7:
            seen.errors[:, ~kept] = seen.speeds[:, ~kept] = 0.0
            twin.reset()
    assert np.abs(expected).max() > 1.0 and np.abs(expected).min() < 30.0


def test_a_run_has_its_network(make_task, tmp_path):
    """A run's settings have the numbers: the file may be gone, and another one that is named takes its place."""
    setting = write(tmp_path / "net.json", perceptron([6, 8, 1]))
    first = make_task("a1_torque", 2, **setting, **CHAIN)
    run = parse_yaml(json.dumps({"env": to_dict(first.cfg), "train": {}}), "config.yaml")
    (tmp_path / "net.json").unlink()
    cfg, _ = task_registry.get_cfgs("a1_torque", Options(device="cpu"), run)
    torch.manual_seed(1)
    again, _ = task_registry.make_env("a1_torque", Options(device="cpu"), cfg)
    for task in (first, again):
        for _ in range(3):
            task.step(torch.full((2, 12), 0.5))
    assert torch.equal(first.torques, again.torques) and first.torques.abs().max() > 0.1
    assert "net.json" in error_of(make_task, "a1_torque", 2, **setting, **CHAIN)
    other = write(tmp_path / "other.json", perceptron([6, 8, 1], seed=1))
    cfg, _ = task_registry.get_cfgs("a1_torque", Options(device="cpu", set=[f"{k}={v}" for k, v in other.items()]), run)
    changed, _ = task_registry.make_env("a1_torque", Options(device="cpu"), cfg)
    assert changed.motors.describe()["network"]["layers"] != first.motors.describe()["network"]["layers"]


def test_torque_task(make_task, tmp_path):
    """What a torque task asks for is what the network gives if it is that of the task's own PD gains."""
    linear = torch.nn.Linear(2, 1)
    linear.weight.data, linear.bias.data = torch.tensor([[20.0, -0.5]]), torch.zeros(1)
    file = write(tmp_path / "net.json", torch.nn.Sequential(linear))
    task = make_task("a1_torque", 2, **file, **CHAIN, **{"motors.network.history": [0]})
    for _ in range(3):
        task.step(torch.full((2, 12), 0.5))
        torch.testing.assert_close(task.torques, torch.full((2, 12), 4.0), rtol=0, atol=1e-4)


@pytest.mark.parametrize(("content", "settings", "words"), NETWORKS)
def test_refused(make_task, tmp_path, content, settings, words):
    """Files that are no networks, and networks of other sizes or clocks, are refused in one line."""
    named = {"motors.network.file": str(tmp_path / "net.json") if content else ""}
    if isinstance(content, list):
        write(tmp_path / "net.json", perceptron(content))
    elif content:
        (tmp_path / "net.json").write_text(content)
    options = named | {f"motors.network.{name}": value for name, value in settings.items()}
    line = error_of(make_task, "a1_position", 2, **options, **CHAIN)
    assert all(word in line for word in words), line


def test_gains_of_the_policy(make_task, tmp_path):
    """Without PD gains there is no target; a policy with a stiffness of its own cannot have such motors."""
    setting = write(tmp_path / "net.json", perceptron([6, 1]))
    stiffness = {"control.stiffness": {"calf": 0.0, "joint": 20.0}}
    assert "control.stiffness" in error_of(make_task, "a1_torque", 2, **setting, **CHAIN, **stiffness)
    assert "network" in error_of(make_task, "a1_variable_stiffness", 2, **setting, **CHAIN)
