"""Unitree Go1 and Go2 against the figures that MuJoCo Menagerie (BSD-3-Clause) publishes for them."""

import mujoco
import numpy as np
import pytest
import torch

from legged_torque import resource_path
from legged_torque.envs import task_registry
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
FEET = {"go1": (0, 0, -0.213), "go2": (-0.002, 0, -0.213)}  # [m] in the calves' frames
MASSES = {"go1": 12.743448, "go2": 15.206408}  # [kg]
LIMITS = {
    "go1": {"hip": (-0.863, 0.863, 23.7), "thigh": (-0.686, 4.501, 23.7), "calf": (-2.818, -0.888, 35.55)},
    "go2": {
        "hip": (-1.0472, 1.0472, 23.7),
        "F_thigh": (-1.5708, 3.4907, 23.7),
        "R_thigh": (-0.5236, 4.5379, 23.7),
        "calf": (-2.7227, -0.83776, 45.43),
    },
}
"""Of each kind of joint: lowest and highest angle [rad], torque limit [N m]."""
LEGS = ("FR", "FL", "RR", "RL")
PARTS = ("hip", "thigh", "calf")
AXES = {"hip": (1, 0, 0), "thigh": (0, 1, 0), "calf": (0, 1, 0)}


def published(name):
    """A model of nothing but the published figures, with its joints in the order of this library."""
    words = PUBLISHED[name].split()
    table = {words[i]: np.array(words[i + 1 : i + 15], float) for i in range(0, len(words), 15)}

    def add(parent, body, key):
        row = table[key]
        figures = {"pos": row[:3], "mass": row[3], "ipos": row[4:7], "iquat": row[7:11], "inertia": row[11:]}
        return parent.add_body(name=body, explicitinertial=True, **figures)

    spec = mujoco.MjSpec()
    trunk = add(spec.worldbody, "trunk", "trunk")
    trunk.add_freejoint()
    for leg in LEGS:
        body = trunk
        for part in PARTS:
            body = add(body, f"{leg}_{part}", f"{leg}_hip" if part == "hip" else f"{leg[1]}_{part}")
            body.add_joint(name=f"{leg}_{part}_joint", axis=AXES[part])
        body.add_site(name=f"{leg}_foot", pos=FEET[name])
    return spec.compile()


def mass_matrix_and_feet(model, qpos, of):
    """Mass matrix without armature, and places of the feet, of a pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    matrix = np.zeros((model.nv, model.nv))
    for column, one in enumerate(np.eye(model.nv)):  # M qacc, without what depends on the version's storage of M
        mujoco.mj_mulM(model, data, matrix[column], one)
    return matrix - np.diag(model.dof_armature), np.array([getattr(data, of)(f"{leg}_foot").xpos for leg in LEGS])


@pytest.mark.parametrize("name", PUBLISHED)
def test_figures(name):
    """Mass matrix and feet at random poses are those of the published figures; limits and total mass as well."""
    model = mujoco.MjModel.from_xml_path(str(resource_path(f"resources/robots/{name}/{name}.xml")))
    other = published(name)
    assert model.body_mass.sum() == pytest.approx(MASSES[name], abs=1e-9)
    random = np.random.default_rng(0)
    for _ in range(20):
        turn = random.normal(size=4)
        angles = random.uniform(model.jnt_range[1:, 0], model.jnt_range[1:, 1])
        qpos = [*random.uniform(-1, 1, 3), *turn / np.linalg.norm(turn), *angles]
        matrix, feet = mass_matrix_and_feet(model, qpos, "geom")
        expected_matrix, expected_feet = mass_matrix_and_feet(other, qpos, "site")
        np.testing.assert_allclose(matrix, expected_matrix, rtol=0, atol=1e-5)
        np.testing.assert_allclose(feet, expected_feet, rtol=0, atol=1e-5)
    for joint in range(1, model.njnt):
        leg, part, _ = model.joint(joint).name.split("_")
        low, high, torque = LIMITS[name].get(part) or LIMITS[name][f"{leg[0]}_{part}"]
        assert model.jnt_range[joint].tolist() == [low, high]
        assert model.actuator_trnid[joint - 1, 0] == joint
        assert model.actuator_forcerange[joint - 1].tolist() == [-torque, torque]


@pytest.mark.parametrize("name", PUBLISHED)
def test_nominal_pose(name):
    """In the nominal pose no foot is in the floor, and the lowest is less than a millimetre above it."""
    model = mujoco.MjModel.from_xml_path(str(resource_path(f"resources/robots/{name}/{name}.xml")))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    gaps = [data.geom(f"{leg}_foot").xpos[2] - model.geom(f"{leg}_foot").size[0] for leg in LEGS]
    assert 0 < min(gaps) < 1e-3


@pytest.mark.parametrize("name", PUBLISHED)
def test_holding(name):
    """Robots held at their nominal pose for half a second do not fall."""
    settings = ["domain_rand.init_roll=[0, 0]", "domain_rand.init_pitch=[0, 0]"]
    task = task_registry.make_env(f"{name}_position", Options(device="cpu", num_envs=2, set=settings))[0]
    task.reset()
    for _ in range(25):
        done = task.step(torch.zeros(2, task.num_actions))[2]
        assert not done.any()
