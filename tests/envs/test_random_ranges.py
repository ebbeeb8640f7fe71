"""The sets of random ranges and perturbations, and ranges that make no sense."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from support.robot_files import changed as changed  # a fixture
from support.robot_files import setting
from support.settings import error_of, get_cfgs

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfg
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.utils.config import set_by_path, to_dict

ON = {"domain_rand.randomize_parameters": True}


@pytest.mark.parametrize(
    ("name", "velocity", "probability"),
    [("low", 0.3, 0.002), ("high", 1.0, 0.002), ("high_frequency", 1.0, 0.006), ("doubled", 1.0, 0.012)],
)
def test_perturbations(name, velocity, probability):
    """The paper's four environments, in training and over a loaded run; "none" switches all off."""
    plain = to_dict(get_cfgs()[0])
    cfg = get_cfgs(f"--perturbation={name}")[0]
    rand = cfg.domain_rand
    assert rand.randomize_parameters and rand.push_robots and cfg.noise.add_noise
    assert (rand.push_velocity, rand.push_probability) == ([-velocity, velocity], probability)
    assert (rand.init_dof_vel, rand.init_lin_vel, rand.init_ang_vel) == ([-10.5, 10.5], [-0.5, 0.5], [-0.5, 0.5])
    run_config = {"env": to_dict(cfg), "train": {}}
    assert get_cfgs(run_config=run_config)[0].domain_rand.push_probability == probability
    assert get_cfgs("--perturbation=doubled", run_config=run_config)[0].domain_rand.push_probability == 0.012
    without = get_cfgs("--perturbation=none", run_config=run_config)[0]
    assert not (without.domain_rand.randomize_parameters or without.domain_rand.push_robots or without.noise.add_noise)
    assert without.domain_rand.init_dof_vel == plain["domain_rand"]["init_dof_vel"] == [0.0, 0.0]


PUBLISHED = yaml.safe_load(Path(__file__).with_name("published_ranges.yaml").read_text("utf-8"))


@pytest.mark.parametrize(
    ("words", "name", "errors"),
    [
        ([], "default", (0.01, 0.5, 0.1, 0.05)),
        (["--ranges=default"], "default", (0.01, 0.5, 0.1, 0.05)),
        (["--ranges=hard"], "hard", (0.01, 1.5, 0.2, 0.1)),
    ],
)
def test_ranges(words, name, errors):
    """They are the published ones, replace those of a loaded run, and go with any perturbation."""
    old = get_cfgs("--perturbation=high")[0]
    old.domain_rand.foot_radius, old.domain_rand.keep_probability = {"set": [0.0195, 0.0205]}, 0.3
    old.domain_rand.action_scale, old.noise.noise_scales.dof_pos = {"add": [-0.1, 0.1]}, 0.5
    cfgs = [get_cfgs(*words, "--perturbation=low")[0]]
    if words:
        cfgs.append(get_cfgs(*words, run_config={"env": to_dict(old), "train": {}})[0])
    for cfg in cfgs:
        assert {key: getattr(cfg.domain_rand, key) for key in PUBLISHED[name]} == PUBLISHED[name]
        assert cfg.domain_rand.action_scale == {}
        noise = cfg.noise.noise_scales
        assert (noise.dof_pos, noise.dof_vel, noise.ang_vel, noise.gravity) == errors
    assert cfgs[-1].domain_rand.push_velocity == ([-1.0, 1.0] if words else [-0.3, 0.3])


def test_units_of_the_robot(make_task):
    """Ranges of any robot are in units of its radii, armatures, gains and torque limits."""
    names = ("foot_radius", "dof_damping", "dof_armature", "dof_stiffness", "dof_frictionloss")
    without = {f"domain_rand.{name}": getattr(LeggedRobotCfg.domain_rand, name) for name in names}
    cfg = A1Cfg()
    for path, value in {**ON, **without, "env.num_envs": 300}.items():
        set_by_path(cfg, path, value)
    cfg.control.stiffness, cfg.control.damping = {"hip": 10.0, "joint": 30.0}, {"calf": 1.0, "joint": 0.5}
    task = LeggedRobot(cfg)
    model, sim, joints = task.sim.mj_model, task.sim, slice(6, None)
    part, torque = np.array([name.split("_")[1] for name in task.dof_names]), model.actuator_forcerange[:, 1]
    damping, frictionloss = model.dof_damping[joints], model.dof_frictionloss[joints]
    stiffest = 0.01 * np.where(part == "hip", 10.0, 30.0)
    expected = {
        "dof_damping": (damping, damping + 0.4 * np.where(part == "calf", 1.0, 0.5)),
        "dof_armature": (0.8 * model.dof_armature[joints], 2.0 * model.dof_armature[joints]),
        "jnt_stiffness": (0.0 * stiffest, stiffest),
        "dof_frictionloss": (frictionloss, frictionloss + 0.012 * torque),
    }
    for field, (low, high) in expected.items():
        values = sim.field(field).numpy()[:, -12:]
        slack = 0.03 * (high - low) + 1e-6
        assert (np.abs(values.min(axis=0) - low) < slack).all() and (np.abs(values.max(axis=0) - high) < slack).all()
    radii = sim.field("geom_size")[:, model.geom(task.foot_names[0]).id, 0]
    assert 0.019 <= radii.min() < 0.0191 and 0.0209 < radii.max() <= 0.021001
    fixed = {"domain_rand.keep_fixed": ["dof_damping", "foot_radius", "dof_armature"]}
    kept = make_task("a1_position", 2, **{**ON, **without, **fixed, "domain_rand.dof_stiffness": {}}).sim
    for field in ("dof_damping", "geom_size", "dof_armature", "jnt_stiffness"):
        assert (kept.field(field).numpy() == np.float32(getattr(model, field))).all(), field
    assert (kept.field("dof_frictionloss").numpy() != model.dof_frictionloss).any()


@pytest.mark.parametrize(("name", "limits", "note"), PUBLISHED["foreign"])
def test_ranges_of_another_robot(make_task, name, limits, note):
    """A line says which ranges do not fit the robot; those of the A1 fit, also the hard ones."""
    (message,) = make_task("a1_position", 1, **ON, **{f"domain_rand.{name}": limits}).notes
    assert message == f"domain_rand.{note}: is it the range of another robot?"
    hard = get_cfgs("--ranges=hard")[0].parameter_ranges()["hard"]["domain_rand"]
    ranges = {f"domain_rand.{key}": value for key, value in hard.items()}
    assert make_task("a1_position", 1, **ON, **ranges).notes == []


@pytest.mark.parametrize("operation", ["set", "add"])
def test_what_goes_with_another_parameter(make_task, operation):
    """A trunk's inertia stays in proportion to its mass, torque scales to action scales, however those are drawn."""
    masses, scales = {"set": ([4.5, 5.0], [0.2, 0.3]), "add": ([-0.2, 0.3], [-0.05, 0.05])}[operation]
    ranges = {"domain_rand.trunk_mass": {operation: masses}, "domain_rand.action_scale": {operation: scales}}
    task = make_task("a1_multihead", 20, **ON, **ranges)
    model, mass = task.asset.mj_model, task.sim.field("body_mass")[:, 1]
    share = (mass / model.body_mass[1]).numpy()[:, None]
    np.testing.assert_allclose(task.sim.field("body_inertia")[:, 1], share * model.body_inertia[1], rtol=1e-4)
    torch.testing.assert_close(task.torque_scale / task.cfg.control.torque_scale, task.action_scale / 0.25)
    assert mass.std() > 0.05 and task.action_scale.std() > 0.01


@pytest.mark.parametrize("name", ["trunk_mass", "action_scale"])
def test_no_factors_per_joint(make_task, name):
    """Numbers that another one follows have no factors of their own, as it would have others."""
    ranges = {f"domain_rand.{name}": {"scale_per_joint": [0.9, 1.1]}}
    message = f"random parameter '{name}' takes no scale_per_joint"
    assert error_of(make_task, "a1_torque", 1, **ON, **ranges).startswith(message)


def test_hard_ranges_of_a_variant():
    """They replace ranges of another operation that the variant has, as a value can only be set or changed."""

    class Variant(A1Cfg):
        class domain_rand:
            ground_friction = {"scale": [0.8, 1.2]}

    hard = Variant().parameter_ranges()["hard"]["domain_rand"]["ground_friction"]
    assert hard == {"set": [0.001, 2.0]}


@pytest.mark.parametrize(("name", "limits", "message"), PUBLISHED["negative"])
def test_sums_that_make_no_sense(make_task, name, limits, message):
    """A range that can make a parameter negative is refused if it is drawn."""
    make_task("a1_torque", 1, **{f"domain_rand.{name}": limits})
    assert message in error_of(make_task, "a1_torque", 1, **ON, **{f"domain_rand.{name}": limits})


@pytest.mark.parametrize(
    ("settings", "drawn", "kept"),
    [
        ({"keep_fixed": ["contact_damping"]}, "contact_stiffness", "contact_damping"),
        ({"contact_stiffness": {"scale": [0.9, 1.1]}}, "contact_damping", "contact_stiffness"),
    ],
)
def test_formats_of_solref(changed, make_task, settings, drawn, kept):
    """Numbers of the direct format are not drawn beside one of the other format, but by themselves or in pairs."""
    settings = ON | {f"domain_rand.{name}": value for name, value in settings.items()}
    make_task("a1_position", 1, **settings)
    file = {"asset.file": changed(setting(".//geom[@solref]", solref="0.02 1"))}
    line = error_of(make_task, "a1_position", 1, **file, **settings)
    assert f"draws {drawn} in MuJoCo's direct format" in line and f"the robot's own {kept} is of the other one" in line
    make_task("a1_position", 1, **file, **ON)
    scaled = {f"domain_rand.contact_{name}": {"add": [-0.01, 0.01]} for name in ("stiffness", "damping")}
    solref = make_task("a1_position", 50, **file, **ON, **scaled).sim.field("geom_solref")[:, 0]
    assert 0.01 <= solref[:, 0].min() < 0.011 and 0.029 < solref[:, 0].max() <= 0.03


def test_sums(make_task):
    """Numbers that are added make gravity, contacts and all kinds of friction stronger where they are positive."""
    ranges = {"gravity": [0.5, 1.0], "contact_stiffness": [100, 200], "contact_damping": [10, 20]}
    ranges["ground_friction"] = [0.5, 1.0]
    task = make_task("a1_position", 50, **ON, **{f"domain_rand.{key}": {"add": ends} for key, ends in ranges.items()})
    model, sim = task.sim.mj_model, task.sim
    share = (-9.81 - sim.field("gravity")[:, 2].numpy() - 0.5) / 0.5
    assert 0.0 <= share.min() < 0.1 and 0.9 < share.max() <= 1.0
    stiffness, damping = -sim.field("geom_solref")[:, 0].numpy().T
    share = (stiffness - 1100.0) / 100.0
    assert 0.0 <= share.min() < 0.1 and 0.9 < share.max() <= 1.0
    np.testing.assert_allclose(damping, 90.0 + 10.0 * share, rtol=1e-5)
    friction = sim.field("geom_friction")[:, 0].numpy() / model.geom_friction[0]
    assert 1.5 <= friction.min() < 1.6 and 1.9 < friction.max() <= 2.0
    np.testing.assert_allclose(friction, friction[:, :1].repeat(3, axis=1), rtol=1e-5)
