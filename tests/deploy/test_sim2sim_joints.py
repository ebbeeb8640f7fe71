"""Sim2sim with files of other conventions: axes are turned around, differences and all problems reported."""

import numpy as np
import pytest
from support.robot_files import EVEN_TRUNK, joint, servo, setting, shuffle_motors, turn_left_hips, unitree_order
from support.robot_files import changed as changed  # a fixture
from support.settings import error_of

from legged_torque.deploy.robot import MujocoRobot

STATE = np.array([0.0, 0.0, 0.31]), np.array([1.0, 0.0, 0.0, 0.0])


def walk(robot, policy, steps=10):
    """Trunk, joints, torques and velocities after some control steps from a bent pose."""
    pose = policy.nominal_pose + np.random.default_rng(1).uniform(-0.1, 0.1, 12)
    robot.reset(*STATE, pose, (np.zeros(3), np.zeros(3), np.linspace(-1, 1, 12)))
    policy.reset()
    for _ in range(steps):
        actions = policy.act(policy.observation(robot.state(), [0.5, 0.0, 0.1]))
        for _ in range(4):
            torques = policy.torques(actions, robot.joint_positions(), robot.joint_velocities())
            robot.step(torques)
    return np.concatenate([robot.position, robot.quat, robot.joint_positions(), robot.joint_velocities(), torques])


def test_mirrored_axes_are_turned_around(policy, changed):
    """A file whose left hips turn the other way moves as ours does, and a line says so; orders need no line."""
    expected = walk(MujocoRobot(changed(EVEN_TRUNK), policy.description), policy)
    weak = [setting(f".//joint[@name='{leg}_hip_joint']", range="-0.7 0.8") for leg in ("FL", "RL")]
    changes = (EVEN_TRUNK, turn_left_hips, unitree_order, shuffle_motors, *weak)
    robot = MujocoRobot(changed(*changes), policy.description)
    assert robot.notes == [
        "axes: those of the MJCF point the other way; angles and torques are negated (FL_hip_joint, RL_hip_joint)"
    ]
    np.testing.assert_allclose(walk(robot, policy), expected, atol=1e-6)
    robot.reset(*STATE, np.full(12, 5.0), (np.zeros(3), np.zeros(3), np.zeros(12)))
    assert robot.data.joint("FL_hip_joint").qpos[0] == pytest.approx(-0.7)
    np.testing.assert_allclose(robot.joint_positions()[3], 0.7)
    np.testing.assert_allclose(robot.applied_torques(), 0.0)


def test_differences_of_joints(policy, changed):
    """Mass, damping, armature, tilted axes, and a nominal pose beyond limits."""
    passive = setting(".//default[@class='a1']/joint", damping="2", frictionloss="0.2", armature="0.01")
    edits = [
        setting("worldbody/body/inertial", mass="5.713"),
        passive,
        joint("RR_calf_joint", armature="0.02"),
        joint("FR_hip_joint", axis="1 0 0.2"),
    ]
    robot = MujocoRobot(changed(*edits, joint("RL_calf_joint", range="-2.6 -1.6")), policy.description)
    assert robot.notes == [
        "mass: 13.453 kg here, 12.453 kg in the training",
        "axes: those of the MJCF are not the policy's (FR_hip_joint)",
        "damping of joints: 2 here, 0 in the training (all joints)",
        "armature of joints: 0.02 here, 0.01 in the training (RR_calf_joint)",
        "nominal pose: beyond the joint limits of the MJCF, where episodes start instead (RL_calf_joint)",
    ]


def test_differences_of_the_scene(policy, changed):
    """Time step and motor limits are compared with the policy's, a floor is added, an unnamed trunk is found."""

    def edit(root):
        root.find("worldbody").remove(root.find("worldbody/geom"))
        del root.find(".//geom[@name='trunk']").attrib["name"]

    edits = [setting("option", timestep="0.002"), setting("worldbody/body", name="base")]
    motor = setting(".//motor[@name='FR_thigh']", ctrlrange="-20 25")
    robot = MujocoRobot(changed(edit, motor, *edits), policy.description)
    assert robot.notes == [
        "the MJCF has no floor: a plane at height 0 is added",
        "time step: the MJCF has 0.002 s, policy.yaml's 0.005 s is used",
        "no geom's name contains trunk: those of 'base' end an episode",
        "motor limits: the MJCF has -20 to 25 N m, policy.yaml -33.5 to 33.5 N m; the tighter ones act "
        "(FR_thigh_joint)",
    ]
    assert robot.model.opt.timestep == 0.005
    robot.reset(np.array([0.0, 0.0, 0.04]), STATE[1], policy.nominal_pose, (np.zeros(3), np.zeros(3), np.zeros(12)))
    robot.step(np.zeros(12))
    assert robot.has_fallen() and robot.contact_force() > 10.0


def test_all_problems_are_reported(policy, changed):
    """Actuators that are not motors are reported together, and so are missing joints; the trunk must be free."""
    message = error_of(MujocoRobot, changed(servo(3, 7)), policy.description)
    assert "must be a motor, ctrl its torque; one is a servo" in message and "(FL_hip_joint, RR_thigh_joint)" in message
    renamed = [setting(f".//joint[@name='{leg}_calf_joint']", name=f"{leg}_knee") for leg in ("RR", "RL")]
    motors = [setting(f".//motor[@joint='{leg}_calf_joint']", joint=f"{leg}_knee") for leg in ("RR", "RL")]
    message = error_of(MujocoRobot, changed(*renamed, *motors), policy.description)
    assert "'RR_calf_joint'" in message and "'RL_calf_joint'" in message
    fixed = changed(lambda root: root.find("worldbody/body").remove(root.find(".//freejoint")))
    assert "one free joint" in error_of(MujocoRobot, fixed, policy.description)


def test_self_collision(policy, changed):
    """Parts of the robot collide if they did in training, whatever the file says, and then end episodes as well."""
    file = changed(setting(".//default[@class='collision']/geom", contype="2", conaffinity="3"))
    pose, notes, fallen, forces = policy.nominal_pose.copy(), [], [], []
    pose[:3] = 0.7, 1.4, -1.3  # the thigh in the trunk
    for trained in (False, True):
        with_option = policy.description["robot"] | {"self_collisions": trained}
        robot = MujocoRobot(file, policy.description | {"robot": with_option})
        robot.reset(np.array([0.0, 0.0, 1.0]), STATE[1], pose, (np.zeros(3), np.zeros(3), np.zeros(12)))
        robot.step(np.zeros(12))
        notes.append(robot.notes)
        fallen.append(robot.has_fallen())
        forces.append(robot.contact_force())
    assert notes == [["116 pairs of parts that the MJCF lets collide do not, as in training"], []]
    assert fallen == [False, True] and forces[0] == 0.0 and forces[1] > 10.0
    (note,) = MujocoRobot(changed(), policy.description | {"robot": with_option}).notes
    assert note == "parts of the robot collided with each other in training, those of the MJCF do not"
