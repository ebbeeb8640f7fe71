"""The A1 model against its published facts, all of them written out here and none of them read from the XML."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

A1_XML = Path(__file__).resolve().parents[2] / "resources" / "robots" / "a1" / "a1.xml"

LEGS = ("FR", "FL", "RR", "RL")
LINKS = ("hip", "thigh", "calf")
FRONT = {"FR": 1, "FL": 1, "RR": -1, "RL": -1}
LEFT = {"FR": -1, "FL": 1, "RR": -1, "RL": 1}

AXIS = {"hip": (1, 0, 0), "thigh": (0, 1, 0), "calf": (0, 1, 0)}
RANGE = {"hip": (-0.802851, 0.802851), "thigh": (-1.0472, 4.18879), "calf": (-2.69653, -0.916298)}
TORQUE_LIMIT = 33.5
TRUNK_HEIGHT = 0.303
FOOT_RADIUS = 0.02
NOMINAL = {"FR": (-0.1, 0.8, -1.5), "FL": (0.1, 0.8, -1.5), "RR": (-0.1, 1.0, -1.5), "RL": (0.1, 1.0, -1.5)}

MASS = {"hip": 0.696, "thigh": 1.013, "calf": 0.226}
PRINCIPAL = {
    "hip": (8.07752e-4, 5.5293e-4, 4.68983e-4),
    "thigh": (5.55739e-3, 5.13936e-3, 1.33944e-3),
    "calf": (3.40344e-3, 3.39393e-3, 3.54834e-5),
}
INERTIA_QUAT = {
    "FR_hip": (0.507528, 0.506268, 0.491507, 0.494499),
    "FL_hip": (0.494499, 0.491507, 0.506268, 0.507528),
    "RR_hip": (0.491507, 0.494499, 0.507528, 0.506268),
    "RL_hip": (0.506268, 0.507528, 0.494499, 0.491507),
    "FR_thigh": (0.999125, -0.00256393, -0.0409531, -0.00806091),
    "FL_thigh": (0.999125, 0.00256393, -0.0409531, 0.00806091),
    "RR_thigh": (0.999125, -0.00256393, -0.0409531, -0.00806091),
    "RL_thigh": (0.999125, 0.00256393, -0.0409531, 0.00806091),
} | {f"{leg}_calf": (0.706886, 0.017653, 0.017653, 0.706886) for leg in LEGS}

COLLISION_GEOMS = {"trunk"} | {f"{leg}_{part}" for leg in LEGS for part in (*LINKS, "foot")}


def load_home(path=A1_XML):
    """The model and its data in the home keyframe, with positions computed."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture(scope="module")
def home():
    """One (model, data) pair for the tests that only read."""
    return load_home()


@pytest.fixture(scope="module")
def model(home):
    """The compiled model alone."""
    return home[0]


def link_com(leg, link):
    """Published centre of mass of one link in its own frame."""
    return {
        "hip": (-0.003311 * FRONT[leg], 0.000635 * LEFT[leg], 3.1e-05),
        "thigh": (-0.003237, -0.022327 * LEFT[leg], -0.027326),
        "calf": (0.00472659, 0.0, -0.131975),
    }[link]


def link_offset(leg, link):
    """Published position of one link's joint in the frame of its parent."""
    return {
        "hip": (0.183 * FRONT[leg], 0.047 * LEFT[leg], 0.0),
        "thigh": (0.0, 0.08505 * LEFT[leg], 0.0),
        "calf": (0.0, 0.0, -0.2),
    }[link]


def quat_to_matrix(quat):
    """Rotation matrix of a (w, x, y, z) quaternion, normalized first."""
    w, x, y, z = np.asarray(quat, dtype=float) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def full_inertia(principal, quat):
    """Inertia tensor in the body's axes from principal moments and their frame."""
    rotation = quat_to_matrix(quat)
    return rotation @ np.diag(principal) @ rotation.T


def rot_x(angle):
    """Rotation about x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def rot_y(angle):
    """Rotation about y."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def foot_by_hand(leg, angles, trunk=(0.0, 0.0, TRUNK_HEIGHT)):
    """World position of a foot's centre under a level trunk: hip, thigh and calf composed one after the other."""
    hip, thigh, calf = angles
    foot = np.array((0.0, 0.0, -0.2))
    knee = np.add(link_offset(leg, "calf"), rot_y(calf) @ foot)
    upper = np.add(link_offset(leg, "thigh"), rot_y(thigh) @ knee)
    return np.add(trunk, np.add(link_offset(leg, "hip"), rot_x(hip) @ upper))


def lowest_point(model, data, geom):
    """Height of the lowest point of a sphere, capsule or box geom."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    up = np.abs(data.geom_xmat[geom].reshape(3, 3)[2])
    reach = {
        int(mujoco.mjtGeom.mjGEOM_SPHERE): size[0],
        int(mujoco.mjtGeom.mjGEOM_CAPSULE): size[0] + size[1] * up[2],
        int(mujoco.mjtGeom.mjGEOM_BOX): size @ up,
    }[kind]
    return data.geom_xpos[geom, 2] - reach


def named_geoms(model):
    """Ids of the robot's collision geoms by name: every named geom but the floor."""
    names = {model.geom(i).name: i for i in range(model.ngeom)}
    return {name: i for name, i in names.items() if name and name != "floor"}


# ---------------------------------------------------------------------------------------------------------- masses


def test_total_mass(model):
    """The whole robot weighs 12.453 kg."""
    assert model.body_mass.sum() == pytest.approx(12.453, abs=1e-3)


def test_trunk_inertial(model):
    """The trunk has the published mass, centre of mass and full inertia tensor."""
    trunk = model.body("trunk")
    assert trunk.mass[0] == pytest.approx(4.713)
    np.testing.assert_allclose(trunk.ipos, (0.0, 0.0041, -0.0005), atol=1e-9)
    expected = np.array(
        [
            [0.0158533, -3.66e-05, -6.11e-05],
            [-3.66e-05, 0.0377999, -2.75e-05],
            [-6.11e-05, -2.75e-05, 0.0456542],
        ]
    )
    np.testing.assert_allclose(full_inertia(trunk.inertia, trunk.iquat), expected, atol=1e-9)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("leg", LEGS)
def test_leg_inertial(model, leg, link):
    """Every leg link has its mass, centre of mass, principal moments and their frame, with the side's signs."""
    body = model.body(f"{leg}_{link}")
    assert body.mass[0] == pytest.approx(MASS[link])
    np.testing.assert_allclose(body.ipos, link_com(leg, link), atol=1e-9)
    np.testing.assert_allclose(body.inertia, PRINCIPAL[link], rtol=1e-6)
    expected = full_inertia(PRINCIPAL[link], INERTIA_QUAT[body.name])
    np.testing.assert_allclose(full_inertia(body.inertia, body.iquat), expected, atol=1e-8)


def test_leg_inertia_is_mirrored(model):
    """A right link's inertia is the left one's mirror image: xy and yz change sign."""
    sign = np.array([[1, -1, 1], [-1, 1, -1], [1, -1, 1]])
    for end in "FR":
        for link in LINKS:
            right, left = (model.body(f"{end}{side}_{link}") for side in "RL")
            np.testing.assert_allclose(
                full_inertia(right.inertia, right.iquat), sign * full_inertia(left.inertia, left.iquat), atol=3e-8
            )


# ------------------------------------------------------------------------------------------------ joints and motors


def test_joint_and_motor_order(model):
    """A free root, then FR, FL, RR, RL x hip, thigh, calf, for bodies, joints and motors alike."""
    links = [f"{leg}_{link}" for leg in LEGS for link in LINKS]
    assert [model.body(i).name for i in range(model.nbody)] == ["world", "trunk", *links]
    assert [model.joint(i).name for i in range(model.njnt)] == ["root", *(f"{name}_joint" for name in links)]
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert (model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_HINGE).all()
    assert [model.actuator(i).name for i in range(model.nu)] == links
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], np.arange(1, 13))
    assert (model.nq, model.nv, model.nu) == (19, 18, 12)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("leg", LEGS)
def test_joint_geometry(model, leg, link):
    """Every joint sits at its link's origin, at the published offset, axis and limits."""
    joint, body = model.joint(f"{leg}_{link}_joint"), model.body(f"{leg}_{link}")
    np.testing.assert_allclose(body.pos, link_offset(leg, link), atol=1e-9)
    np.testing.assert_allclose(body.quat, (1, 0, 0, 0), atol=1e-12)
    np.testing.assert_allclose(joint.pos, 0, atol=1e-12)
    np.testing.assert_allclose(joint.axis, AXIS[link], atol=1e-12)
    np.testing.assert_allclose(joint.range, RANGE[link], atol=1e-9)
    assert model.jnt_limited[joint.id]


def test_joint_dynamics(model):
    """Joints have armature 0.01 and friction loss 0.2, no damping, no spring; the free root has none of them."""
    expected = {"dof_armature": 0.01, "dof_frictionloss": 0.2, "dof_damping": 0.0}
    for field, value in expected.items():
        per_dof = getattr(model, field).reshape(model.nv, -1)
        np.testing.assert_allclose(per_dof[:6], 0.0, err_msg=field)
        np.testing.assert_allclose(per_dof[6:, 0], value, err_msg=field)
        np.testing.assert_allclose(per_dof[6:, 1:], 0.0, err_msg=field)
    np.testing.assert_allclose(model.jnt_stiffness, 0.0)


def test_motors_are_plain_torques(home):
    """A control is a torque in N m on its own joint, cut at +-33.5."""
    model, _ = home
    np.testing.assert_allclose(model.actuator_ctrlrange, [[-TORQUE_LIMIT, TORQUE_LIMIT]] * 12)
    np.testing.assert_allclose(model.actuator_forcerange, [[-TORQUE_LIMIT, TORQUE_LIMIT]] * 12)
    assert model.actuator_ctrllimited.all() and model.actuator_forcelimited.all()
    data = mujoco.MjData(model)
    data.ctrl[:] = np.linspace(-50, 50, 12)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator[6:], np.clip(data.ctrl, -TORQUE_LIMIT, TORQUE_LIMIT))
    np.testing.assert_allclose(data.qfrc_actuator[:6], 0.0)


def test_options(model):
    """Time step, solver, cone and integrator are the project's, the iteration limits MuJoCo's own."""
    fresh = mujoco.MjOption()
    assert model.opt.timestep == pytest.approx(0.005)
    assert model.opt.impratio == pytest.approx(100)
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert (model.opt.iterations, model.opt.ls_iterations) == (fresh.iterations, fresh.ls_iterations)


# ------------------------------------------------------------------------------------------------------------ pose


def test_home_keyframe(model):
    """The keyframe is the nominal pose, level at 0.303 m, with zero torque."""
    key = model.key("home")
    np.testing.assert_allclose(key.qpos[:7], (0, 0, TRUNK_HEIGHT, 1, 0, 0, 0))
    np.testing.assert_allclose(key.qpos[7:], np.concatenate([NOMINAL[leg] for leg in LEGS]))
    np.testing.assert_allclose(key.qvel, 0)
    np.testing.assert_allclose(key.ctrl, 0)
    np.testing.assert_allclose(model.body("trunk").pos, (0, 0, TRUNK_HEIGHT))


@pytest.mark.parametrize("leg", LEGS)
def test_foot_position_by_hand(home, leg):
    """Forward kinematics composed here gives MuJoCo's foot position in the nominal pose."""
    _, data = home
    np.testing.assert_allclose(data.geom(f"{leg}_foot").xpos, foot_by_hand(leg, NOMINAL[leg]), atol=1e-9)


def test_foot_position_by_hand_at_random_angles(model):
    """The same agreement holds over the joint ranges, so no axis or sign is right by accident of one pose."""
    rng = np.random.default_rng(0)
    low, high = np.array([RANGE[link] for link in LINKS]).T
    data = mujoco.MjData(model)
    for _ in range(20):
        angles = rng.uniform(low, high, size=(4, 3))
        data.qpos[7:] = angles.ravel()
        mujoco.mj_kinematics(model, data)
        for leg, leg_angles in zip(LEGS, angles, strict=True):
            np.testing.assert_allclose(data.geom(f"{leg}_foot").xpos, foot_by_hand(leg, leg_angles), atol=1e-9)


def test_feet_are_mirrored(home):
    """Left and right feet stand at opposite y and equal x and z."""
    _, data = home
    for end in "FR":
        right, left = (data.geom(f"{end}{side}_foot").xpos for side in "RL")
        np.testing.assert_allclose(right * (1, -1, 1), left, atol=1e-12)


def test_only_feet_are_near_the_floor(home):
    """At home the feet hover within 1 cm of the floor and every other collision geom stays 5 cm above it."""
    model, data = home
    heights = {name: lowest_point(model, data, geom) for name, geom in named_geoms(model).items()}
    for name, height in heights.items():
        assert (0 < height < 0.01) if name.endswith("_foot") else height > 0.05, (name, height)
    touch = TRUNK_HEIGHT - min(heights.values())
    assert touch == pytest.approx(0.30236, abs=1e-5)
    assert data.ncon == 0


# --------------------------------------------------------------------------------------------------------- contacts


def test_collision_geoms(model):
    """There are exactly the named collision geoms, hidden by default, with the published contact parameters."""
    geoms = named_geoms(model)
    assert set(geoms) == COLLISION_GEOMS
    for name, i in [*geoms.items(), ("floor", model.geom("floor").id)]:
        assert model.geom_condim[i] == 3
        assert model.geom_friction[i, 0] == 1.0
        np.testing.assert_array_equal(model.geom_solref[i], (-1000, -80))
        assert model.geom_priority[i] == (1 if name.endswith("_foot") else 0), name
        assert model.geom_group[i] == (0 if name == "floor" else 3), name
    for leg in LEGS:
        foot = model.geom(f"{leg}_foot")
        assert model.body(foot.bodyid[0]).name == f"{leg}_calf"
        assert foot.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE and foot.size[0] == FOOT_RADIUS
        np.testing.assert_allclose(foot.pos, (0, 0, -0.2))


def test_robot_collides_with_the_floor_only(model):
    """By the filter bits every collision geom meets the floor and no two parts of the robot meet."""
    geoms, floor = named_geoms(model), model.geom("floor").id
    contype, conaffinity = model.geom_contype, model.geom_conaffinity

    def meet(a, b):
        return bool(contype[a] & conaffinity[b] or contype[b] & conaffinity[a])

    assert all(meet(i, floor) for i in geoms.values())
    assert not any(meet(a, b) for a in geoms.values() for b in geoms.values())
    assert not meet(floor, floor) and model.npair == 0


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


def test_visual_geoms_never_collide(model):
    """Every other geom is in group 2 with both filter bits zero."""
    visual = [i for i in range(model.ngeom) if not model.geom(i).name]
    assert visual
    assert (model.geom_group[visual] == 2).all()
    assert (model.geom_contype[visual] == 0).all() and (model.geom_conaffinity[visual] == 0).all()


def test_visual_geoms_can_be_dropped(model):
    """Without its visual geoms the robot is the same machine: same masses, inertias and collision geoms."""
    spec = mujoco.MjSpec.from_file(str(A1_XML))
    spec.compiler.discardvisual = True
    bare = spec.compile()
    assert bare.ngeom == len(COLLISION_GEOMS) + 1 and bare.nmesh == 0
    assert set(named_geoms(bare)) == COLLISION_GEOMS
    for field in ("body_mass", "body_ipos", "body_inertia", "body_iquat", "body_pos", "dof_armature", "key_qpos"):
        np.testing.assert_array_equal(getattr(bare, field), getattr(model, field), err_msg=field)


# -------------------------------------------------------------------------------------------------------- behaviour


def test_stands_under_pd_control():
    """Held at the nominal pose by the position baseline's gains it stands on its feet, carrying its weight."""
    model, data = load_home()
    nominal = data.qpos[7:].copy()
    for _ in range(400):
        data.ctrl[:] = np.clip(20 * (nominal - data.qpos[7:]) - 0.5 * data.qvel[6:], -TORQUE_LIMIT, TORQUE_LIMIT)
        mujoco.mj_step(model, data)
    feet = {model.geom(f"{leg}_foot").id for leg in LEGS}
    assert set(data.contact.geom[: data.ncon].ravel()) - {model.geom("floor").id} == feet
    assert data.qpos[2] > 0.22 and quat_to_matrix(data.qpos[3:7])[2, 2] > 0.95
    force, total = np.zeros(6), 0.0
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, force)
        total += force[0]
    assert total == pytest.approx(12.453 * 9.81, rel=0.05)


def test_cameras(model):
    """The cameras that recordings ask for exist."""
    assert {model.camera(i).name for i in range(model.ncam)} == {"track", "side"}


def test_loads_in_mujoco_warp(model):
    """MuJoCo Warp takes the model as it is, on the CPU."""
    wp = pytest.importorskip("warp")
    mujoco_warp = pytest.importorskip("mujoco_warp")
    with wp.ScopedDevice("cpu"):
        warp_model = mujoco_warp.put_model(model)
    assert (warp_model.nv, warp_model.nu, warp_model.ngeom) == (model.nv, model.nu, model.ngeom)
