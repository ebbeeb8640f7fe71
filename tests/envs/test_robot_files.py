"""Variants of the A1's file: joints and motors are read by name, and unusable files are refused with all problems."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import yaml
from support.robot_files import A1, EVEN_TRUNK, joint, servo, setting, shuffle_motors, turn_left_hips, unitree_order
from support.robot_files import changed as changed  # a fixture
from support.scripts import run_here
from support.settings import error_of

from legged_torque.envs.base.asset import load_asset
from legged_torque.envs.base.held_pose import standing_note
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.sim.model import build_model
from legged_torque.sim.registry import ENGINES, make_engine
from legged_torque.utils.mjcf import read_spec, robot_notes
from legged_torque.viewer.drawing import drawn_model

POSE = A1Cfg.init_state.default_joint_angles


def cfg_of(file):
    """Settings of the A1 with another file."""
    cfg = A1Cfg()
    cfg.asset.file, cfg.env.num_envs = file, 2
    return cfg


def torques_of(file, ctrl):
    """Torques by joint of plain MuJoCo, with the same control of all motors of a file."""
    model = mujoco.MjModel.from_xml_path(file)
    data = mujoco.MjData(model)
    data.ctrl[:] = ctrl
    mujoco.mj_forward(model, data)
    return {name: data.joint(name).qfrc_actuator[0] for name in POSE}


def test_the_same_robot_in_another_order(changed, make_task):
    """Unitree's orders of joints and motors lead to the same torques per joint, rewards and observations as ours."""
    ours = make_task("a1_torque_multihead", 2)
    theirs = make_task("a1_torque_multihead", 2, **{"asset.file": changed(unitree_order)})
    assert theirs.dof_names == list(POSE) and theirs.foot_names == ours.foot_names
    drawn = drawn_model(Path(theirs.cfg.asset.file), None, theirs.dof_names)
    assert [drawn.joint(i).name for i in range(1, 13)] == list(POSE)
    generator = torch.Generator().manual_seed(1)
    for _ in range(12):
        actions = 0.3 * torch.randn(2, 24, generator=generator)
        ours.step(actions)
        theirs.step(actions)
        for name in ("torques", "rew_buf", "contacts"):
            assert torch.equal(getattr(theirs, name), getattr(ours, name)), name
        assert all(torch.equal(group, ours.obs_buf[name]) for name, group in theirs.obs_buf.items())
    assert (ours.torques.abs() > 1.0).any() and ours.contacts.any()


def described(change):
    """The change of a file's tree that an entry of :data:`CHANGES` describes."""

    def apply(root):
        for path, attributes in change.get("set", {}).items():
            setting(path, **attributes)(root)
        for parent in list(root.iter()) if "remove" in change else ():
            gone = root.find(change["remove"])
            parent.remove(gone) if gone is not None and gone in list(parent) else None
        for path, text in change.get("add", {}).items():
            root.find(path).insert(99 if "last" in change else 0, ElementTree.fromstring(text))

    return apply


CHANGES = yaml.safe_load(Path(__file__).with_name("robot_files.yaml").read_text("utf-8"))


@pytest.mark.parametrize("name", CHANGES["limits"])
def test_torque_limits_are_the_tightest(changed, name):
    """They are where plain MuJoCo clips torques, however the file says so; smaller torques reach their joints."""
    file = changed(described(CHANGES["limits"][name]), *[shuffle_motors] * (name == "all"))
    model = load_asset(cfg_of(file)).mj_model
    extremes = [torques_of(file, ctrl) for ctrl in (-1e6, 1e6)]
    for i, name in enumerate(POSE):
        expected = sorted(extreme[name] for extreme in extremes)
        np.testing.assert_allclose(model.actuator_forcerange[i], expected, rtol=1e-6, err_msg=name)
    data = mujoco.MjData(model)
    data.ctrl[:] = wanted = np.linspace(-2.0, 2.0, 12)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose([data.joint(name).qfrc_actuator[0] for name in POSE], wanted)


@pytest.mark.parametrize("engine", ENGINES)
def test_servos_are_refused(changed, make_task, engine):
    """Every engine names the actuators that are no motors and the remedy, in tasks and in simulators of a model."""
    file = changed(servo(3, 4))
    message = error_of(make_task, "a1_torque", 1, **{"asset.file": file, "sim.engine": engine})
    advice = "a servo, whose control is a target: import_robot.py reads it as a motor (FL_hip, FL_thigh)"
    assert f"make a <motor> with a forcerange of what is {advice}" in message
    model = build_model(read_spec(file), [])
    assert "reads it as a motor (FL_hip, FL_thigh)" in error_of(make_engine, engine, model, 1)


@pytest.mark.parametrize("change", CHANGES["refused"].values(), ids=CHANGES["refused"])
def test_refused(changed, change):
    """A file that a task cannot simulate is refused in a line that names the file and the part."""
    file = changed(described(change))
    message = error_of(load_asset, cfg_of(file))
    assert message.startswith(f"'{file}' cannot be simulated: ") and change["told"] in message


def test_all_problems_at_once(changed):
    """A file with several problems is refused once, with a clause for each."""
    beyond, unlimited = joint("FL_calf_joint", range="-2.6 -1.6"), setting("actuator/motor[1]", ctrllimited="false")
    file = changed(servo(11), beyond, unlimited, setting("actuator/motor[1]", forcelimited="false"))
    message = error_of(load_asset, cfg_of(file))
    for part in ("as a motor (RL_calf)", "a forcerange (FR_hip_joint,", "has -1.5 for 'FL_calf_joint'"):
        assert part in message


def test_notes(changed):
    """A robot that no view draws and legs without feet or with two are noted."""
    hidden = [setting(".//default[@class='visual']/geom", group="4")]
    hidden += [
        setting(".//geom[@name='FL_foot']", name="FL_toe"),
        setting(".//geom[@name='RL_calf']", name="RL_foot_2"),
    ]
    notes = load_asset(cfg_of(changed(*hidden))).notes
    assert notes[0].startswith("no view draws the robot: its geoms are in group 3, 4;")
    assert notes[1:] == [
        "the body 'FL_calf' has 0 feet; asset.foot_name chooses FR_foot, RR_foot, RL_foot_2, RL_foot",
        "the body 'RL_calf' has 2 feet; asset.foot_name chooses FR_foot, RR_foot, RL_foot_2, RL_foot",
    ]


def test_nominal_pose_is_held(changed, make_task):
    """The A1 stands; with weak gains it sinks, and a part that ends episodes may not touch the ground."""
    assert standing_note(make_task("a1_torque", 1)) == ""
    weak = standing_note(make_task("a1_torque", 1, **{"control.stiffness": 3.0}))
    assert "does not stand under PD control, after " in weak and "the trunk has sunk from 0.30 to 0.15 m" in weak
    ending = {"asset.terminate_after_contacts_on": ["RL_foot"]}
    assert "'RL_foot' touches the ground" in standing_note(make_task("a1_torque", 1, **ending))
    assert standing_note(make_task("a1_torque", 1, **{"control.stiffness": 0.0})) == "", "it is not held at all"
    drawn = {"domain_rand.randomize_parameters": True, "domain_rand.stiffness": {"set": [3.0, 3.0]}}
    assert standing_note(make_task("a1_torque", 1, **drawn)) == "", "the first world's gains are weak, not the task's"
    assert standing_note(make_task("a1_variable_stiffness", 1, **{"control.stiffness": 3.0})) == "", "a policy's gains"


def test_training_notes_a_robot_that_falls(tmp_path):
    """Training tries the nominal pose first."""
    words = ["--task=a1_torque", "--num_envs=2", "--max_iterations=1", "--device=cpu", "--set", "control.stiffness=3"]
    status, output, _ = run_here("train.py", *words, root=tmp_path)
    assert status == 0 and output.splitlines()[0].startswith("Note: the nominal pose does not stand under PD control")


def test_another_robot_than_in_training(changed, tmp_path):
    """Other axes or masses than in the training are noted; a file in another order is the same robot."""
    assert list(robot_notes(Path(changed(unitree_order, shuffle_motors)), A1)) == []
    other = Path(changed(turn_left_hips, setting("worldbody/body/inertial", mass="5.713")))
    axes, mass = robot_notes(other, A1)
    assert "other axes than the robot of the training: FL_hip_joint, RL_hip_joint are seen and driven wrongly" in axes
    assert mass == "asset.file has 13.453 kg, the robot of the training 12.453 kg"
    assert "which is gone" in next(robot_notes(other, tmp_path / "gone.xml"))


def test_mirror_images_follow_axes(changed, make_task):
    """Where left axes are mirrored ones, angles keep their signs: the mirrored robot moves as a mirror image."""
    pose = {name: -angle if name in ("FL_hip_joint", "RL_hip_joint") else angle for name, angle in POSE.items()}
    task = make_task(
        "a1_torque", 1, **{"asset.file": changed(turn_left_hips, EVEN_TRUNK), "init_state.default_joint_angles": pose}
    )
    assert task.symmetry.problem == ""
    mirroring, model = task.symmetry.joints, mujoco.MjModel.from_xml_path(task.cfg.asset.file)
    moved = []
    rng = np.random.default_rng(3)
    angles, torques = np.array([*pose.values()]) + rng.uniform(-0.2, 0.2, 12), rng.uniform(-5, 5, 12)
    for mirrored in (False, True):
        data = mujoco.MjData(model)
        order, signs = (list(mirroring.order), mirroring.signs) if mirrored else (list(range(12)), np.ones(12))
        data.qpos[:3], data.qpos[7:], data.ctrl[:] = (0, 0, 1), angles[order] * signs, torques[order] * signs
        for _ in range(20):
            mujoco.mj_step(model, data)
        moved.append(np.concatenate([data.qvel[:6], data.geom("FL_foot" if mirrored else "FR_foot").xpos]))
    np.testing.assert_allclose(moved[1], moved[0] * (1, -1, 1, -1, 1, -1, 1, -1, 1), atol=1e-4)
    assert np.abs(moved[0][[1, 3, 5]]).min() > 0.03


def with_turned_calf(degrees):
    """A change that turns the frame of the right front calf about its z axis, and nothing else of the leg."""
    half, whole = np.radians(degrees) / 2, np.radians(degrees)
    turned = setting(".//body[@name='FR_calf']", quat=f"{np.cos(half)} 0 0 {np.sin(half)}")
    return [turned, joint("FR_calf_joint", axis=f"{np.sin(whole)} {np.cos(whole)} 0")]


@pytest.mark.parametrize("degrees", [0, 90, 180])
def test_mirror_images_of_places_of_feet(changed, make_task, degrees):
    """Feet that are moved in frames that are no mirror images are mirror images of each other in plain MuJoCo."""
    file = changed(*with_turned_calf(degrees))
    task = make_task("a1_torque", 1, **{"asset.file": file, "domain_rand.randomize_parameters": True})
    joints, feet = task.symmetry.joints, task.parameter_mirrors["foot_pos"]
    rng, found = np.random.default_rng(3), []
    moved, angles = rng.uniform(-0.05, 0.05, 12), np.array([*POSE.values()]) + rng.uniform(-0.2, 0.2, 12)
    image = angles[list(joints.order)] * joints.signs, moved[list(feet.order)] * feet.signs
    for pose, move in ((angles, moved), image):
        model = mujoco.MjModel.from_xml_path(file)
        geoms = [model.geom(name).id for name in task.foot_names]
        model.geom_pos[geoms] += move.reshape(4, 3)
        data = mujoco.MjData(model)
        data.qpos[7:] = pose
        mujoco.mj_kinematics(model, data)
        found.append(data.geom_xpos[geoms])
    np.testing.assert_allclose(found[1][[1, 0, 3, 2]], found[0] * (1, -1, 1), atol=1e-9)


def test_feet_between_axes(changed, make_task):
    """In frames that differ by less than a quarter turn, feet that are moved have no mirror image."""
    task = make_task("a1_torque", 1, **{"asset.file": changed(*with_turned_calf(30))})
    assert task.mirror
    settings = {"asset.file": task.cfg.asset.file, "domain_rand.randomize_parameters": True}
    assert "random parameter 'foot_pos' is not known" in error_of(lambda: make_task("a1_torque", 1, **settings).mirror)


UNLIKE = {
    "ranges of FR_thigh_joint and FL_thigh_joint": joint("FL_thigh_joint", range="-1.0472 3.0"),
    "torque limits of RR_calf_joint and RL_calf_joint": setting(".//motor[@name='RL_calf']", forcerange="-20 20"),
    "damping of FR_hip_joint and FL_hip_joint": joint("FR_hip_joint", damping="0.5"),
    "dry friction of FR_hip_joint and FL_hip_joint": joint("FR_hip_joint", frictionloss="5"),
    "springs of FR_hip_joint and FL_hip_joint": joint("FR_hip_joint", stiffness="9"),
    "inertias of FR_thigh_joint and FL_thigh_joint": setting(".//body[@name='FL_calf']/inertial", mass="0.452"),
    "inertias of RR_thigh_joint and RL_thigh_joint": setting(".//body[@name='RL_thigh']/inertial", pos="0.1 0 -0.03"),
}


@pytest.mark.parametrize("parts", UNLIKE)
def test_sides_that_move_otherwise(changed, make_task, parts):
    """Where motors, friction, masses or their places of one leg are others, there is no mirror image either."""
    task = make_task("a1_torque", 1, **{"asset.file": changed(UNLIKE[parts])})
    assert error_of(lambda: task.mirror).startswith(f"the {parts}: these are not mirror images of each other")


def test_unlike_sides_are_no_mirror_images(changed, make_task):
    """A leg at another place, or with another axis, has no mirror image."""
    task = make_task("a1_torque", 1, **{"asset.file": changed(setting(".//body[@name='FL_calf']", pos="0 0 -0.25"))})
    assert "away from the mirror image of its counterpart" in error_of(lambda: task.mirror)
    task = make_task("a1_torque", 1, **{"asset.file": changed(joint("FL_hip_joint", axis="1 0 0.3"))})
    assert "the axes of 'FR_hip_joint' and 'FL_hip_joint' are not mirror images" in error_of(lambda: task.mirror)


@pytest.mark.parametrize("engine", ENGINES)
def test_joints_without_range(changed, make_task, engine):
    """They have no limits for rewards and initial angles, although their field holds the range 0 to 0."""
    free = joint("FL_hip_joint", limited="false")
    task = make_task("a1_torque", 2, **{"asset.file": changed(free), "sim.engine": engine})
    assert task.dof_pos_limits[3].tolist() == [-np.inf, np.inf] and task.dof_pos_limits[0].isfinite().all()
    assert (task.dof_pos[:, 3] > 0.04).all() and task.rew_buf.isfinite().all()
