"""The robots in resources/robots against published figures, ``published_robots.yaml``; the A1's joints and contacts."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import warp
import yaml
from support.control import LEGS, SENSED
from support.settings import error_of, torques_in_torch

from legged_torque import resource_path
from legged_torque.envs import task_registry
from legged_torque.paper.gravity.pretraining import make_controller
from legged_torque.utils.options import Options

PUBLISHED = yaml.safe_load(Path(__file__).with_name("published_robots.yaml").read_text("utf-8"))
PITCH, YAW = {"thigh", "calf", "hip_pitch", "knee", "ankle_pitch"}, {"hip_yaw"}  # joints about y and z, others about x


def published(robot):
    """A model of nothing but the published figures, with its joints in the order of this library."""
    spec = mujoco.MjSpec()
    table = robot["bodies"]

    def add(parent, body, key):
        row = table[key]
        frame = {"quat": row[3:7]} if len(row) == 18 else {}
        mass, *rest = row[len(frame) * 4 + 3 :]
        inertia = {"iquat": rest[3:7], "inertia": rest[7:]} if len(rest) == 10 else {"fullinertia": rest[3:]}
        return parent.add_body(
            name=body, explicitinertial=True, pos=row[:3], mass=mass, ipos=rest[:3], **inertia, **frame
        )

    trunk = add(spec.worldbody, "trunk", "trunk")
    trunk.add_freejoint()
    for leg in robot["legs"]:
        body = trunk
        for part in robot["parts"]:
            key = f"{leg}_{part}"
            body = add(body, key, key if key in table else f"{leg[1]}_{part}")
            sign = -1 if key in robot.get("backwards", ()) else 1
            body.add_joint(name=key, axis=(0, 1, 0) if part in PITCH else (0, 0, 1) if part in YAW else (sign, 0, 0))
        for foot, (x, y, z) in robot["feet"].items():
            body.add_site(name=leg + foot, pos=(x, -y if leg in ("RF", "LH", "right") else y, z))
    return spec.compile()


def mass_matrix_and_feet(model, qpos, of, feet):
    """Mass matrix without armature, and places of the feet, of a pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    matrix = np.zeros((model.nv, model.nv))
    for column, one in enumerate(np.eye(model.nv)):  # M qacc, without what depends on the version's storage of M
        mujoco.mj_mulM(model, data, matrix[column], one)
    return matrix - np.diag(model.dof_armature), np.array([getattr(data, of)(foot).xpos for foot in feet])


def file_of(name):
    """The robot's file."""
    return resource_path(f"resources/robots/{name}/{name}.xml")


def feet_of(robot):
    """Names of the geoms of all feet."""
    return [leg + foot for leg in robot["legs"] for foot in robot["feet"]]


@pytest.mark.parametrize("name", PUBLISHED)
def test_figures(name):
    """Mass matrix and feet at random poses are those of the published figures; so are limits and total mass."""
    model = mujoco.MjModel.from_xml_path(str(file_of(name)))
    robot, random = PUBLISHED[name], np.random.default_rng(0)
    other, feet = published(robot), feet_of(robot)
    assert model.body_mass.sum() == pytest.approx(robot["mass"], abs=1e-9)
    for _ in range(20):
        turn = random.normal(size=4)
        angles = random.uniform(model.jnt_range[1:, 0], model.jnt_range[1:, 1])
        qpos = [*random.uniform(-1, 1, 3), *turn / np.linalg.norm(turn), *angles]
        ours, theirs = mass_matrix_and_feet(model, qpos, "geom", feet), mass_matrix_and_feet(other, qpos, "site", feet)
        np.testing.assert_allclose(ours[0], theirs[0], rtol=0, atol=1e-5)
        np.testing.assert_allclose(ours[1], theirs[1], rtol=0, atol=1e-5)
    for joint, key in enumerate((f"{leg}_{part}" for leg in robot["legs"] for part in robot["parts"]), start=1):
        assert model.joint(joint).name == key + robot["suffix"]
        low, high, torque = next(limits for kind, limits in robot["limits"].items() if re.search(kind, key))
        assert model.jnt_range[joint].tolist() == [low, high]
        assert model.actuator_trnid[joint - 1, 0] == joint
        assert model.actuator_forcerange[joint - 1].tolist() == [-torque, torque]


@pytest.mark.parametrize("name", PUBLISHED)
def test_nominal_pose(name):
    """In the nominal pose, that of the settings, no foot is in the floor, and the lowest is up to 1 mm above it."""
    model = mujoco.MjModel.from_xml_path(str(file_of(name)))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    gaps = [data.geom(foot).xpos[2] - model.geom(foot).size[0] for foot in feet_of(PUBLISHED[name])]
    assert 0 < min(gaps) < 1e-3
    cfg = task_registry.get_cfgs(f"{name}_position", Options(device="cpu"))[0]
    assert list(cfg.init_state.default_joint_angles.values()) == data.qpos[7:].tolist()
    assert cfg.rewards.base_height_target == data.qpos[2]


@pytest.fixture(scope="module")
def tasks():
    """Each robot's task of position control, made once."""
    made = {}

    def get(name):
        if name not in made:
            settings = ["domain_rand.init_roll=[0, 0]", "domain_rand.init_pitch=[0, 0]"]
            options = Options(device="cpu", num_envs=4, set=settings, perturbation="none")
            made[name] = task_registry.make_env(f"{name}_position", options)[0]
            torques_in_torch(made[name])  # with the kernel that others have compiled
            if name == "g1":  # no other test needs its kernel: half of the time to compile it, for few steps
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr(warp.config, "optimization_level", 0)
                    made[name].step(torch.zeros(4, made[name].num_actions))
        return made[name]

    return get


@pytest.mark.parametrize("name", PUBLISHED)
def test_holding(tasks, name):
    """Robots held at their nominal pose for half a second do not fall; feet of several geoms are one foot each."""
    task = tasks(name)
    assert task.sim.name == "fused" and not task.symmetry.problem
    assert task.feet_contact.shape == (4, len(PUBLISHED[name]["legs"]))
    torch.manual_seed(0)
    task.reset()
    for _ in range(25):
        done = task.step(torch.zeros(4, task.num_actions))[2]
        assert not done.any()
    assert (task.feet_contact.mean(dim=1) >= 0.5).all()
    touched = task.sim.contact_found[:, task.feet_indices].unflatten(1, (len(PUBLISHED[name]["legs"]), -1)) > 0
    assert torch.equal(task.feet_contact > 0, touched.any(dim=2))


@pytest.mark.parametrize("name", PUBLISHED)
def test_mirrored_worlds(tasks, name):
    """Two worlds that are mirror images by hand are seen as such, and after a step with mirrored actions still are."""
    task = tasks(name)
    task.reset()
    generator = torch.Generator().manual_seed(0)
    parts, order = PUBLISHED[name]["parts"], [1, 0] if name == "g1" else [1, 0, 3, 2]
    across = {"hip", "HAA", "hip_roll", "hip_yaw", "ankle_roll"}
    signs = torch.tensor([-1.0 if part in across else 1.0 for part in parts])

    def image(values):
        return (values.unflatten(1, (-1, len(order), len(parts)))[:, :, order] * signs).flatten(1)

    pose = task.default_dof_pos + 0.2 * torch.rand(2, task.num_dof, generator=generator)
    speed = torch.randn(2, task.num_dof, generator=generator)
    qpos, qvel = task.sim.qpos.clone(), torch.zeros_like(task.sim.qvel)
    qpos[:, :2], qpos[:, 2], qpos[:, 3:7] = 0.0, task.cfg.rewards.base_height_target, torch.tensor([1.0, 0.0, 0.0, 0.0])
    qpos[:, 7:], qvel[:, 6:] = torch.cat([pose, image(pose)]), torch.cat([speed, image(speed)])
    task.commands[:] = torch.tensor([[0.4, 0.3, 0.2]] * 2 + [[0.4, -0.3, -0.2]] * 2)
    task.set_state(qpos, qvel)
    actions = torch.randn(2, task.num_actions, generator=generator)
    rewards = task.step(torch.cat([actions, image(actions)]))[1]
    torch.testing.assert_close(task.dof_pos[2:], image(task.dof_pos[:2]), rtol=0, atol=2e-3)
    torch.testing.assert_close(rewards[2:], rewards[:2], rtol=0, atol=1e-3)
    for group, seen in task.get_observations().items():
        torch.testing.assert_close(task.mirror(group, seen[:2]), seen[2:], rtol=0, atol=5e-2)


def test_rewards_of_two_feet(tasks):
    """Swings of up to 0.4 s with the other foot on the ground, deviations of some joints, and being alive."""
    task = tasks("g1")
    task.commands[:] = torch.tensor([0.3, 0.0, 0.0])
    task.commands[3] = 0.0
    task.feet_contact[:] = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    task.feet_air_time[:] = torch.tensor([[0.0, 0.1], [0.0, 0.41], [0.1, 0.1], [0.1, 0.0]])
    torch.testing.assert_close(task._reward_single_stance(), torch.tensor([0.25, 0.0, 0.0, 0.0]))
    task.commands[3, 2] = -0.2
    assert task._reward_single_stance()[3].item() == pytest.approx(0.25)
    task.dof_pos[:] = task.default_dof_pos
    task.dof_pos[1] += torch.tensor([0.5, 0.1, -0.2, 0.5, 0.5, 0.5] * 2)
    torch.testing.assert_close(task._reward_dof_deviation(), torch.tensor([0.0, 0.6, 0.0, 0.0]))
    assert task._reward_alive().tolist() == [1.0] * 4


def test_gravity_pretraining_refuses_feet_of_several_geoms():
    """By name, before anything is simulated."""
    task = task_registry.make_env("g1_torque_gravity", Options(device="cpu", num_envs=1))[0]
    assert "'resources/robots/g1/g1.xml' has 8 for 2 feet" in error_of(make_controller, task)


@pytest.fixture(scope="module")
def model():
    """The compiled model."""
    return mujoco.MjModel.from_xml_path(str(file_of("a1")))


def named_geoms(model):
    """Ids of the robot's collision geoms by name: every named geom but the floor."""
    names = {model.geom(i).name: i for i in range(model.ngeom)}
    return {name: i for name, i in names.items() if name and name != "floor"}


def test_joint_dynamics(model):
    """Joints have armature 0.01 and friction loss 0.2, no damping, no spring; the free root has none of them."""
    for field, value in {"dof_armature": 0.01, "dof_frictionloss": 0.2, "dof_damping": 0.0}.items():
        per_dof = getattr(model, field).reshape(model.nv, -1)
        np.testing.assert_allclose(per_dof[:6], 0.0, err_msg=field)
        np.testing.assert_allclose(per_dof[6:, 0], value, err_msg=field)
        np.testing.assert_allclose(per_dof[6:, 1:], 0.0, err_msg=field)
    np.testing.assert_allclose(model.jnt_stiffness, 0.0)


def test_collision_geoms(model):
    """There are exactly the named collision geoms, hidden by default, with the published contact parameters."""
    geoms = named_geoms(model)
    assert set(geoms) == set(SENSED)
    for name, i in [*geoms.items(), ("floor", model.geom("floor").id)]:
        assert model.geom_condim[i] == 3
        assert model.geom_friction[i, 0] == 1.0
        np.testing.assert_array_equal(model.geom_solref[i], (-1000, -80))
        assert model.geom_priority[i] == (1 if name.endswith("_foot") else 0), name
        assert model.geom_group[i] == (0 if name == "floor" else 3), name
    for leg in LEGS:
        foot = model.geom(f"{leg}_foot")
        assert model.body(foot.bodyid[0]).name == f"{leg}_calf"
        assert foot.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE and foot.size[0] == 0.02
        np.testing.assert_allclose(foot.pos, (0, 0, -0.2))


def test_folded_robot_in_the_floor(model):
    """Pushed into the floor and folded into itself, the robot touches the floor with all its parts and nothing else."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] = 0.0
    data.qpos[7:] = np.tile((0.0, 1.2, -2.6), 4)
    mujoco.mj_forward(model, data)
    floor = model.geom("floor").id
    pairs = data.contact.geom[: data.ncon]
    assert (pairs == floor).any(axis=1).all()
    assert set(pairs[pairs != floor]) == set(named_geoms(model).values())
