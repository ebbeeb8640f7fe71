"""Export: a robot computes from the files what the task computes, and files that do not fit are refused."""

import dataclasses
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from rsl_rl.models import MLPModel
from support.control import REAL_MOTORS
from support.exports import TRAINING, export_random
from support.scripts import SMALL, assert_told_in_one_line, run_here
from support.settings import TASKS, error_of, torques_in_torch

from legged_torque.deploy.description import check
from legged_torque.deploy.export import export_note, export_policy, nominal_cfg
from legged_torque.deploy.policy import ACTIONS, OBSERVATIONS, Policy, State
from legged_torque.envs import ObservationTerm, task_registry
from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.tasks import A1TorqueCfg
from legged_torque.motors.config import MotorCfg
from legged_torque.motors.motor import Motor
from legged_torque.motors.twin import MotorTwin

CHANGED = yaml.safe_load(Path(__file__).with_name("export.yaml").read_text("utf-8"))["changed"]
"""Settings that all differ from what they are by default."""
ONCE = {"control.refresh_torques": False}
SETTINGS = {
    "default": {},
    "changed": CHANGED,
    "torques_once": ONCE,
    "motors": REAL_MOTORS,
    "motors_once": REAL_MOTORS | ONCE,
    "motors_network": {"motors.chain": ["network", "ideal"], "motors.network.history": [0, 2]}
    | {"motors.network.layers": np.random.default_rng(0).normal(size=(1, 1, 5)).tolist()},
}


def scramble(task, generator):
    """Put a task's robots into random states, in place of its physics."""
    qpos = torch.randn(task.sim.qpos.shape, generator=generator)
    qpos[:, 3:7] /= qpos[:, 3:7].norm(dim=1, keepdim=True)
    task.sim.qpos.copy_(qpos)
    task.sim.qvel.copy_(4.0 * torch.randn(task.sim.qvel.shape, generator=generator))


def measured(task, world):
    """What the robot of a world would measure; the policy computes the direction of gravity itself."""
    parts = (task.base_ang_vel, task.dof_pos, task.dof_vel)
    return State(*(part[world].numpy().copy() for part in parts), quaternion=task.base_quat[world].numpy().copy())


def read_yaml(folder):
    """The contents of an export's policy.yaml."""
    return yaml.safe_load((folder / "policy.yaml").read_text())


TWO_RATES = "a1_multihead_two_rates"
PARITY = [(name, "changed") for name in [*TASKS, TWO_RATES]] + [(TWO_RATES, "default")]
MORE_PARITY = [("a1_torque_multihead", settings) for settings in SETTINGS if settings != "changed"]


@pytest.mark.parametrize(("name", "settings"), [*PARITY, *MORE_PARITY])
def test_parity(make_task, tmp_path, name, settings):
    """Observations, actions and torques are the task's to 1e-5, over several steps of random states and commands."""
    overrides = SETTINGS[settings] | {"commands.resampling_probability": 1.0}
    task, model = export_random(make_task, name, tmp_path / "out", settings == "changed", **overrides)
    policies = [Policy(tmp_path / "out") for _ in range(task.num_envs)]
    motors = [MotorTwin(policy.description) for policy in policies]
    generator = torch.Generator().manual_seed(8)
    physics_steps = []  # of the current control step: positions, velocities and torques of all joints

    def random_physics(sense=True):
        physics_steps.append([part.clone().numpy() for part in (task.dof_pos, task.dof_vel, task.sim.ctrl)])
        scramble(task, generator)

    torques_in_torch(task)
    task.sim.step = random_physics
    close = {"rtol": 1e-5, "atol": 1e-5}
    largest = 0.0
    for step in range(8):
        if step in (0, 5):
            obs = task.reset()
            for one in (*policies, *motors):
                one.reset()
        ours = [p.observation(measured(task, i), task.commands[i].numpy()) for i, p in enumerate(policies)]
        np.testing.assert_allclose(ours, obs["policy"].numpy(), **close)
        largest = max(largest, float(obs["policy"].abs().max()))
        physics_steps.clear()
        with torch.inference_mode():
            obs = task.step(model(obs))[0]
        actions = [p.act(o) for p, o in zip(policies, ours, strict=True)]
        np.testing.assert_allclose(actions, task.actions.numpy(), **close)
        assert len(physics_steps) == task.cfg.control.decimation
        for twin in motors:
            twin.begin()
        for q, qd, torques in physics_steps:
            start = physics_steps[0][:2] if settings.endswith("once") else (q, qd)
            wanted = [p.wanted_torques(*parts) for p, *parts in zip(policies, actions, *start, strict=True)]
            ours = [twin.apply(*parts) for twin, *parts in zip(motors, wanted, q, qd, strict=True)]
            if settings.startswith("motors"):
                np.testing.assert_allclose(ours, torques, atol=1e-3)  # derating multiplies rounding errors
            else:
                np.testing.assert_allclose(ours, torques, **close)
    if settings == "changed":
        assert largest == 1.5 and np.abs(actions).max() == pytest.approx(0.2)  # both were clipped
        assert obs["policy"].shape[1] == 3 * (33 + task.num_actions + (name == TWO_RATES))  # and its phase


def test_description(exported, description):
    """The files are complete, the numbers those of the A1, and the schema accepts them."""
    assert sorted(path.name for path in exported.iterdir()) == ["policy.onnx", "policy.pt", "policy.yaml"]
    assert list(exported.parent.iterdir()) == [exported]
    check(description)
    assert description["joint_order"][:3] == ["FR_hip_joint", "FR_thigh_joint", "FR_calf_joint"]
    assert description["nominal_pose"]["RL_thigh_joint"] == 1.0
    assert description["gains"]["stiffness"]["FL_calf_joint"] == 20.0
    assert description["torque_limits"]["FL_calf_joint"] == [-33.5, 33.5]
    assert [term["size"] for term in description["observations"]["terms"]] == [3, 3, 3, 12, 12, 24]
    timing = {"control_frequency": 50.0, "physics_frequency": 200.0, "decimation": 4, "refresh_torques": True}
    assert description["timing"] == timing
    assert description["training"] == TRAINING
    assert description["unsupported"] == [] and description["pushes"] == {"set_factor": 1.1}
    text = (exported / "policy.yaml").read_text()
    assert "&id" not in text and max(map(len, text.splitlines())) <= 120


def test_actions_that_are_not_finite(exported):
    """They are refused instead of sent, like arrays of a wrong size."""
    policy = Policy(exported)
    assert "actions are not finite" in error_of(policy.act, np.full(57, np.nan))
    state = State(np.zeros(3), np.zeros(12), np.zeros(12), projected_gravity=np.array([0.0, 0.0, -1.0]))
    with pytest.raises(ValueError, match="56 observations, not 57"):
        policy.observation(state, np.zeros(2))
    with pytest.raises(ValueError, match=r"12 joints, the array has shape \(11,\)"):
        policy.torques(np.zeros(24), np.zeros(11), np.zeros(12))
    with pytest.raises(ValueError, match="projected_gravity or quaternion"):
        policy.observation(State(np.zeros(3), np.zeros(12), np.zeros(12)), np.zeros(3))


def test_torques_of_a_user(make_task, tmp_path, monkeypatch):
    """The network of a task with torques of its own is exported, and policy.yaml says what differs."""
    onnxruntime, robot = pytest.importorskip("onnxruntime"), task_registry.get_task_class("a1_position")
    own_torques = robot._compute_torques
    monkeypatch.setattr(robot, "_compute_torques", lambda task, actions: 1.1 * own_torques(task, actions))
    _, model = export_random(make_task, "a1_position", tmp_path / "out", supported=False)
    (problem,) = read_yaml(tmp_path / "out")["unsupported"]
    assert re.fullmatch(r"the torques of LeggedRobot differ by \S+ from those of the terms in policy.yaml", problem)
    assert f"can only be run by its task: {problem}" in error_of(Policy, tmp_path / "out")
    obs = torch.randn(3, 45, generator=torch.Generator().manual_seed(1))
    (actions,) = onnxruntime.InferenceSession(tmp_path / "out" / "policy.onnx").run(None, {"obs": obs.numpy()})
    with torch.inference_mode():
        np.testing.assert_allclose(actions, model.as_jit()(obs).numpy(), atol=1e-5)


def test_action_term_of_a_user(make_task, tmp_path, monkeypatch):
    """Without a numpy function, a term is named in policy.yaml and the file is not run; with one, it is supported."""
    robot = task_registry.get_task_class("a1_position")
    own_terms = robot.action_terms
    monkeypatch.setattr(robot, "action_terms", lambda task: [dataclasses.replace(own_terms(task)[0], name="impedance")])
    export_random(make_task, "a1_position", tmp_path / "out", supported=False)
    (problem,) = read_yaml(tmp_path / "out")["unsupported"]
    assert problem.startswith("no numpy function for the action term 'impedance'; there are ")
    assert problem in error_of(Policy, tmp_path / "out")
    assert_told_in_one_line(run_here("sim2sim.py", str(tmp_path / "out"), root=tmp_path), problem)
    monkeypatch.setitem(ACTIONS, "impedance", ACTIONS["position_residual"])
    export_random(make_task, "a1_position", tmp_path / "out")
    assert Policy(tmp_path / "out").act(np.zeros(45)).shape == (12,)
    monkeypatch.undo()
    assert error_of(Policy, tmp_path / "out") == f"'{tmp_path / 'out'}': {problem}"


RAYS = {"name": "rays", "scale": 0.5, "unit": "m", "frame": "trunk", "meaning": "three rays", "group": "rays"}


def test_groups_of_the_actor(make_task, tmp_path, monkeypatch):
    """An actor that also reads a group of its own: its term comes last and has no history, in the file and in numpy."""
    robot, groups = task_registry.get_task_class("a1_position"), ["policy", "rays"]
    own_terms, changes = robot.observation_terms, {"env.history_length": 2, "commands.resampling_probability": 1.0}

    def terms_with_rays(task):
        return [*own_terms(task), ObservationTerm(value=lambda: task.dof_pos[:, :3] + 0.2, mirror=None, **RAYS)]

    monkeypatch.setattr(robot, "observation_terms", terms_with_rays)
    for offset, is_right in ((0.1, False), (0.2, True)):
        rays = lambda policy, state, command, offset=offset: state.joint_positions[:3] + offset  # noqa: E731
        monkeypatch.setitem(OBSERVATIONS, "rays", rays)
        export_random(make_task, "a1_position", tmp_path / "out", True, is_right, groups, **changes)
        if not is_right:
            assert "observations of LeggedRobot differ by 0.05" in read_yaml(tmp_path / "out")["unsupported"][0]
    description = read_yaml(tmp_path / "out")
    assert description["network"]["num_observations"] == 2 * 45 + 3
    assert description["observations"]["terms"][-1] == RAYS | {"size": 3, "clip": [-100.0, 100.0]}


class FeelingRobot(TorqueRobot):
    """The policy feels the torques of its motors, and where its feet are."""

    def observation_terms(self):
        """Two more, of which one is a group of its own."""
        felt = ObservationTerm("felt", lambda: self.torques, None, 0.1, unit="N m", meaning="of the motors")
        return [*super().observation_terms(), felt, ObservationTerm("feet", self.feet, None, group="feet")]

    def feet(self):
        """Heights of the feet [m]."""
        return self.foot_pos[:, :, 2]


def test_observations_of_a_user(make_task, tmp_path, monkeypatch):
    """A policy that reads them is exported; whoever runs it supplies their values, and nothing else runs it."""
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    task_registry.register("a1_feeling", FeelingRobot, A1TorqueCfg(), task_registry.get_cfgs("a1_torque")[1])
    out, groups = tmp_path / "out", ["policy", "feet"]
    changes = {"env.history_length": 2, "noise.add_noise": False}
    task, model = export_random(make_task, "a1_feeling", out, groups=groups, **changes)
    terms = {term["name"]: term for term in read_yaml(out)["observations"]["terms"]}
    assert [name for name, term in terms.items() if "supplied" in term] == ["felt", "feet"]
    assert terms["felt"] | {"scale": 0.1, "unit": "N m", "meaning": "of the motors", "size": 12} == terms["felt"]
    policy, obs = Policy(out), task.reset()
    for _ in range(3):
        state = measured(task, 1)
        with pytest.raises(ValueError, match="felt, feet"):
            policy.observation(state, np.zeros(3))
        state.terms = {"felt": task.torques[1].numpy(), "feet": task.foot_pos[1, :, 2].numpy()}
        seen = policy.observation(state, task.commands[1].numpy())
        np.testing.assert_allclose(seen, torch.cat([obs[group] for group in groups], dim=1)[1], rtol=1e-5, atol=1e-5)
        policy.act(seen)
        with torch.inference_mode():
            obs = task.step(model(obs))[0]
    assert_told_in_one_line(run_here("sim2sim.py", str(out), root=tmp_path), "plain MuJoCo has no values of felt, feet")
    note = export_note(task, model)
    assert "felt" in note and "feet" in note and "\n" not in note
    assert "camera" in export_note(task, SimpleNamespace(is_recurrent=False, obs_groups_2d=["camera"]))
    assert not export_note(*export_random(make_task, "a1_torque", tmp_path / "plain"))


TASK = """
import legged_torque.deploy.policy
from legged_torque.envs import A1TorqueCfg, A1TorqueCfgPPO, ObservationTerm, TorqueRobot, task_registry

class LeanRobot(TorqueRobot):
    def observation_terms(self):
        return [*super().observation_terms(), ObservationTerm("lean", self.lean, None, group="lean")]

    def lean(self):
        return self.projected_gravity[:, :2]

task_registry.register("a1_lean", LeanRobot, A1TorqueCfg(), A1TorqueCfgPPO())
legged_torque.deploy.policy.OBSERVATIONS["lean"] = lambda policy, state, command: state.gravity()[:2]
"""


def test_groups_in_the_scripts(tmp_path, monkeypatch):
    """A group of a task file is trained, exported and run in plain MuJoCo; what cannot be exported is named."""
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setitem(OBSERVATIONS, "lean", None)  # undone after the test
    (tmp_path / "lean_robot.py").write_text(TASK)
    words = ["--task_file=lean_robot.py", "--task=a1_lean", "--device=cpu"]
    words += ["--set=runner.num_steps_per_env=4", "--set=algorithm.symmetry_cfg.use_data_augmentation=false"]
    results = []
    for groups in ("[policy,lean]", "[lean]"):
        actor = f"--set=obs_groups.actor={groups}"
        status, said, _ = run_here("train.py", *words, actor, "--max_iterations=1", "--logger=none", root=tmp_path)
        assert status == 0 and ("Note: exports of this policy" in said) == (groups == "[lean]")
        results.append(run_here("export.py", *words[:3], f"--out={groups}", root=tmp_path))
    assert results[0][1].endswith("'[policy,lean]' --task_file=lean_robot.py\n")
    assert_told_in_one_line(results[1], "must be 'policy', then groups of single terms (lean), not lean")
    simulation = ["sim2sim.py", "[policy,lean]", "--robots=1", "--steps=3"]
    assert run_here(*simulation, words[0], root=tmp_path)[0] == 0
    del OBSERVATIONS["lean"]
    assert_told_in_one_line(run_here(*simulation, root=tmp_path), "plain MuJoCo has no values of lean, for which")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"obs_groups": ["critic"]}, "must be 'policy', then groups of single terms (here none), not critic"),
        ({"obs_groups_2d": ["camera", "depth"]}, "policies that see images cannot be exported: camera, depth"),
    ],
)
def test_networks_that_are_not_exported(make_task, tmp_path, change, message):
    """What a robot cannot feed a network is refused by name before anything is written."""
    model = SimpleNamespace(**{"is_recurrent": False, "obs_groups": ["policy"], **change})
    line = error_of(export_policy, make_task("a1_position", 3), model, tmp_path / "out", "a1_position", TRAINING)
    assert message in line and not list(tmp_path.iterdir())
    assert "no is_recurrent" in export_note(make_task("a1_position", 3), SimpleNamespace(obs_groups=["policy"]))


class Half(MLPModel):
    """An actor with half of the output, which rsl_rl's exports do not know."""

    def forward(self, obs, *args, **kwargs):
        """Half of the mean actions."""
        return 0.5 * super().forward(obs, *args, **kwargs)


def test_networks_that_are_exported_as_others(make_task, tmp_path):
    """A class whose exports compute something else than it does is refused, and nothing is written."""
    task, distribution = make_task("a1_position", 4), {"class_name": "GaussianDistribution"}
    model = Half(task.get_observations(), {"actor": ["policy"]}, "actor", 12, [8], "elu", False, distribution)
    line = error_of(export_policy, task, model, tmp_path / "out", "a1_position", TRAINING)
    assert "the exported network differs from the checkpoint's by" in line and not list(tmp_path.iterdir())


def test_motors_of_a_user(tmp_path):
    """A motor of a user's is described in policy.yaml, which is not run without a numpy function for it."""

    class HalfMotor(Motor):
        def apply(self, wanted, pos, vel, substep):
            return 0.5 * wanted

        def describe(self):
            return {"share": 0.5}

    class HalfCfg(MotorCfg):
        def build(self, joints):
            return HalfMotor(self, joints)

    class OwnMotorsCfg(A1TorqueCfg):
        class motors:
            chain = ["ideal", "half"]
            half = HalfCfg

    cfg = OwnMotorsCfg()
    cfg.env.num_envs = 3
    export_random(lambda *args, **kwargs: TorqueRobot(cfg), "a1_torque", tmp_path / "out", supported=False)
    description = read_yaml(tmp_path / "out")
    assert description["motors"]["half"] == {"share": 0.5}
    assert description["unsupported"] == ["no numpy function for the motor 'half'"]
    assert "no numpy function for the motor 'half'" in error_of(Policy, tmp_path / "out")


def test_replaces_an_export(make_task, exported, tmp_path):
    """An export into a folder with an earlier one replaces it and leaves other files alone."""
    folder = shutil.copytree(exported, tmp_path / "out")
    (folder / "notes.txt").write_text("mine")
    export_random(make_task, "a1_torque", folder)
    assert Policy(folder).description["task"] == "a1_torque"
    assert (folder / "notes.txt").read_text() == "mine" and list(tmp_path.iterdir()) == [folder]


def test_nominal_settings():
    """A run with randomization is exported with the gains and scales of its settings."""
    cfg, _ = task_registry.get_cfgs("a1_position")
    cfg.domain_rand.randomize_parameters = cfg.domain_rand.push_robots = cfg.noise.add_noise = True
    cfg.motors.chain = ["delay", "perturbation", "ideal"]
    cfg = nominal_cfg(cfg)
    assert cfg.motors.chain == ["delay", "ideal"]
    assert not (cfg.domain_rand.randomize_parameters or cfg.domain_rand.push_robots or cfg.noise.add_noise)


def test_one_command(make_task, tmp_path):
    """A policy that was trained for one command says so: a robot can be steered no further, and to no heading."""
    settings = {"commands.fixed": [0.5, 0.0, -0.1], "commands.heading_command": True}
    export_random(make_task, "a1_torque", tmp_path / "out", **settings)
    commands = Policy(tmp_path / "out").description["commands"]
    expected = {"lin_vel_x": [0.5, 0.5], "lin_vel_y": [0.0, 0.0], "ang_vel_yaw": [-0.1, -0.1]}
    assert commands.pop("resampling_probability") == 0.002 and commands == expected


@pytest.mark.parametrize("package", ["onnx", "jsonschema"])
def test_missing_extras(make_task, exported, tmp_path, monkeypatch, package):
    """A package that is not installed is named with its extra, on export and when the policy is run."""
    task = make_task("a1_torque", num_envs=3)
    monkeypatch.setitem(sys.modules, package, None)
    message = f"{package} is not installed; this needs the extra: pip install 'legged_torque[export]'"
    assert error_of(export_policy, task, None, tmp_path / "out", "a1_torque", TRAINING) == message
    assert not list(tmp_path.iterdir())
    if package != "onnx":
        assert error_of(Policy, exported) == message


def test_script(tmp_path):
    """export.py writes into the run's folder; a checkpoint that does not fit is refused and nothing is written."""
    assert run_here("train.py", *SMALL, root=tmp_path)[0] == 0
    (run,) = (tmp_path / "logs" / "a1_position").iterdir()
    words = ["--task=a1_position", "--device=cpu"]
    result = run_here("export.py", *words, "--set=env.history_length=2", root=tmp_path)
    assert_told_in_one_line(result, "does not fit this task")
    assert_told_in_one_line(run_here("export.py", *words, "--checkpoint=9", root=tmp_path), "unknown checkpoint '9'")
    assert not list(run.glob("exported*"))
    status, output, error = run_here("export.py", *words, root=tmp_path)
    assert (status, error) == (0, "")
    assert f"exported to logs/a1_position/{run.name}/exported_2" in output
    assert f"scripts/sim2sim.py logs/a1_position/{run.name}/exported_2\n" in output
    policy = Policy(run / "exported_2")
    training = {"run": run.name, "checkpoint": "model_2.pt", "iterations": 2, "total_steps": 16}
    assert policy.description["training"] == training
