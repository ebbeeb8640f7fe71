"""Dynamics against plain MuJoCo, contact-consistent control against its equations, contact forces against bounds."""

import mujoco
import numpy as np
import pytest
import torch

from legged_torque import RESOURCES_DIR
from legged_torque.paper.gravity import operational_space as osc
from legged_torque.paper.gravity.contact_forces import ForceDistribution, ForceLimits
from legged_torque.paper.gravity.dynamics import RobotDynamics
from legged_torque.sim.model import build_model, collision_geoms
from legged_torque.utils.errors import UserError
from legged_torque.utils.mjcf import read_spec

FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")
ENOUGH = [(1, 1, 1, 1), (1, 1, 0, 1)]
"""Masks of contacts with which joints can accelerate the trunk at will."""
MASKS = [*ENOUGH, (0, 1, 1, 0), (0, 0, 1, 0), (0, 0, 0, 0)]


@pytest.fixture(scope="module")
def model():
    """The A1 of the tasks."""
    spec = read_spec(RESOURCES_DIR / "robots/a1/a1.xml")
    return build_model(spec, collision_geoms(spec))


def random_states(model, count, seed=0):
    """Positions and velocities around the nominal pose, anywhere and at any orientation; exact in single precision."""
    rng = np.random.default_rng(seed)
    qpos = np.tile(model.key_qpos[0], (count, 1))
    qpos[:, :3] = rng.normal(size=(count, 3))
    quat = rng.normal(size=(count, 4))
    qpos[:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    qpos[:, 7:] += 0.3 * rng.normal(size=(count, 12))
    qvel = 2.0 * rng.normal(size=(count, 18))
    return qpos.astype(np.float32).astype(float), qvel.astype(np.float32).astype(float)


def reference(model, qpos, qvel):
    """The quantities of one state in plain MuJoCo, in double precision."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    inertia, still = np.zeros((18, 18)), mujoco.MjData(model)
    mujoco.mj_fullM(model, data, inertia)
    still.qpos[:] = qpos
    mujoco.mj_forward(model, still)
    points, jacobians, bias = [], [], []
    for name in FEET:
        geom = model.geom(name).id
        point = data.geom_xpos[geom] - [0.0, 0.0, model.geom_size[geom, 0]]
        jacobian, rate = np.zeros((3, 18)), np.zeros((3, 18))
        mujoco.mj_jac(model, data, jacobian, None, point, model.geom_bodyid[geom])
        mujoco.mj_jacDot(model, data, rate, None, point, model.geom_bodyid[geom])
        points.append(point), jacobians.append(jacobian), bias.append(rate @ qvel)
    trunk, trunk_rate = np.zeros((6, 18)), np.zeros((6, 18))
    mujoco.mj_jacBody(model, data, trunk[:3], trunk[3:], 1)
    mujoco.mj_jacDot(model, data, trunk_rate[:3], trunk_rate[3:], data.xpos[1], 1)
    np.testing.assert_allclose(trunk_rate @ qvel, 0.0, atol=1e-12)
    return {
        "inertia": inertia,
        "gravity": still.qfrc_bias,
        "coriolis": data.qfrc_bias - still.qfrc_bias,
        "contact_points": np.array(points),
        "contact_jacobians": np.array(jacobians),
        "contact_bias": np.array(bias),
        "trunk_jacobian": trunk,
        "com": data.subtree_com[1],
    }


@pytest.fixture(scope="module")
def states(model):
    """MuJoCo's quantities of a few states, stacked, as tensors in double precision."""
    each = [reference(model, *state) for state in zip(*random_states(model, 6), strict=True)]
    return {name: torch.tensor(np.array([one[name] for one in each])) for name in each[0]}


def spaces(states, mask):
    """Contact and task space of all states with the same contacts."""
    mask = torch.tensor(mask, dtype=torch.bool).expand(len(states["inertia"]), -1)
    contacts = osc.contact_space(states["inertia"], states["contact_jacobians"], states["contact_bias"], mask)
    return contacts, osc.task_space(contacts, states["trunk_jacobian"], states["coriolis"], states["gravity"])


def constrained_motion(states, mask, torques):
    """Accelerations and contact forces from the equations of motion and the constraints, as one linear system."""
    rows = np.repeat(np.array(mask, dtype=bool), 3)
    accelerations, forces = [], []
    for i in range(len(torques)):
        inertia = states["inertia"][i].numpy()
        jacobian = states["contact_jacobians"][i].reshape(12, 18).numpy()[rows]
        applied = np.r_[np.zeros(6), torques[i]] - (states["coriolis"] + states["gravity"])[i].numpy()
        count = len(jacobian)
        system = np.block([[inertia, -jacobian.T], [jacobian, np.zeros((count, count))]])
        solution = np.linalg.solve(system, np.r_[applied, -states["contact_bias"][i].flatten().numpy()[rows]])
        force = np.zeros(12)
        force[rows] = solution[18:]
        accelerations.append(solution[:18])
        forces.append(force.reshape(4, 3))
    return torch.tensor(np.array(accelerations)), torch.tensor(np.array(forces))


def random_torques(seed):
    """Torques of the twelve joints in all six states [N m]."""
    return 10.0 * torch.randn(6, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_dynamics_matches_mujoco(model):
    """All quantities agree with plain MuJoCo's to single precision; every foot is carried by its own leg's joints."""
    qpos, qvel = random_states(model, 8, seed=3)
    robot = RobotDynamics(model, 8, "cpu", FEET)
    robot.update(torch.tensor(qpos), torch.tensor(qvel))
    for i in range(8):
        truth = reference(model, qpos[i], qvel[i])
        for name, expected in truth.items():
            error = np.abs(getattr(robot, name)[i].numpy() - expected).max()
            scale = "gravity" if name == "coriolis" else name  # MuJoCo Warp computes their sum
            assert error <= 1e-5 * np.abs(truth[scale]).max(), f"{name}, state {i}"
    carrying = [[model.joint(j + 1).name[:2] for j in row.nonzero().flatten()] for row in robot.contact_joints]
    assert carrying == [["FR"] * 3, ["FL"] * 3, ["RR"] * 3, ["RL"] * 3]


def test_robots_without_these_formulas(model):
    """Feet must be spheres, which have a lowest point of their own, and the trunk must be free."""
    with pytest.raises(UserError, match="must be a sphere"):
        RobotDynamics(model, 1, "cpu", ["trunk"])
    fixed = "<mujoco><worldbody><body><joint/><geom name='foot' size='0.1'/></body></worldbody></mujoco>"
    with pytest.raises(UserError, match="free trunk"):
        RobotDynamics(mujoco.MjModel.from_xml_string(fixed), 1, "cpu", ["foot"])


@pytest.mark.parametrize("mask", MASKS)
def test_contact_forces_and_task_dynamics(states, mask):
    """Under any torques, contact forces and the trunk's acceleration solve the equations of motion (eqs. 2, 11)."""
    contacts, task = spaces(states, mask)
    torques = random_torques(0)
    acceleration, forces = constrained_motion(states, mask, torques)
    found = osc.contact_forces(contacts, torques, states["coriolis"] + states["gravity"])
    torch.testing.assert_close(found, forces, rtol=1e-8, atol=1e-8)
    assert (found[:, np.array(mask) == 0] == 0.0).all()
    exerted = osc.apply(task.inverse[:, :, 6:], torques)
    trunk = osc.apply(states["trunk_jacobian"], acceleration)
    needed = osc.apply(task.inertia, trunk) + task.coriolis + task.gravity
    torch.testing.assert_close(needed, exerted, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("mask", ENOUGH)
def test_task_torques_accelerate_the_trunk_as_wanted(states, mask):
    """Task torques give the trunk f*, and posture torques do not change that (eqs. 4, 5)."""
    _, task = spaces(states, mask)
    wanted = torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    serving = torch.tensor(mask, dtype=torch.bool).repeat_interleave(3).expand(6, -1)  # three joints to a leg
    to_torques = osc.torque_map(task, serving, 0.0)
    torques = osc.apply(to_torques, osc.task_force(task, wanted))
    posture = osc.posture_torques(task, to_torques, random_torques(2))
    assert posture.abs().amax(dim=1).min() > 0.1
    for gamma in (torques, torques + posture):
        acceleration, _ = constrained_motion(states, mask, gamma)
        found = osc.apply(states["trunk_jacobian"], acceleration)
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-6)


def test_invert_survives_rounding():
    """A matrix that rounding made indefinite has the inverse zero; others in the batch are inverted."""
    matrices = torch.tensor([[[2.0, 0.0], [0.0, 4.0]], [[1.0, 1.0], [1.0, 1.0 - 1e-6]]])
    expected = torch.tensor([[[0.5, 0.0], [0.0, 0.25]], [[0.0, 0.0], [0.0, 0.0]]])
    torch.testing.assert_close(osc.invert(matrices), expected)


LIMITS = ForceLimits(friction=0.6, lowest=4.0, highest=160.0)
ARM = 0.2
REGULARIZATION = 1e-2
CONVERGED = 30
"""Iterations after which double precision is exhausted."""


def grasp_matrix(points):
    """The wrench about the origin of unit forces at points (n, k, 3)."""
    n, k, _ = points.shape
    axes = torch.eye(3, dtype=points.dtype).expand(n, k, 3, 3)
    moments = torch.linalg.cross(points.unsqueeze(2).expand(n, k, 3, 3), axes, dim=-1)
    return torch.cat([axes, moments], dim=3).permute(0, 3, 1, 2).flatten(2)


def random_problems(count=300):
    """Feet around a trunk, wrenches and reference forces that many of them cannot bear, and any contact state."""
    generator = torch.Generator().manual_seed(0)
    feet = torch.tensor([[0.2, -0.13, -0.3], [0.2, 0.13, -0.3], [-0.2, -0.13, -0.3], [-0.2, 0.13, -0.3]])
    points = feet + 0.05 * torch.randn(count, 4, 3, generator=generator)
    wrench = torch.tensor([0.0, 0.0, 120.0, 0.0, 0.0, 0.0]) + torch.randn(count, 6, generator=generator) * torch.tensor(
        [60.0, 60.0, 80.0, 15.0, 15.0, 5.0]
    )
    reference = torch.tensor([0.0, 0.0, 30.0]) + 40.0 * torch.randn(count, 4, 3, generator=generator)
    mask = torch.rand(count, 4, generator=generator) < 0.75
    return grasp_matrix(points.double()), wrench.double(), reference.double(), mask


def cost_and_gradient(problem, forces):
    """The documented objective of each problem, halved, and its gradient by the forces, masked ones left out."""
    grasp, wrench, reference, mask = (part.numpy().astype(float) for part in problem)
    forces = forces.numpy().astype(float)
    weights = np.array([1.0, 1.0, 1.0, ARM**-2, ARM**-2, ARM**-2])
    error = np.einsum("nij,nj->ni", grasp, (forces * mask[..., None]).reshape(len(forces), -1)) - wrench
    deviation = (forces - reference) * mask[..., None]
    cost = 0.5 * (weights * error**2).sum(1) + 0.5 * REGULARIZATION * (deviation**2).sum((1, 2))
    gradient = np.einsum("nij,ni->nj", grasp, weights * error).reshape(forces.shape) + REGULARIZATION * deviation
    return cost, gradient * mask[..., None]


def above_optimum(gradient, forces, mask):
    """The most by which a convex cost can be above its minimum: over the corners of each contact's allowed forces."""
    mu = LIMITS.friction
    sides = np.array([[mu, 0, 1], [-mu, 0, 1], [0, mu, 1], [0, -mu, 1]])
    corners = np.concatenate([LIMITS.lowest * sides, LIMITS.highest * sides])
    least = (gradient @ corners.T).min(axis=2)
    return (((gradient * forces.numpy()).sum(2) - least) * mask.numpy()).sum(1)


def test_forces_are_allowed_and_optimal():
    """Forces are allowed, 0 where nothing touches, none costs less; in single precision they are 3 N worse at most."""
    problem = random_problems()
    mask = problem[3]
    forces, residual = ForceDistribution(LIMITS, ARM, REGULARIZATION, "cpu", torch.float64)(*problem, CONVERGED)
    assert (forces[~mask] == 0.0).all()
    tangential, normal = forces[mask][:, :2].abs().sum(1), forces[mask][:, 2]
    assert (tangential <= LIMITS.friction * normal).all()
    assert (normal >= LIMITS.lowest).all() and (normal <= LIMITS.highest).all()
    for at_limit in (
        tangential > 0.999 * LIMITS.friction * normal,
        normal < 1.001 * LIMITS.lowest,
        normal > 0.999 * LIMITS.highest,
    ):
        assert at_limit.sum() > 10  # every kind of limit matters in these problems
    cost, gradient = cost_and_gradient(problem, forces)
    assert (above_optimum(gradient, forces, mask) <= 1e-6 * cost + 1e-6).all()
    given = (problem[0] @ (forces * mask.unsqueeze(2)).flatten(1).unsqueeze(2)).squeeze(2)
    torch.testing.assert_close(residual, given - problem[1], rtol=0, atol=1e-9)
    single, _ = ForceDistribution(LIMITS, ARM, REGULARIZATION, "cpu")(*(part.float() for part in problem[:3]), mask)
    assert (cost_and_gradient(problem, single)[0] - cost <= 0.5 * 3.0**2).all()


@pytest.mark.parametrize("limits", [(0.0, 0.0, 100.0), (0.5, -1.0, 100.0), (0.5, 10.0, 10.0)])
def test_refuses_empty_limits(limits):
    """Limits that no force is inside of are refused."""
    with pytest.raises(UserError, match="friction > 0"):
        ForceDistribution(ForceLimits(*limits), ARM, REGULARIZATION, "cpu")
