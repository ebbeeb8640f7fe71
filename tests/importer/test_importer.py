"""Robots from published URDF and MJCF files, up to a robot that stands and trains."""

import runpy
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import yaml
from support.robot_files import as_menagerie, as_mjcf, urdf

from legged_torque import RESOURCES_DIR
from legged_torque.envs import task_registry
from legged_torque.envs.base.asset import load_asset
from legged_torque.envs.base.held_pose import standing_note
from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.envs.base.legged_robot_config import LeggedRobotCfgPPO
from legged_torque.importer.mjcf import mjcf
from legged_torque.importer.robot import import_robot
from legged_torque.importer.settings import settings
from legged_torque.motors.config import by_joint
from legged_torque.sim.fused.tree import read_tree
from legged_torque.sim.model import indices_matching
from legged_torque.utils.errors import UserError
from legged_torque.utils.standing import hold_pose

FILES = yaml.safe_load(Path(__file__).with_name("files.yaml").read_text("utf-8"))
MOTOR = '<motor joint="FL_calf" ctrlrange="-3 3" gear="6" ctrllimited="true"/>'


def text_of(entry):
    """The text of an entry of :data:`FILES`."""
    if "text" in entry:
        return entry["text"]
    text = {"urdf": urdf, "mjcf": lambda: as_mjcf(entry.get("more", ""))}[entry["source"]]()
    for words in entry.get("replace", ()):
        text = text.replace(*words)
    return text


@pytest.fixture
def written(tmp_path):
    """Import a text and write both files; returns the robot, its model and its settings."""

    def write(source, suffix):
        file = tmp_path / f"source.{suffix}"
        file.write_text(source)
        robot = import_robot(file, "dog")
        model_file = tmp_path / "dog.xml"
        text, model = mjcf(robot)
        model_file.write_text(text)
        (tmp_path / "dog.py").write_text(settings(robot, str(model_file)))
        return robot, model, runpy.run_path(str(tmp_path / "dog.py"))["DogCfg"]()

    return write


def check(model, cfg):
    """The settings fit the model, the fused step takes it, and it stands under the gains of the settings."""
    asset = load_asset(cfg)
    assert len(asset.feet) == 4
    read_tree(model)
    gains = [by_joint("gains", values, asset.dof_names) for values in (cfg.control.stiffness, cfg.control.damping)]
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    result = hold_pose(data, *np.array(gains), model.actuator_ctrlrange.T, 3.0)
    assert not result.fall, str(result)
    assert result.height == pytest.approx(cfg.rewards.base_height_target, rel=0.25)


def test_urdf(written):
    """Fixed links, cylinders, a missing mesh and transmissions go through; masses, limits and places stay."""
    robot, model, cfg = written(urdf(), "urdf")
    assert model.body_mass.sum() == pytest.approx(6.001 + 4 * (0.5 + 0.8 + 0.2 + 0.05), abs=1e-5)
    assert robot.joints == [f"{leg}_{part}" for leg in ("LF", "RF", "LH", "RH") for part in ("HAA", "HFE", "KFE")]
    assert model.jnt_range[1:4].tolist() == [[-0.8, 0.8], [-1.0, 3.0], [-2.6, -0.5]]
    assert (model.actuator_forcerange == [-20, 20]).all()
    assert cfg.asset.max_dof_vel == 15.0
    torque = model.body_mass.sum() * cfg.rewards.base_height_target / (12.453 * 0.303)  # as many times that of an A1
    assert cfg.rewards.scales.torques * torque**2 == pytest.approx(-2e-4, rel=0.03)
    largest = robot.stance.load * 0.28 / cfg.rewards.base_height_target  # less for larger robots, which learn with less
    assert cfg.control.torque_scale == pytest.approx(1.1 * largest, rel=0.03)
    assert cfg.asset.mirrored_legs == [["RF", "LF"], ["RH", "LH"]]
    foot = model.geom("RH_foot")
    assert foot.size[0] == 0.025
    np.testing.assert_allclose(foot.pos, [0, 0, -0.2], atol=1e-9)
    assert any("base" in note and "missing" in note for note in robot.source.notes)
    check(model, cfg)


def test_menagerie(written):
    """Its conventions go through: limits are those of forces, geoms keep their places, the pose is the keyframe."""
    robot, model, cfg = written(as_menagerie(), "xml")
    assert model.body_mass.sum() == pytest.approx(5 + 4 * 1.8)
    assert robot.joints == [
        f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")
    ]
    assert model.actuator_forcerange[:, 1].tolist() == [24, 24, 36] * 4
    assert model.actuator_trnid[:, 0].tolist() == list(range(1, 13))
    assert model.geom("RL_foot").size[0] == 0.022 and model.geom("FL_hip").type == mujoco.mjtGeom.mjGEOM_SPHERE
    assert cfg.init_state.default_joint_angles["RR_calf_joint"] == -1.8
    assert cfg.asset.mirrored_legs == [["FR", "FL"], ["RR", "RL"]]
    assert any("joint damping up to 1 " in note for note in robot.source.notes)
    assert any("12 position or velocity servos" in note for note in robot.source.notes)
    check(model, cfg)


@pytest.mark.parametrize(("left", "right", "fits"), [(0.1, -0.1, True), (0.1, 0.1, False), (0.0, -0.1, False)])
def test_a_keyframe_of_two_sides(written, left, right, fits):
    """Hips that both lean to the left, or one alone, are no mirror images: such a robot trains without."""
    source = as_menagerie().replace("1 0 0 0 0 0.9 -1.8 0", f"1 0 0 0 {left} 0.9 -1.8 {right}")
    robot, _, _ = written(source, "xml")
    assert robot.stance.angles[[0, 3]].tolist() == [left, right]
    notes = [note for note in robot.source.notes if "without mirror images" in note]
    assert robot.symmetric == fits and ("use_data_augmentation" in settings(robot)) == fits
    assert [f"pose has {left:g} for 'FL_hip_joint' and {right:g} for 'FR_hip_joint'" in note for note in notes] == (
        [] if fits else [True]
    )


SIDES = {
    "torque limits of LF_KFE and RF_KFE": ('effort="20" velocity="15" lower="-2.6"', 'effort="10" lower="-2.6"'),
    "ranges of LF_HFE and RF_HFE": ('lower="-1.0" upper="3.0"', 'lower="-1.0" upper="1.5"'),
    "inertias of LF_HFE and RF_HFE": ('<mass value="0.2"/>', '<mass value="2"/>'),
}


@pytest.mark.parametrize("parts", SIDES)
def test_unlike_sides(written, parts):
    """A leg that is weaker, bends less far or weighs more than its counterpart is noted, and trains without images."""
    robot, _, _ = written(urdf().replace(*SIDES[parts], 1), "urdf")
    (note,) = (note for note in robot.source.notes if "without mirror images" in note)
    assert parts in note and not robot.symmetric


def test_a_link_without_a_mass(written):
    """A link that moves and has none in the file is named: its counterparts weigh more."""
    robot, model, _ = written(urdf().replace('<mass value="0.2"/>', '<mass value="0"/>', 1), "urdf")
    assert "without a mass in the file: they weigh what is fixed to them: LF_shank" in robot.source.notes
    assert model.body("LF_shank").mass[0] == pytest.approx(0.05)  # its foot's


def test_training(written):
    """An imported robot trains three iterations with random parameters; nothing is said of another robot's ranges."""
    _, _, cfg = written(urdf(), "urdf")
    cfg.env.num_envs, cfg.domain_rand.randomize_parameters, cfg.noise.add_noise = 4, True, True
    train_cfg = LeggedRobotCfgPPO()
    train_cfg.algorithm.symmetry_cfg.use_data_augmentation = True
    train_cfg.actor.hidden_dims, train_cfg.runner.num_steps_per_env, train_cfg.evaluation.interval = [8], 4, 0
    task = LeggedRobot(cfg)
    assert task.notes == [] and standing_note(task) == ""
    runner, _ = task_registry.make_alg_runner(task, train_cfg=train_cfg, log_root=None)
    before = [parameter.clone() for parameter in runner.alg.actor.parameters()]
    runner.learn(3)
    after = list(runner.alg.actor.parameters())
    assert all(bool(new.isfinite().all()) for new in after)
    assert any(not torch.equal(new, old) for new, old in zip(after, before, strict=True))


SPRINGS = ('_calf" axis="0 1 0"', '_calf" axis="0.1 1 0" ref="-0.9" stiffness="3" springref="-1.2" damping="0.1"')


def test_motion_stays(written, tmp_path):
    """Mass matrix, forces and places at random states are those of plain MuJoCo with the source, springs included."""
    source = as_mjcf("").replace(*SPRINGS).replace('<geom type="sphere"', '<geom quat="1 2 3 4" type="sphere"')
    _, model, _ = written(source, "xml")
    reference, random = mujoco.MjModel.from_xml_string(source), np.random.default_rng(0)
    for _ in range(5):
        turn, seen = random.normal(size=4), []
        qpos = np.concatenate([random.normal(size=3), turn / np.linalg.norm(turn), random.uniform(-2.6, 3, 8)])
        qvel = random.normal(size=14)
        for each in (reference, model):
            data, matrix = mujoco.MjData(each), np.zeros((14, 14))
            data.qpos[:], data.qvel[:] = qpos, qvel
            mujoco.mj_forward(each, data)
            for row, unit in zip(matrix, np.eye(14), strict=True):
                mujoco.mj_mulM(each, data, row, unit)
            places = [data.body(f"{leg}_calf").xpos for leg in ("FL", "FR", "RL", "RR")]
            seen.append([matrix - np.diag(each.dof_armature), data.qfrc_bias - data.qfrc_passive, places])
        for expected, found in zip(*seen, strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(model.qpos_spring[8] + 1.2) < 1e-9 and model.qpos0[8] == -0.9


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "actuator_armature"), reason="this MuJoCo has no such attribute")
def test_rotors_of_motors(written):
    """What actuators add to a joint's inertia and damping stays, as do the limits of two motors of one joint."""
    rotor = '<motor joint="FL_calf" ctrlrange="-2 2" gear="3" ctrllimited="true" armature="0.004" damping="0.02"/>'
    source = as_mjcf("").replace(MOTOR, MOTOR + rotor)
    _, model, _ = written(source, "xml")
    seen = []
    for each in (mujoco.MjModel.from_xml_string(source), model):
        data, row = mujoco.MjData(each), np.zeros(14)
        data.qpos[:], data.qvel[:] = [0, 0, 0, 1, *np.zeros(11)], 1.0
        mujoco.mj_forward(each, data)
        mujoco.mj_mulM(each, data, row, np.eye(14)[7])
        seen.append([row[7], data.qfrc_passive[7]])
    assert seen[1] == pytest.approx(seen[0]) and model.actuator("FL_calf").ctrlrange[1] == 18 + 6


SECOND = f'{MOTOR}<motor joint="FL_calf" group="1" ctrlrange="-50 50" ctrllimited="true"/>'
RATE = 'dyntype="integrator" ctrllimited="true" ctrlrange="-1 1" actlimited="true" actrange="-5 5"'
MOTORS = {
    "another group": ('<option actuatorgroupdisable="2"/>', SECOND, 68, ""),
    "disabled group": ('<option actuatorgroupdisable="1 30"/>', SECOND, 18, "disables are left out: FL_calf"),
    "integrator": ("", f'<general joint="FL_calf" gear="3" gainprm="2" {RATE}/>', 30, "left out: the dynamics"),
}


@pytest.mark.parametrize("kind", MOTORS)
def test_limits_of_unusual_motors(written, kind):
    """Motors that the file disables add nothing, and the torque of an integrator is bounded by its activation."""
    option, motors, limit, note = MOTORS[kind]
    robot, model, _ = written(as_mjcf(option).replace(MOTOR, motors), "xml")
    assert model.actuator("FL_calf").ctrlrange.tolist() == [-limit, limit]
    assert any(note in other for other in robot.source.notes), robot.source.notes


@pytest.mark.parametrize(("given", "expected"), [('lower="-0.8"', [-0.8, 0.0]), ('upper="0.8"', [0.0, 0.8])])
def test_one_limit(written, given, expected):
    """The limit that a URDF does not say is 0."""
    _, model, _ = written(urdf().replace('lower="-0.8" upper="0.8"', given), "urdf")
    assert model.joint("LF_HAA").range.tolist() == expected


def test_meshes_whose_paths_are_stripped(written, tmp_path):
    """A mesh is found in its folder although strippath is for the folder to be left out."""
    block, folder = "v 0 0 0|v 1 0 0|v 0 1 0|v 0 0 1|f 1 3 2|f 1 2 4|f 1 4 3|f 2 3 4", tmp_path / "parts"
    folder.mkdir()
    (folder / "block.obj").write_text(block.replace("|", "\n"))
    mesh = '<compiler strippath="true"/><asset><mesh file="parts/block.obj" scale="0.1 0.1 0.1"/></asset>'
    source = as_mjcf(mesh).replace("<freejoint/>", '<freejoint/><geom type="mesh" mesh="block" mass="1"/>')
    _, model, _ = written(source, "xml")
    assert model.body_mass.sum() == pytest.approx(5 + 4 * 0.85 + 1)


NUMBERED = [("thigh", "1"), ("calf", "2"), ("FL_", "leg1_"), ("FR_", "leg2_"), ("RL_", "leg3_"), ("RR_", "leg4_")]


def test_gains_of_numbered_joints(written):
    """Each joint has the gains of its kind, although names of legs have those of kinds in them."""
    source = as_mjcf("").replace('range="-2.6', 'armature="1e-4" range="-2.6')  # light calves bear less damping
    for words in NUMBERED:
        source = source.replace(*words)
    robot, _, cfg = written(source, "xml")
    assert robot.joints[:3] == ["leg1_1", "leg1_2", "leg2_1"]
    damping = np.reshape(by_joint("damping", cfg.control.damping, robot.joints), (4, 2))
    assert (damping == damping[0]).all() and damping[0, 0] != damping[0, 1]


G1 = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
NAMES = {
    "left_hip_roll_joint": ("left_{}", "right_{}", [f"{part}_joint" for part in G1]),
    "leg1_2": ("leg1_{}", "leg2_{}", range(1, 7)),
    "left_joint2": ("left_{}", "right_{}", ["hip3", "hip2", "hip", "knee", "ankle2", "ankle"]),
}


@pytest.mark.parametrize("second", NAMES)
def test_held_joints(written, second):
    """Those of two legs are hip roll and yaw, also where names of others have theirs in them."""
    source, (left, right, names) = (RESOURCES_DIR / "robots" / "g1" / "g1.xml").read_text(), NAMES[second]
    for part, name in zip(G1, names, strict=True):
        source = source.replace(f'"left_{part}_joint"', f'"{left.format(name)}"')
        source = source.replace(f'"right_{part}_joint"', f'"{right.format(name)}"')
    robot, _, cfg = written(source, "xml")
    assert robot.joints[1] == second
    assert indices_matching(robot.joints, cfg.rewards.held_joints) == [1, 2, 7, 8]


@pytest.mark.parametrize("name", FILES["traps"])
def test_traps(written, name):
    """Each is handled, with a note, and the robot stands where it stood without it."""
    trap = FILES["traps"][name]
    note, suffix = trap["note"], {"urdf": "urdf", "mjcf": "xml"}[trap["source"]]
    robot, model, cfg = written(text_of(trap), suffix)
    assert any(note in other for other in robot.source.notes), robot.source.notes
    assert cfg.rewards.base_height_target == pytest.approx(0.33, abs=0.02)
    if "faces" not in note and "turn" not in note:
        check(model, cfg)


def test_pose_that_stands(written):
    """Without a keyframe, feet are level, as wide apart as hips, and so that the trunk stays level under its weight."""
    robot, model, _ = written(as_mjcf(""), "xml")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    for leg in robot.legs:
        place = data.geom(f"{leg.name}_foot").xpos
        assert place[1:].tolist() == pytest.approx([data.body(f"{leg.name}_thigh").xpos[1], 0.02], abs=1e-3)
    assert hold_pose(data, *robot.gains(), model.actuator_ctrlrange.T, 3.0).tilt < np.radians(3)


@pytest.mark.parametrize("entry", FILES["refusals"], ids=lambda entry: entry["reason"])
def test_refusals(tmp_path, entry):
    """Files that cannot become a robot are refused in one line."""
    file = tmp_path / "robot.xml"
    file.write_text(text_of(entry))
    with pytest.raises(UserError, match=entry["reason"]):
        import_robot(file)


def test_a_namespace(written):
    """A URDF of the same elements in a namespace is the same robot."""
    plain, model, _ = written(urdf(), "urdf")
    spaced, other, _ = written(urdf().replace("<robot", '<robot xmlns="http://www.ros.org"'), "urdf")
    assert spaced.source.notes == plain.source.notes
    assert other.body_mass.tolist() == model.body_mass.tolist()


def test_a_mesh_that_is_missing_beside_another_shape(written):
    """The other shape stays alone, as a note says; alone, it would be replaced by one of the body's inertia."""
    box = '<collision><geometry><box size="0.3 0.2 0.1"/></geometry></collision>'
    robot, model, _ = written(urdf().replace("</inertial>", f"</inertial>{box}", 1), "urdf")
    assert [note for note in robot.source.notes if "mesh" in note] == [
        "collision meshes are missing or not .stl, .obj, .msh and left out, other shapes remain: base"
    ]
    (shape,) = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == 1]
    assert model.geom_size[shape].tolist() == pytest.approx([0.15, 0.1, 0.05])


def test_springs(written):
    """Motors hold a robot against its springs, too, and only gains that count them keep it within 0.2 rad."""
    sprung = as_mjcf("").replace('thigh" axis', 'thigh" stiffness="4" springref="1.5" axis')
    (with_springs, model, _), (without, *_) = written(sprung, "xml"), written(as_mjcf(""), "xml")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    assert np.abs(data.qfrc_spring).max() > 0.1 and with_springs.stance.load != without.stance.load
    held = hold_pose(data, *with_springs.gains(), model.actuator_ctrlrange.T, 3.0)
    assert not held.fall and held.error < 0.2
