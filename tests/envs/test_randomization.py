"""Random parameters, pushes and sensor errors: they act as in MuJoCo, and draws follow their definition."""

import copy
import math

import mujoco
import numpy as np
import pytest
import torch
from support.settings import error_of

from legged_torque.sim.randomization import Randomization, RandomParameter
from legged_torque.utils.errors import UserError

WIDE = {
    "domain_rand.trunk_mass": {"add": [-1.0, 1.0], "scale": [0.75, 1.25]},
    "domain_rand.action_scale": {"add": [-0.03, 0.03]},
    "domain_rand.stiffness": {"add": [-3.0, 3.0], "scale": [0.9, 1.1], "scale_per_joint": [0.98, 1.02]},
}
FIELDS = ("body_inertia", "body_ipos", "body_mass", "dof_armature", "dof_damping", "dof_frictionloss", "geom_friction")
FIELDS += ("geom_pos", "geom_size", "geom_solref", "gravity", "jnt_stiffness")
ON = {"domain_rand.randomize_parameters": True}


def edited_model(sim, world):
    """MuJoCo's model with the numbers of one world, and everything that follows from them."""
    model = copy.copy(sim.mj_model)
    for name in FIELDS:
        target = model.opt.gravity if name == "gravity" else getattr(model, name)
        target[:] = sim.field(name)[world].numpy().reshape(target.shape)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    return model


def check_constants(sim):
    """Compare the inverse weights of all worlds with those of mj_setConst."""
    for world in range(sim.num_envs):
        model = edited_model(sim, world)
        np.testing.assert_allclose(sim.field("body_invweight0")[world, 1:], model.body_invweight0[1:], rtol=1e-5)
        np.testing.assert_allclose(sim.field("dof_invweight0")[world], model.dof_invweight0, rtol=1e-5)


def uniformity(values, low, high):
    """Kolmogorov's distance of a sample from a uniform distribution, in units of what 1 in 1000 samples exceeds."""
    sample = np.sort(np.asarray(values, dtype=np.float64).ravel())
    expected = np.clip((sample - low) / (high - low), 0.0, 1.0)
    steps = np.arange(len(sample) + 1) / len(sample)
    distance = max(np.abs(expected - steps[1:]).max(), np.abs(expected - steps[:-1]).max())
    return distance * np.sqrt(len(sample)) / 1.95


def move_about(task):
    """Put worlds into lively states near the floor, with torques."""
    sim = task.sim
    sim.qpos[:, 2] = torch.linspace(0.2, 0.33, task.num_envs)
    low, high = torch.tensor(sim.mj_model.jnt_range[1:], dtype=torch.float32).T
    task.dof_pos.clamp_(low + 1e-3, high - 1e-3)  # at a limit, rounding decides whether it acts
    sim.qvel.copy_(torch.randn_like(sim.qvel))
    sim.qacc_warmstart.zero_()
    sim.ctrl.copy_(8.0 * torch.randn_like(sim.ctrl))


def test_worlds_move_as_their_models(make_task):
    """A world with drawn parameters moves as MuJoCo's model with these numbers, and otherwise than without them."""
    ground = {"ground_friction": {"set": [0.3, 2.0]}, "contact_damping": {"set": [30.0, 130.0]}}
    settings = ON | WIDE | {f"domain_rand.{key}": value for key, value in ground.items()}
    task = make_task("a1_torque", 12, **settings, **{"sim.solver_iterations": 50, "sim.ls_iterations": 50})
    move_about(task)
    before = task.sim.qvel.clone()
    moved = 0
    data = [mujoco.MjData(task.sim.mj_model) for _ in range(12)]
    for world in range(12):
        for field in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
            getattr(data[world], field)[:] = getattr(task.sim, field)[world].numpy()
    task.sim.step()
    for world in range(12):
        plain = mujoco.MjData(task.sim.mj_model)
        for field in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
            getattr(plain, field)[:] = getattr(data[world], field)
        mujoco.mj_step(task.sim.mj_model, plain)
        mujoco.mj_step(edited_model(task.sim, world), data[world])
        np.testing.assert_allclose(task.sim.qvel[world], data[world].qvel, atol=3e-3)
        moved += np.abs(plain.qvel - data[world].qvel).max() > 1e-4
    assert moved >= 5 and not torch.equal(task.sim.qvel, before)


def test_derived_constants(make_task):
    """Inverse weights are those of mj_setConst, in the worlds that were drawn anew and only there."""
    task = make_task("a1_torque", 6, **ON, **{"domain_rand.resampling_probability": 0.0})
    check_constants(task.sim)
    before = {name: task.sim.field(name).clone() for name in (*FIELDS, "body_invweight0", "dof_invweight0")}
    mask = torch.tensor([True, False, True, False, False, False])
    task.events.apply(mask)
    for name, old in before.items():
        new = task.sim.field(name)
        assert torch.equal(new[~mask], old[~mask]), name
        assert not torch.equal(new[mask], old[mask]), name


def test_distributions(make_task):
    """Draws are uniform in their ranges (Kolmogorov-Smirnov), and no two parameters are correlated."""
    task = make_task("a1_position", 1500, **ON, **{"domain_rand.action_scale": {"add": [-0.03, 0.03]}})
    sim, model = task.sim, task.sim.mj_model
    feet = [model.geom(name).id for name in task.foot_names]
    stiffness, damping = -sim.field("geom_solref")[:, 0, :2].T
    samples = [  # of the published set "default"
        (sim.field("body_mass")[:, 1] - model.body_mass[1], -1.0, 1.0),
        (sim.field("body_ipos")[:, 1, 0] - model.body_ipos[1, 0], -0.003, 0.003),
        (sim.field("geom_size")[:, feet[0], 0], 0.019, 0.021),
        (sim.field("geom_pos")[:, feet] - torch.tensor(model.geom_pos[feet]), -0.0025, 0.0025),
        (sim.field("dof_damping")[:, 6:], 0.0, 0.2),
        (sim.field("dof_armature")[:, 6:], 0.008, 0.02),
        (sim.field("jnt_stiffness")[:, 1:], 0.0, 0.2),
        (sim.field("dof_frictionloss")[:, 6:], 0.0, 0.4),
        (sim.field("geom_friction")[:, 0, 0], 0.8, 1.2),
        (stiffness, 900.0, 1100.0),
        (-sim.field("gravity")[:, 2], 9.51, 10.11),
        (task.joint_offset, -0.01, 0.01),
        (task.action_scale - 0.25, -0.03, 0.03),
    ]
    for number, (values, low, high) in enumerate(samples):
        assert uniformity(values, low, high) < 1.0, number
    torch.testing.assert_close(damping, 72.0 + (stiffness - 900.0) * 0.08)  # it goes with the stiffness
    table = torch.cat([values.double().reshape(len(values), -1) for values, _, _ in samples], dim=1)
    correlations = torch.corrcoef(table.T)
    assert (correlations - torch.eye(len(correlations))).abs().max() < 0.15


def test_numbers_that_are_drawn_together(make_task):
    """Inertia changes with the mass, all kinds of friction with the first, torque scale with the action scale.

    The radius is the same for all feet, and the trunk's centre of mass moves alike on all axes. Without their factors
    per joint, motor strength and gains are the same for all joints.
    """
    without = {f"domain_rand.{name}": {"scale": [0.9, 1.1]} for name in ("motor_strength", "stiffness", "damping")}
    task = make_task("a1_torque", 50, **{**ON, **WIDE, **without})
    model = task.sim.mj_model
    ratio = task.sim.field("body_mass")[:, 1] / model.body_mass[1]
    inertia = task.sim.field("body_inertia")[:, 1] / torch.tensor(model.body_inertia[1], dtype=torch.float32)
    torch.testing.assert_close(inertia, ratio.unsqueeze(1).expand(-1, 3), rtol=1e-4, atol=1e-5)
    friction = task.sim.field("geom_friction")
    assert (friction == friction[:, :1]).all()
    kinds = torch.tensor(model.geom_friction[0] / model.geom_friction[0, 0], dtype=torch.float32)
    torch.testing.assert_close(friction[:, 0], friction[:, 0, :1] * kinds)
    torch.testing.assert_close(task.torque_scale / task.cfg.control.torque_scale, task.action_scale / 0.25)
    feet = [model.geom(name).id for name in task.foot_names]
    for values in (task.motor_strength, task.p_gains, task.d_gains, task.sim.field("geom_size")[:, feet, 0]):
        assert (values == values[:, :1]).all() and values[:, 0].unique().numel() == 50


def test_kept_values(make_task):
    """In a share of the draws the joints keep their own values, all at once; the rest is always drawn."""
    task = make_task("a1_torque", 1000, **ON, **{"domain_rand.keep_probability": 0.3})
    fields = ("dof_armature", "dof_damping", "dof_frictionloss", "jnt_stiffness")
    own = {name: torch.tensor(getattr(task.sim.mj_model, name), dtype=torch.float32) for name in fields}
    kept = torch.stack([(task.sim.field(name) == own[name]).all(dim=1) for name in fields])
    assert 0.25 < kept[0].float().mean() < 0.35
    assert (kept == kept[0]).all()
    mass = task.sim.mj_model.body_mass[1]
    assert ((task.sim.field("body_mass")[:, 1] - mass).abs() > 1e-5).float().mean() > 0.99
    assert (task.motor_strength != 1.0).float().mean() > 0.99


def test_critic_knows_what_was_drawn(make_task):
    """Its last observations are all drawn numbers, from -1, the lowest one, to 1; without draws, the robot's own."""
    task = make_task("a1_position", 200, **ON, **WIDE)
    sizes = task.randomization.sizes
    values = dict(zip(sizes, task.randomization.values.split([*sizes.values()], dim=1), strict=True))
    lowest, highest = (4.713 - 1.0) * 0.75, (4.713 + 1.0) * 1.25
    trunk = task.sim.mj_model.body_ipos[1]
    for name, number, low, high in (
        ("gravity", task.sim.field("gravity")[:, 2:], -10.11, -9.51),
        ("trunk_mass", task.sim.field("body_mass")[:, 1:2], lowest, highest),
        ("ground_friction", task.sim.field("geom_friction")[:, 0, :1], 0.8, 1.2),
        ("dof_armature", task.sim.field("dof_armature")[:, 6:], 0.008, 0.02),
        ("stiffness", task.p_gains, 17.0 * 0.9 * 0.98, 23.0 * 1.1 * 1.02),
        ("trunk_com", task.sim.field("body_ipos")[:, 1] - torch.tensor(trunk, dtype=torch.float32), -0.003, 0.003),
        ("joint_offset", task.joint_offset, -0.01, 0.01),
    ):
        torch.testing.assert_close(values[name], 2.0 * (number - low) / (high - low) - 1.0, atol=1e-4, rtol=0)
    assert torch.equal(task.get_observations()["critic"][:, -117:], task.randomization.values)
    for fixed, number, low, high in (("stiffness", 1, -88.0, -72.0), ("damping", 0, -1100.0, -900.0)):
        one = make_task("a1_position", 20, **ON, **{"domain_rand.keep_fixed": [f"contact_{fixed}"]})
        place = sum(list(sizes.values())[: list(sizes).index("contact_stiffness")])
        drawn = one.sim.field("geom_solref")[:, 0, number]
        expected = 2.0 * (drawn - low) / (high - low) - 1.0
        torch.testing.assert_close(one.randomization.values[:, place], expected, atol=1e-4, rtol=0)
        assert one.randomization.values.shape[1] == 117 and drawn.std() > 1.0
    plain = make_task("a1_position", 2)
    seen = plain.get_observations()["critic"][0, -117:].split([*sizes.values()])
    values = dict(zip(sizes, seen, strict=True))
    assert values["dof_damping"].tolist() == [-1.0] * 12 and values["joint_offset"].tolist() == [0.0] * 12
    torch.testing.assert_close(values["gravity"], torch.tensor([0.0]), atol=1e-5, rtol=0)


def test_drawn_now_and_then(make_task):
    """Besides resets, each world is drawn anew with the probability of the settings in every step."""
    task = make_task("a1_torque", 200, **ON, **{"domain_rand.resampling_probability": 0.1})
    task.base_pos[:, 2] = 50.0  # no falls
    changes = 0
    for _ in range(20):
        before = task.sim.field("gravity").clone()
        task.step(torch.zeros(200, 12))
        changes += int((task.sim.field("gravity") != before).any(dim=1).sum())
    assert 300 < changes < 500


def test_torques_by_hand(make_task):
    """Motor strength, joint offset, scales and gains act in eq. 8 as written."""
    task = make_task("a1_position", 5, **ON, **WIDE)
    actions = torch.randn(5, 12)
    target = task.default_dof_pos + task.joint_offset + task.action_scale * actions
    expected = task.p_gains * (target - task.dof_pos) - task.d_gains * task.dof_vel
    torch.testing.assert_close(task._compute_torques(actions), expected)
    assert (task.p_gains > 17.0 * 0.88).all() and (task.p_gains < 23.0 * 1.13).all() and task.p_gains.std() > 1.0
    assert (task.d_gains > 0.5 * 0.88).all() and (task.d_gains < 0.5 * 1.13).all()


def test_factors_per_joint(make_task):
    """Strength and gains have a factor for the world times one for each joint, both uniform, no two together."""
    task = make_task("a1_position", 1500, **ON, **{"domain_rand.motor_strength": {"scale_per_joint": [0.98, 1.02]}})
    assert uniformity(task.motor_strength, 0.98, 1.02) < 1.0
    assert (torch.corrcoef(task.motor_strength.T) - torch.eye(12)).abs().max() < 0.15
    ratio = (task.p_gains / task.p_gains[:, :1]).log()  # of two factors per joint
    assert 0.03 < ratio.max() <= math.log(1.02 / 0.98) + 1e-5 and -ratio.min() <= math.log(1.02 / 0.98) + 1e-5
    world = (task.d_gains / 0.5).mean(dim=1)  # 12 joints average their factors to 1 within a percent or so
    assert uniformity(world[world.sub(1.0).abs() < 0.08], 0.92, 1.08) < 1.0


def test_pushes(make_task):
    """A push sets a velocity, times a factor, or adds one, each half the time, uniformly, as often as set."""
    settings = {"push_robots": True, "push_probability": 0.3, "push_velocity": [-2.0, 2.0], "push_set_factor": 1.5}
    task = make_task("a1_torque", 4000, **{f"domain_rand.{key}": value for key, value in settings.items()})
    task.sim.qvel[:, :3] = 10.0
    task.reset_buf.fill_(False)
    task._reset_worlds()
    velocity = task.sim.qvel[:, :3]
    mask = (velocity != 10.0).all(dim=1)
    assert (velocity[~mask] == 10.0).all() and 0.27 < mask.float().mean() < 0.33
    added = velocity[mask][:, 0] > 5.0
    assert 0.44 < added.float().mean() < 0.56
    assert uniformity(torch.where(added.unsqueeze(1), velocity[mask] - 10.0, velocity[mask] / 1.5), -2.0, 2.0) < 1.0


def test_noise(make_task):
    """The policy's sensors err within their limits, uniformly; the critic, commands and actions know no errors."""
    settings = {"noise.add_noise": True}
    task = make_task("a1_position", 2000, **settings)
    clean = task.get_observations()["critic"][:, :45]
    error = task.get_observations()["policy"] - clean
    limits = [0.05] * 3 + [0.1 * 0.25] * 3 + [0.0] * 3 + [0.01] * 12 + [0.5 * 0.05] * 12 + [0.0] * 12
    for i, limit in enumerate(limits):
        if limit == 0.0:
            assert (error[:, i] == 0.0).all()
        else:
            assert uniformity(error[:, i], -limit, limit) < 1.15, i


def test_initial_velocities(make_task):
    """Joints and trunk start with the velocities of the settings."""
    ranges = {"init_dof_vel": [-10.5, 10.5], "init_lin_vel": [-0.5, 0.5], "init_ang_vel": [-0.4, 0.4]}
    task = make_task("a1_torque", 1000, **{f"domain_rand.{key}": value for key, value in ranges.items()})
    assert uniformity(task.dof_vel, -10.5, 10.5) < 1.0
    assert uniformity(task.sim.qvel[:, :3], -0.5, 0.5) < 1.0 and uniformity(task.base_ang_vel, -0.4, 0.4) < 1.0


def test_tensors_that_the_kernel_cannot_write():
    """Numbers of another type are refused at once, a tensor without a row per world when it is drawn."""
    with pytest.raises(UserError, match="'wide' must be float32"):
        Randomization([RandomParameter("wide", torch.zeros(3, 2, dtype=torch.float64), [0], {})], {}.get, 3, "cpu")
    for ranges in ({"scale": [0.8]}, {"scale": 0.8}, {"scale": ["a", 2]}, [1, 2]):
        own = RandomParameter("own", torch.ones(3, 2), [0], ranges)
        assert "random parameter 'own'" in error_of(Randomization, [own], {}.get, 3, "cpu")
    shared = Randomization([RandomParameter("shared", torch.ones(1, 2), [0], {})], {}.get, 3, "cpu")
    with pytest.raises(UserError, match="without a row per world: shared"):
        shared.draw(torch.ones(3, dtype=torch.bool))
