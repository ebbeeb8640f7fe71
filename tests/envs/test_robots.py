"""The robots that come along against the figures that others publish for them.

Go1, Go2 and ANYmal C: MuJoCo Menagerie (BSD-3-Clause). G1: Unitree's ``g1_12dof.xml`` (BSD-3-Clause).
"""

import re

import mujoco
import numpy as np
import pytest
import torch
from support.settings import error_of

from legged_torque import resource_path
from legged_torque.envs import task_registry
from legged_torque.paper.gravity.pretraining import make_controller
from legged_torque.utils.options import Options

PUBLISHED = {
    "go1": """
    trunk    0 0 0               5.204     0.0223 0.002 -0.0005              -0.00342088 0.705204 0.000106698 0.708996
             0.0716565 0.0630105 0.0168101
    FR_hip   0.1881 -0.04675 0   0.68     -0.0049166 0.00762615 -8.865e-05   0.507341 0.514169 0.495027 0.482891
             0.000734064 0.000468438 0.000398719
    FL_hip   0.1881 0.04675 0    0.68     -0.0049166 -0.00762615 -8.865e-05  0.482891 0.495027 0.514169 0.507341
             0.000734064 0.000468438 0.000398719
    RR_hip  -0.1881 -0.04675 0   0.68      0.0049166 0.00762615 -8.865e-05   0.495027 0.482891 0.507341 0.514169
             0.000734064 0.000468438 0.000398719
    RL_hip  -0.1881 0.04675 0    0.68      0.0049166 -0.00762615 -8.865e-05  0.514169 0.507341 0.482891 0.495027
             0.000734064 0.000468438 0.000398719
    R_thigh  0 -0.08 0           1.009    -0.00304722 0.019315 -0.0305004    0.65243 -0.0272313 0.0775126 0.753383
             0.00478717 0.00460903 0.000709268
    L_thigh  0 0.08 0            1.009    -0.00304722 -0.019315 -0.0305004   0.753383 0.0775126 -0.0272313 0.65243
             0.00478717 0.00460903 0.000709268
    R_calf   0 0 -0.213          0.195862  0.00429862 0.000976676 -0.146197  0.691246 0.00357467 0.00511118 0.722592
             0.00149767 0.00148468 3.58427e-05
    L_calf   0 0 -0.213          0.195862  0.00429862 0.000976676 -0.146197  0.691246 0.00357467 0.00511118 0.722592
             0.00149767 0.00148468 3.58427e-05
    """,
    "go2": """
    trunk    0 0 0               6.921     0.021112 0 -0.005366             -0.000543471 0.713435 -0.00173769 0.700719
             0.107027 0.0980771 0.0244531
    FL_hip   0.1934 0.0465 0     0.678    -0.0054 0.00194 -0.000105          0.497014 0.499245 0.505462 0.498237
             0.00088403 0.000596003 0.000479967
    FR_hip   0.1934 -0.0465 0    0.678    -0.0054 -0.00194 -0.000105         0.498237 0.505462 0.499245 0.497014
             0.00088403 0.000596003 0.000479967
    RL_hip  -0.1934 0.0465 0     0.678     0.0054 0.00194 -0.000105          0.505462 0.498237 0.497014 0.499245
             0.00088403 0.000596003 0.000479967
    RR_hip  -0.1934 -0.0465 0    0.678     0.0054 -0.00194 -0.000105         0.499245 0.497014 0.498237 0.505462
             0.00088403 0.000596003 0.000479967
    L_thigh  0 0.0955 0          1.152    -0.00374 -0.0223 -0.0327           0.829533 0.0847635 -0.0200632 0.551623
             0.00594973 0.00584149 0.000878787
    R_thigh  0 -0.0955 0         1.152    -0.00374 0.0223 -0.0327            0.551623 -0.0200632 0.0847635 0.829533
             0.00594973 0.00584149 0.000878787
    L_calf   0 0 -0.213          0.241352  0.00629595 -0.000622121 -0.141417 0.710672 0.00154099 -0.00450087 0.703508
             0.0014901 0.00146356 5.31397e-05
    R_calf   0 0 -0.213          0.241352  0.00629595 0.000622121 -0.141417  0.703508 -0.00450087 0.00154099 0.710672
             0.0014901 0.00146356 5.31397e-05
    """,
}
"""Of each body: its place in its parent [m], mass [kg], centre of mass [m], principal frame, moments [kg m^2]."""
PUBLISHED_WITH_FRAMES = {
    "anymal_c": """
    trunk     0 0 0 1 0 0 0                                     19.2035  0.0025 0 0.0502071
              0.5 0.5 0.5 0.5  0.639559 0.624031 0.217374
    LF_HAA    0.2999 0.104 0 0.258819 0.965926 0 0              2.781    0.0566606 -0.015294 -0.00829784
              -0.127978 0.709783 -0.135278 0.679359  0.00585729 0.00491868 0.00329081
    LF_HFE    0.0599 -0.0725816 -0.041905 0.183013 -0.683013 0.683013 0.183013  3.071  0.0308147 4.64995e-05 -0.245696
              0.993166 -0.00515309 -0.0806592 0.0841972  0.03025 0.0298943 0.00418465
    LF_KFE    0.1003 0 -0.285 1 0 0 0                           0.58842  0.005462 -0.0612528 -0.0806598
              0.992934 -0.115904 -0.00105487 -0.0254421  0.0101637 0.00923838 0.00111927
    RF_HAA    0.2999 -0.104 0 0.258819 -0.965926 0 0            2.781    0.0567633 0.015294 -0.00829784
              0.13524 0.679072 0.127985 0.710065  0.00585928 0.0049205 0.00329064
    RF_HFE    0.0599 0.0725816 -0.041905 0.183013 0.683013 0.683013 -0.183013  3.071  0.0308147 4.64995e-05 -0.245696
              0.992775 -0.00512735 -0.0806685 0.0886811  0.0302511 0.0298933 0.0041845
    RF_KFE    0.1003 0 -0.285 1 0 0 0                           0.58842  0.005462 0.0612528 -0.0806598
              0.992934 0.115904 -0.00105487 0.0254421  0.0101637 0.00923838 0.00111927
    LH_HAA    -0.2999 0.104 0 0 0 0.965926 -0.258819            2.781    0.0567633 0.015294 -0.00829784
              0.13524 0.679072 0.127985 0.710065  0.00585928 0.0049205 0.00329064
    LH_HFE    0.0599 0.0725816 -0.041905 0.183013 0.683013 0.683013 -0.183013  3.071  0.0308147 4.64995e-05 -0.245696
              0.992775 -0.00512735 -0.0806685 0.0886811  0.0302511 0.0298933 0.0041845
    LH_KFE    0.1003 0 -0.285 1 0 0 0                           0.58842  0.005462 0.0612528 -0.0806598
              0.992934 0.115904 -0.00105487 0.0254421  0.0101637 0.00923838 0.00111927
    RH_HAA    -0.2999 -0.104 0 0 0 -0.965926 -0.258819          2.781    0.0566606 -0.015294 -0.00829784
              -0.127978 0.709783 -0.135278 0.679359  0.00585729 0.00491868 0.00329081
    RH_HFE    0.0599 -0.0725816 -0.041905 -0.183013 0.683013 -0.683013 -0.183013  3.071  0.0308147 4.64995e-05 -0.245696
              0.993166 -0.00515309 -0.0806592 0.0841972  0.03025 0.0298943 0.00418465
    RH_KFE    0.1003 0 -0.285 1 0 0 0                           0.58842  0.005462 -0.0612528 -0.0806598
              0.992934 -0.115904 -0.00105487 -0.0254421  0.0101637 0.00923838 0.00111927
    """,
    "g1": """
    trunk              0 0 0 1 0 0 0                             17.7349  0.0144905 0.000151462 0.144068
                       0.999881 -0.000505543 -0.0154276 0.000328408  0.552723 0.454092 0.211762
    left_hip_pitch     0 0.064452 -0.1027 1 0 0 0                1.35   0.002741 0.047791 -0.02606
                       0.954862 0.293964 0.0302556 0.030122  0.00181517 0.00153422 0.00116212
    left_hip_roll      0 0.052 -0.030465 0.996179 0 -0.0873386 0  1.52   0.029812 -0.001045 -0.087934
                       0.977808 -1.97119e-05 0.205576 -0.0403793  0.00254986 0.00241169 0.00148755
    left_hip_yaw       0.025001 0 -0.12412 1 0 0 0               1.702  -0.057709 -0.010981 -0.15078
                       0.600598 0.15832 0.223482 0.751181  0.00776166 0.00717575 0.00160139
    left_knee          -0.078273 0.0021489 -0.17734 0.996179 0 0.0873386 0  1.932  0.005457 0.003964 -0.12074
                       0.923418 -0.0327699 0.0158246 0.382067  0.0113804 0.0112778 0.00146458
    left_ankle_pitch   0 -9.4445e-05 -0.30001 1 0 0 0            0.074  -0.007269 0 0.011137
                       0.603053 0.369225 0.369225 0.603053  1.89e-05 1.40805e-05 6.9195e-06
    left_ankle_roll    0 0 -0.017558 1 0 0 0                     0.608  0.026505 0 -0.016425
                       -0.000481092 0.728482 -0.000618967 0.685065  0.00167218 0.0016161 0.000217621
    right_hip_pitch    0 -0.064452 -0.1027 1 0 0 0               1.35   0.002741 -0.047791 -0.02606
                       0.954862 -0.293964 0.0302556 -0.030122  0.00181517 0.00153422 0.00116212
    right_hip_roll     0 -0.052 -0.030465 0.996179 0 -0.0873386 0  1.52   0.029812 0.001045 -0.087934
                       0.977808 1.97119e-05 0.205576 0.0403793  0.00254986 0.00241169 0.00148755
    right_hip_yaw      0.025001 0 -0.12412 1 0 0 0               1.702  -0.057709 0.010981 -0.15078
                       0.751181 0.223482 0.15832 0.600598  0.00776166 0.00717575 0.00160139
    right_knee         -0.078273 -0.0021489 -0.17734 0.996179 0 0.0873386 0  1.932  0.005457 -0.003964 -0.12074
                       0.923439 0.0345276 0.0116333 -0.382012  0.011374 0.0112843 0.00146452
    right_ankle_pitch  0 9.4445e-05 -0.30001 1 0 0 0             0.074  -0.007269 0 0.011137
                       0.603053 0.369225 0.369225 0.603053  1.89e-05 1.40805e-05 6.9195e-06
    right_ankle_roll   0 0 -0.017558 1 0 0 0                     0.608  0.026505 0 -0.016425
                       0.000481092 0.728482 0.000618967 0.685065  0.00167218 0.0016161 0.000217621
    """,
}
"""Likewise with the body's frame in its parent after its place; each body is named as its joint."""
FEET = {  # [m] in the frames of the last bodies of the legs
    "go1": ["_foot 0 0 -0.213"],
    "go2": ["_foot -0.002 0 -0.213"],
    "anymal_c": ["_FOOT 0.01305 -0.08795 -0.31547"],  # left front and right hind; the others are mirror images
    "g1": [  # those of the left leg
        *("_foot_heel_outer -0.05 0.025 -0.03", "_foot_heel_inner -0.05 -0.025 -0.03"),
        *("_foot_toe_outer 0.12 0.03 -0.03", "_foot_toe_inner 0.12 -0.03 -0.03"),
    ],
}
MASSES = {"go1": 12.743448, "go2": 15.206408, "anymal_c": 44.96518, "g1": 32.1069}  # [kg]
LIMITS = {
    "go1": {"hip": (-0.863, 0.863, 23.7), "thigh": (-0.686, 4.501, 23.7), "calf": (-2.818, -0.888, 35.55)},
    "go2": {
        "hip": (-1.0472, 1.0472, 23.7),
        "F._thigh": (-1.5708, 3.4907, 23.7),
        "R._thigh": (-0.5236, 4.5379, 23.7),
        "calf": (-2.7227, -0.83776, 45.43),
    },
    "anymal_c": {
        "L._HAA": (-0.72, 0.49, 80.0),
        "R._HAA": (-0.49, 0.72, 80.0),
        "HFE": (-9.42478, 9.42478, 80.0),
        "KFE": (-9.42478, 9.42478, 80.0),
    },
    "g1": {
        "hip_pitch": (-2.5307, 2.8798, 88.0),
        "left_hip_roll": (-0.5236, 2.9671, 139.0),
        "right_hip_roll": (-2.9671, 0.5236, 139.0),
        "hip_yaw": (-2.7576, 2.7576, 88.0),
        "knee": (-0.087267, 2.8798, 139.0),
        "ankle_pitch": (-0.87267, 0.5236, 50.0),
        "ankle_roll": (-0.2618, 0.2618, 50.0),
    },
}
"""Of each kind of joint, a pattern in its name: lowest and highest angle [rad], torque limit [N m]."""
LEGS = {"go1": ["FR", "FL", "RR", "RL"], "anymal_c": ["LF", "RF", "LH", "RH"], "g1": ["left", "right"]}
LEGS["go2"] = LEGS["go1"]
PARTS = {"go1": ["hip", "thigh", "calf"], "anymal_c": ["HAA", "HFE", "KFE"]}
PARTS |= {"go2": PARTS["go1"], "g1": ["hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll"]}
AXES = {"hip": (1, 0, 0), "thigh": (0, 1, 0), "calf": (0, 1, 0)}
AXES |= {"hip_pitch": (0, 1, 0), "hip_roll": (1, 0, 0), "hip_yaw": (0, 0, 1)}
AXES |= {"knee": (0, 1, 0), "ankle_pitch": (0, 1, 0), "ankle_roll": (1, 0, 0)}
BACKWARDS = {"RF_HFE", "RF_KFE", "LH_HAA", "RH_HAA", "RH_HFE", "RH_KFE"}  # of the ANYmal, in the bodies' frames
JOINT = {"go1": "_joint", "go2": "_joint", "anymal_c": "", "g1": "_joint"}  # what joints' names end with


def published(name):
    """A model of nothing but the published figures, with its joints in the order of this library."""
    rows = PUBLISHED[name] if name in PUBLISHED else PUBLISHED_WITH_FRAMES[name]
    words, width = rows.split(), 15 if name in PUBLISHED else 19
    table = {words[i]: np.array(words[i + 1 : i + width], float) for i in range(0, len(words), width)}

    def add(parent, body, key):
        row = table[key]
        frame = {} if width == 15 else {"quat": row[3:7]}
        mass = row[-11:]
        figures = {"pos": row[:3], "mass": mass[0], "ipos": mass[1:4], "iquat": mass[4:8], "inertia": mass[8:]}
        return parent.add_body(name=body, explicitinertial=True, **figures, **frame)

    spec = mujoco.MjSpec()
    trunk = add(spec.worldbody, "trunk", "trunk")
    trunk.add_freejoint()
    for leg in LEGS[name]:
        body = trunk
        for part in PARTS[name]:
            key = f"{leg}_{part}"
            body = add(body, key, key if key in table else f"{leg[1]}_{part}")
            body.add_joint(name=key, axis=AXES.get(part, (-1 if key in BACKWARDS else 1, 0, 0)))
        for foot in FEET[name]:
            end, x, y, z = foot.split()
            side = -1 if leg in ("RF", "LH", "right") else 1
            body.add_site(name=leg + end, pos=(float(x), side * float(y), float(z)))
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


def feet_of(name):
    """Names of the geoms of all feet."""
    return [leg + foot.split()[0] for leg in LEGS[name] for foot in FEET[name]]


@pytest.mark.parametrize("name", MASSES)
def test_figures(name):
    """Mass matrix and feet at random poses are those of the published figures; limits and total mass as well."""
    model = mujoco.MjModel.from_xml_path(str(file_of(name)))
    other = published(name)
    assert model.body_mass.sum() == pytest.approx(MASSES[name], abs=1e-9)
    random = np.random.default_rng(0)
    for _ in range(20):
        turn = random.normal(size=4)
        angles = random.uniform(model.jnt_range[1:, 0], model.jnt_range[1:, 1])
        qpos = [*random.uniform(-1, 1, 3), *turn / np.linalg.norm(turn), *angles]
        matrix, feet = mass_matrix_and_feet(model, qpos, "geom", feet_of(name))
        expected_matrix, expected_feet = mass_matrix_and_feet(other, qpos, "site", feet_of(name))
        np.testing.assert_allclose(matrix, expected_matrix, rtol=0, atol=1e-5)
        np.testing.assert_allclose(feet, expected_feet, rtol=0, atol=1e-5)
    for joint, key in enumerate((f"{leg}_{part}" for leg in LEGS[name] for part in PARTS[name]), start=1):
        assert model.joint(joint).name == key + JOINT[name]
        low, high, torque = next(limits for kind, limits in LIMITS[name].items() if re.search(kind, key))
        assert model.jnt_range[joint].tolist() == [low, high]
        assert model.actuator_trnid[joint - 1, 0] == joint
        assert model.actuator_forcerange[joint - 1].tolist() == [-torque, torque]


@pytest.mark.parametrize("name", MASSES)
def test_nominal_pose(name):
    """In the nominal pose, that of the settings, no foot is in the floor, and the lowest is up to 1 mm above it."""
    model = mujoco.MjModel.from_xml_path(str(file_of(name)))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    gaps = [data.geom(foot).xpos[2] - model.geom(foot).size[0] for foot in feet_of(name)]
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
        return made[name]

    return get


@pytest.mark.parametrize("name", MASSES)
def test_holding(tasks, name):
    """Robots held at their nominal pose for half a second do not fall; feet of several geoms are one foot each."""
    task = tasks(name)
    assert task.sim.name == "fused" and not task.symmetry.problem
    assert task.feet_contact.shape == (4, len(LEGS[name]))
    task.reset()
    for _ in range(25):
        done = task.step(torch.zeros(4, task.num_actions))[2]
        assert not done.any()
    assert (task.feet_contact.mean(dim=1) >= 0.5).all()
    touched = task.sim.contact_found[:, task.feet_indices].unflatten(1, (len(LEGS[name]), -1)) > 0
    assert torch.equal(task.feet_contact > 0, touched.any(dim=2))


@pytest.mark.parametrize("name", MASSES)
def test_mirrored_worlds(tasks, name):
    """Two worlds that are mirror images by hand are seen as such, and after a step with mirrored actions still are."""
    task = tasks(name)
    task.reset()
    generator = torch.Generator().manual_seed(0)
    half, joints = len(LEGS[name]) // 2, len(PARTS[name])
    order = {"go1": [1, 0, 3, 2], "go2": [1, 0, 3, 2], "anymal_c": [1, 0, 3, 2], "g1": [1, 0]}[name]
    across = (
        {"hip", "HAA", "hip_roll", "hip_yaw", "ankle_roll"} if name != "g1" else {"hip_roll", "hip_yaw", "ankle_roll"}
    )
    signs = torch.tensor([-1.0 if part in across else 1.0 for part in PARTS[name]])
    assert len(order) == 2 * half

    def image(values):
        return (values.unflatten(1, (-1, len(order), joints))[:, :, order] * signs).flatten(1)

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
    """Swings of up to 0.4 s beside a foot on the ground, held joints away from the nominal pose, and being alive."""
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
