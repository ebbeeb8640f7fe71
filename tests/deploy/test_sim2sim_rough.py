"""An exported policy on rough ground in plain MuJoCo: what it sees, where it starts and how it moves is the task's."""

import copy
import json
import math

import mujoco
import numpy as np
import pytest
import torch
from support.exports import XML, export_random
from support.ground import ground_cfg
from support.robot_files import changed as changed  # a fixture
from support.scripts import assert_told_in_one_line, run_here

from legged_torque.deploy import ground
from legged_torque.deploy.policy import Policy, State
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.deploy.simulation import Simulation, evaluate, quaternion
from legged_torque.envs.robots.a1 import A1Cfg
from legged_torque.terrain.height_grid import HeightGrid
from legged_torque.terrain.height_map import HeightMap
from legged_torque.terrain.layout import Layout
from legged_torque.utils.config import flat, to_dict

ROUGH = flat({"terrain": to_dict(ground_cfg().terrain)}) | {"terrain.measure_heights": True}
ROUGH |= {"terrain.measure_delay": 2, "commands.heading_command": True, "domain_rand.init_place": [-0.2, 0.3]}
CALM = {"asset.terminate_after_contacts_on": [], "sim.solver_iterations": 100, "sim.ls_iterations": 50}
STILL = (np.zeros(3), np.zeros(3), np.zeros(12))


@pytest.fixture(scope="module")
def exported(make_task, tmp_path_factory):
    """Folder of an exported policy that sees stairs and rough slopes, its task, and its network."""
    folder = tmp_path_factory.mktemp("export") / "out"
    return folder, *export_random(make_task, "a1_position", folder, **ROUGH, **CALM)


@pytest.fixture(scope="module")
def policy(exported):
    """The policy; tests reset it before they use it."""
    return Policy(exported[0])


@pytest.fixture(scope="module")
def robot(policy):
    """The A1 on the ground of the training."""
    return MujocoRobot(XML, policy.description)


@pytest.fixture(scope="module")
def surface(policy):
    """The same ground, as the task has it."""
    layout = Layout(**policy.description["terrain"])
    return HeightMap(layout.heights(), layout.horizontal_scale, layout.corner, "cpu")


def test_ground_is_the_task_s(exported, policy, robot, surface):
    """``policy.yaml`` has the settings of the map; robots start where the task's do, on the task's surface."""
    task = exported[1]
    assert Layout(**policy.description["terrain"]) == task.terrain.layout
    np.testing.assert_array_equal(task.terrain.map.heights, surface.heights)
    np.testing.assert_array_equal(robot.origins, task.terrain._origins.flatten(0, 1))
    robot.reset(np.zeros(3), quaternion(0, 0, 0), policy.nominal_pose, STILL)
    places = np.random.default_rng(0).uniform(-0.499, 0.499, (500, 2)) * surface.size
    np.testing.assert_allclose(robot.ground_heights(places), surface.height(torch.from_numpy(places)), atol=1e-5)
    assert np.ptp(robot.ground_heights(places)) > 0.5


def test_scan_by_rays(policy, robot):
    """Point by point, what the policy sees is what rays meet below points that move and turn with the trunk."""
    assert policy.scan_points.shape == (187, 2)
    columns = slice(policy.description["network"]["num_observations"] - 187, None)
    down, only_ground = np.array([0.0, 0.0, -1.0]), np.array([1, 0, 0, 0, 0, 0], np.uint8)
    for position, angles, heading in (([2.0, 1.7, 0.9], (0.0, 0.0, 0.8), 0.8), ([-1.2, -3.1, 0.3], (3.0, 0, 0), 0.0)):
        robot.reset(position, quaternion(*angles), policy.nominal_pose, STILL)
        expected = np.empty((17, 11))
        for i in range(17):
            for j in range(11):
                x, y = 0.1 * i - 0.8, 0.1 * j - 0.5
                place = [math.cos(heading) * x - math.sin(heading) * y, math.sin(heading) * x + math.cos(heading) * y]
                start = np.array([*(np.array(position[:2]) + place), 30.0])
                depth = mujoco.mj_ray(robot.model, robot.data, start, down, only_ground, True, -1, None)
                expected[i, j] = 5.0 * np.clip(position[2] - 0.5 - (30.0 - depth), -1.0, 1.0)
        state = robot.state()
        state.heights = robot.position[2] - robot.ground_heights(policy.scan_places(robot.position, robot.quat))
        policy.reset()
        scan = policy.observation(state, np.zeros(3))[columns]
        np.testing.assert_allclose(scan, expected.flatten(), atol=1e-4)
        assert np.ptp(scan) > 0.3


def test_heights_are_needed(policy):
    """A policy that sees the ground is not run with heights of other places."""
    state = State(np.zeros(3), np.zeros(12), np.zeros(12), quaternion=np.array([1.0, 0, 0, 0]), heights=np.zeros(186))
    with pytest.raises(ValueError, match="a state needs 187 heights above the ground, at scan_places"):
        policy.observation(state, np.zeros(3))


def test_motion_is_the_task_s(exported, policy, robot):
    """From the task's states, the policy acts as in the task, and the robot moves as there and lands as there."""
    _, task, model = exported
    simulation = Simulation(policy, robot)
    simulation.run(0, 1)
    for world in range(task.num_envs):
        task.reset()
        task.base_pos[:, 0] += 1.4  # half on the first step
        task.reset_buf.fill_(True)  # scans start anew, too
        task.set_state(task.sim.qpos.clone(), task.sim.qvel.clone())
        q, v = task.sim.qpos[world].numpy(), task.sim.qvel[world].numpy()
        robot.reset(q[:3], q[3:7], q[7:], (v[:3], v[3:6], v[6:]))
        policy.reset()
        simulation._heights.clear()
        has_landed, steps_in_air = False, 0
        for _ in range(15):
            obs, command = task.get_observations(), task.commands[world].numpy().copy()
            simulation._heading = float(task.command_generator.headings[world])
            simulation.command[:2] = command[:2]
            simulation._follow_heading()
            np.testing.assert_allclose(simulation.command, command, atol=1e-3)
            with torch.inference_mode():
                task.step(model(obs))
            simulation._control_step()
            assert not task.reset_buf.any()
            has_landed = has_landed or robot.contact_force() > 0.0
            steps_in_air += not has_landed
            difference = np.abs(robot.data.qpos - task.sim.qpos[world].numpy())
            assert difference.max() < (5e-3 if has_landed else 1e-5)
            close = 1e-3 if has_landed else 1e-4
            np.testing.assert_allclose(policy.last_action, task.actions[world].numpy(), atol=close)
            assert robot.height() == pytest.approx(float(task.base_height[world]), abs=5e-3)
        assert steps_in_air > 1 and robot.contact_force() > 50.0


def test_level_map_is_a_plane(policy):
    """A robot that falls onto a level map, feet sinking in deep, moves as on a plane; with MuJoCo's contacts not."""
    description = copy.deepcopy(policy.description)
    ground.select_ground(description, A1Cfg().terrain, ["flat"], [0.0])
    on_map, untouched = MujocoRobot(XML, description), MujocoRobot(XML, description, contacts="mujoco")
    assert [len(robot.notes) for robot in (on_map, untouched)] == [1, 1]
    assert "not tested independently" in on_map.notes[0] and "MuJoCo's own" in untouched.notes[0]
    del description["terrain"]
    on_plane, depths = MujocoRobot(XML, description), [0.0]
    pose = policy.nominal_pose + np.random.default_rng(0).uniform(-0.2, 0.2, 12)
    robots = (on_map, untouched, on_plane)
    for robot in robots:
        robot.reset([0.013, 0.021, 0.35], quaternion(0.1, -0.1, 0.7), pose, (np.array([0.5, 0.2, -3.0]), *STILL[1:]))
    for _ in range(60):
        for robot in robots:
            robot.step(60.0 * (policy.nominal_pose - robot.joint_positions()) - 2.0 * robot.joint_velocities())
        depths += on_plane.data.contact.dist.tolist()
    np.testing.assert_allclose(on_map.data.qpos, on_plane.data.qpos, atol=1e-9)
    assert np.abs(untouched.data.qpos - on_plane.data.qpos).max() > 0.1
    assert min(depths) < -0.03, "a foot of 0.02 m was below the ground"


def test_slope_is_a_tilted_plane():
    """A ball that slides and rolls down a slope of triangles is not disturbed by their edges."""
    scene = "<mujoco><option timestep='0.002'/><worldbody>{}</worldbody></mujoco>"
    ball = '<geom type="sphere" size="0.02" mass="0.3" friction="0.3" solref="-1000 -80"/>'
    body = f'<body pos="-0.3 -0.2 0.2"><freejoint/>{ball}</body>'
    plane = '<geom name="floor" type="plane" size="0 0 0.05" solref="-1000 -80" zaxis="0.3 0.2 1"/>'
    specs = [mujoco.MjSpec.from_string(scene.format(plane + body)) for _ in range(2)]
    places = np.arange(-20, 21) * 0.05
    HeightGrid(-0.3 * places[:, None] - 0.2 * places, 0.05, (-1.0, -1.0)).add_to(specs[0], "floor")
    models = [spec.compile() for spec in specs]
    on_map, on_plane = (mujoco.MjData(model) for model in models)
    for _ in range(400):
        ground.step(models[0], on_map)
        mujoco.mj_step(models[1], on_plane)
    np.testing.assert_allclose(on_map.qpos[:3], on_plane.qpos[:3], atol=1e-5)
    assert on_plane.qpos[0] > 0.2 and on_plane.ncon == 1


def test_episodes_start_on_tiles(policy, robot):
    """Every robot has a tile for all of its episodes, any of them; one that leaves the map has fallen."""
    simulation, tiles, places = Simulation(policy, robot), [], []
    for seed in range(40):
        simulation.run(0, seed)
        for _ in range(2):
            offsets = robot.position - robot.origins - [0.0, 0.0, 0.4]
            tiles.append(int(np.abs(offsets).sum(axis=1).argmin()))
            places.append(offsets[tiles[-1]])
            simulation._new_episode()
        assert tiles[-1] == tiles[-2]
    lowest, highest = np.min(places, axis=0), np.max(places, axis=0)
    assert set(tiles) == set(range(6)) and not lowest[2] and not highest[2]
    assert (lowest[:2] > -0.2).all() and (lowest[:2] < -0.17).all()
    assert (highest[:2] < 0.3).all() and (highest[:2] > 0.27).all()
    robot.position[0] = 9.9
    robot.step(np.zeros(12))
    assert not robot.has_fallen()
    robot.position[0] = 10.1
    robot.step(np.zeros(12))
    assert robot.has_fallen() and math.isinf(robot.height())


def test_chosen_kinds(policy):
    """Tiles of other kinds at other difficulties take the place of those of the training, and of a plane."""
    description = copy.deepcopy(policy.description)
    for trained in (description["terrain"], None):
        ground.select_ground(description, A1Cfg().terrain, ["pits", "flat"], [0.6, 0.25])
        heights = MujocoRobot(XML, description).origins[:, 2].astype(float)
        depths, counts = np.unique(heights.round(6), return_counts=True)
        assert depths.tolist() == [-0.6, -0.25, 0.0] and counts.tolist() == [4, 4, 8]
        assert Layout(**description["terrain"]).tile_size == (6.0 if trained else 8.0)
        del description["terrain"]


def test_a_given_yaw_rate_counts(policy, robot):
    """With a command, there is no heading to turn to, and turning on the spot is tracked."""
    metrics = evaluate(Simulation(policy, robot, command=(0.0, 0.0, 0.5)), 1, 20, 1)
    assert math.isfinite(metrics["track_percentage"].mean)
    drawn = evaluate(Simulation(policy, robot), 1, 20, 1)
    assert math.isfinite(drawn["track_percentage"].mean)


def test_ground_of_the_mjcf(policy, changed):
    """A plane without a name gives way to the tiles; boxes stay, and are seen by the scan, on a plane without end."""

    def edit(root):
        (floor,) = root.findall("worldbody/geom")
        del floor.attrib["name"]

    assert len(MujocoRobot(changed(edit), policy.description).origins) == 6

    def add_step(root):
        edit(root)
        root.find("worldbody/geom").set("size", "2 2 0.05")
        box = {"type": "box", "size": "0.5 1 0.1", "pos": "1 0 0.02"}
        root.find("worldbody").append(root.makeelement("geom", box))

    robot = MujocoRobot(changed(add_step), policy.description)
    assert robot.notes[0].startswith("the MJCF has ground of its own, on which the robot starts at the origin")
    robot.reset([0.0, 0.0, 0.4], quaternion(0, 0, 0), policy.nominal_pose, STILL)
    places = np.array([[0.49, 0.0], [0.51, 0.9], [1.0, 1.1], [9.0, 9.0]])
    np.testing.assert_allclose(robot.ground_heights(places), [0.0, 0.12, 0.0, 0.0], atol=1e-12)
    assert robot.origins.tolist() == [[0.0, 0.0, 0.0]]


def test_script(exported, tmp_path):
    """``sim2sim.py`` takes kinds and a difficulty, says whose contacts act, and reports mistakes in one line."""
    words = [str(exported[0]), "--robots=1", "--steps=3"]
    file = tmp_path / "result.json"
    for contacts, note in (("training", "are corrected to those of training"), ("mujoco", "are MuJoCo's own")):
        options = ["--terrain", "pits", "--level=0.5", f"--contacts={contacts}", f"--json={file}"]
        status, output, error = run_here("sim2sim.py", *words, *options, root=tmp_path)
        assert (status, error) == (0, "") and "height" in output
        assert f"note: contacts with height fields {note}" in output
        assert note in json.loads(file.read_text())["notes"][0]
    result = run_here("sim2sim.py", *words, "--contacts=none", root=tmp_path)
    assert_told_in_one_line(result, "argument --contacts: invalid choice: 'none'")
    result = run_here("sim2sim.py", *words, "--terrain", "pits", "--level", "0.5", "1.5", root=tmp_path)
    assert_told_in_one_line(result, "a level must be from 0 to 1, not 1.5")
    assert_told_in_one_line(run_here("sim2sim.py", *words, "--level=0.5", root=tmp_path), "--level needs --terrain")
