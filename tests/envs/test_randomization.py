"""Random parameters, pushes and sensor errors: each acts as in MuJoCo, and draws follow their definition."""

import copy
import math

import mujoco
import numpy as np
import pytest
import torch
from support.settings import error_of, get_cfgs

from legged_torque.envs.base.legged_robot import LeggedRobot
from legged_torque.paper.randomization_picture import initial_state
from legged_torque.sim.randomization import Randomization, RandomParameter
from legged_torque.utils.config import to_dict
from legged_torque.utils.errors import UserError

RANGES = {
    "trunk_mass": ("body_mass", (-1.0, 1.0)),
    "trunk_com": ("body_ipos", (-0.003, 0.003)),
    "foot_radius": ("geom_size", (0.019, 0.021)),
    "foot_pos": ("geom_pos", (-0.0025, 0.0025)),
    "dof_damping": ("dof_damping", (0.0, 0.2)),
    "dof_armature": ("dof_armature", (0.008, 0.02)),
    "dof_stiffness": ("jnt_stiffness", (0.0, 0.2)),
    "dof_frictionloss": ("dof_frictionloss", (0.0, 0.4)),
    "ground_friction": ("geom_friction", (0.8, 1.2)),
    "contact_stiffness": ("geom_solref", (900.0, 1100.0)),
    "contact_damping": ("geom_solref", (72.0, 88.0)),
    "gravity": ("gravity", (9.51, 10.11)),
}
"""Field and range of the published set ``default``, for each parameter of robot and ground."""
CONTROL = ("motor_strength", "stiffness", "damping", "joint_offset", "action_scale")
WIDE = {
    "domain_rand.trunk_mass": {"add": [-1.0, 1.0], "scale": [0.75, 1.25]},
    "domain_rand.action_scale": {"add": [-0.03, 0.03]},
    "domain_rand.stiffness": {"add": [-3.0, 3.0], "scale": [0.9, 1.1], "scale_per_joint": [0.98, 1.02]},
}
FIELDS = sorted({field for field, _ in RANGES.values()} | {"body_inertia"})
ON = {"domain_rand.randomize_parameters": True}


def only(*names):
    """Settings that randomize these parameters and no others."""
    return ON | {"domain_rand.keep_fixed": [name for name in (*RANGES, *CONTROL) if name not in names]}


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


@pytest.mark.parametrize("name", [*RANGES, "all of them"])
def test_worlds_move_as_their_models(make_task, name):
    """A world with drawn parameters moves as MuJoCo's model with these numbers, and otherwise than without them."""
    ground = {"ground_friction": {"set": [0.3, 2.0]}, "contact_damping": {"set": [30.0, 130.0]}}
    wide = WIDE | {f"domain_rand.{key}": value for key, value in ground.items()}
    settings = ON | wide if name == "all of them" else only(name)
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
        np.testing.assert_allclose(task.sim.qvel[world], data[world].qvel, atol=0.02 if "friction" in name else 3e-3)
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


def test_picture_of_places(make_task):
    """Where robots start on rough ground is drawn from the middles of their tiles."""
    small = {"terrain.num_rows": 2, "terrain.max_init_terrain_level": 1, "terrain.border_size": 1.0}
    task = make_task("a1_rough_position", 40, **small)
    panel = next(panel for panel in initial_state(task) if panel.title == "init place [m]")
    assert panel.values.shape == (40,) and 0.5 < np.abs(panel.values).max() <= 1.0 + 1e-5


def test_distributions(make_task):
    """Draws are uniform in their ranges (Kolmogorov-Smirnov), and no two parameters or worlds go together."""
    task = make_task("a1_position", 1500, **ON, **{"domain_rand.action_scale": {"add": [-0.03, 0.03]}})
    sim, model = task.sim, task.sim.mj_model
    feet = [model.geom(name).id for name in task.foot_names]
    samples = {
        "trunk_mass": sim.field("body_mass")[:, 1] - model.body_mass[1],
        "trunk_com": sim.field("body_ipos")[:, 1, 0] - model.body_ipos[1, 0],
        "foot_radius": sim.field("geom_size")[:, feet[0], 0],
        "foot_pos": sim.field("geom_pos")[:, feet] - torch.tensor(model.geom_pos[feet]),
        "dof_damping": sim.field("dof_damping")[:, 6:],
        "dof_armature": sim.field("dof_armature")[:, 6:],
        "dof_stiffness": sim.field("jnt_stiffness")[:, 1:],
        "dof_frictionloss": sim.field("dof_frictionloss")[:, 6:],
        "ground_friction": sim.field("geom_friction")[:, 0, 0],
        "contact_stiffness": -sim.field("geom_solref")[:, 0, 0],
        "contact_damping": -sim.field("geom_solref")[:, 0, 1],
        "gravity": -sim.field("gravity")[:, 2],
    }
    ranges = {name: RANGES[name][1] for name in samples}
    samples["joint_offset"], ranges["joint_offset"] = task.joint_offset, (-0.01, 0.01)
    samples["action_scale"], ranges["action_scale"] = task.action_scale - 0.25, (-0.03, 0.03)
    for name, values in samples.items():
        assert uniformity(values, *ranges[name]) < 1.0, name
    torch.testing.assert_close(samples["contact_damping"], 72.0 + (samples["contact_stiffness"] - 900.0) * 0.08)
    del samples["contact_damping"]  # which goes with the stiffness
    table = torch.cat([values.double().flatten(1) if values.dim() > 1 else values.double().unsqueeze(1)
                       for values in samples.values()], dim=1)  # fmt: skip
    for correlations in (torch.corrcoef(table.T), torch.corrcoef(((table - table.mean(0)) / table.std(0))[:100])):
        away = correlations - torch.diag(torch.diag(correlations))
        assert away.abs().max() < (0.15 if len(away) == table.shape[1] else 0.65)


def test_what_goes_together(make_task):
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
    """In a share of the draws the joints keep their own values, all at once; all else is drawn always."""
    task = make_task("a1_torque", 1000, **ON, **{"domain_rand.keep_probability": 0.3})
    fields = ("dof_armature", "dof_damping", "dof_frictionloss", "jnt_stiffness")
    kept = torch.stack(
        [
            (task.sim.field(name) == torch.tensor(getattr(task.sim.mj_model, name), dtype=torch.float32)).all(dim=1)
            for name in fields
        ]
    )
    assert 0.25 < kept[0].float().mean() < 0.35
    assert (kept == kept[0]).all()
    own = task.sim.mj_model.body_mass[1]
    assert ((task.sim.field("body_mass")[:, 1] - own).abs() > 1e-5).float().mean() > 0.99
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
    plain = make_task("a1_position", 2)
    seen = plain.get_observations()["critic"][0, -117:].split([*sizes.values()])
    values = dict(zip(sizes, seen, strict=True))
    assert values["dof_damping"].tolist() == [-1.0] * 12 and values["joint_offset"].tolist() == [0.0] * 12
    torch.testing.assert_close(values["gravity"], torch.tensor([0.0]), atol=1e-5, rtol=0)


def test_one_seed_one_draw(make_task):
    """The same seed draws the same parameters, another one others."""
    draws = []
    for seed in (5, 5, 6):
        draws.append(make_task("a1_torque", 4, seed, **ON).sim.field("geom_friction").clone())
    assert torch.equal(draws[0], draws[1]) and not torch.equal(draws[0], draws[2])


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


class ThighMassRobot(LeggedRobot):
    """A variant that draws one number more, or one per thigh."""

    shared = True

    def random_parameters(self):
        """The masses of the thighs as well."""
        thighs = [body for body in range(2, 14) if "thigh" in self.sim.mj_model.body(body).name]
        more = RandomParameter("thigh_mass", "body_mass", thighs, {"scale": [0.5, 0.9]}, shared=self.shared)
        return [*super().random_parameters(), more]


def test_a_variant_draws_more():
    """What a task adds is drawn, acts, is seen by the critic and mirrored, unless its mirror image is not known."""
    cfg = get_cfgs("--set=env.num_envs=20", "--set=domain_rand.randomize_parameters=true")[0]
    task = ThighMassRobot(cfg)
    thighs = task.sim.field("body_mass")[:, [3, 6, 9, 12]]
    ratio = thighs / torch.tensor(task.sim.mj_model.body_mass[[3, 6, 9, 12]], dtype=torch.float32)
    assert (ratio == ratio[:, :1]).all() and ratio.min() > 0.5 and ratio.max() < 0.9 and ratio.std() > 0.05
    check_constants(task.sim)
    scaled = (ratio[:, 0] - 0.7) / 0.2
    torch.testing.assert_close(task.get_observations()["critic"][:, -1], scaled, atol=1e-4, rtol=0)
    assert task.mirror("critic", task.get_observations()["critic"]).shape == (20, 171)
    ThighMassRobot.shared = False
    assert "'thigh_mass'" in error_of(lambda: ThighMassRobot(cfg).mirror)


@pytest.mark.parametrize("task", ["a1_position", "a1_torque_multihead"])
def test_everything_at_once(make_task, task):
    """With all random events on, a task runs, and worlds that fall are drawn anew."""
    cfg = get_cfgs("--perturbation=doubled", task=task)[0]
    settings = {f"domain_rand.{key}": value for key, value in to_dict(cfg.domain_rand).items()}
    settings["domain_rand.resampling_probability"] = 0.05
    world = make_task(task, 16, **settings, **{"noise.add_noise": True})
    masses = world.sim.field("body_mass").clone()
    for _ in range(60):
        obs, rewards, _, _ = world.step(torch.randn(16, world.num_actions))
        assert torch.isfinite(obs["policy"]).all() and torch.isfinite(rewards).all()
    assert not torch.equal(world.sim.field("body_mass"), masses)


def test_what_the_kernel_cannot_write_is_refused():
    """Numbers of another type are refused at once, and worlds that share numbers when they are to be drawn."""
    with pytest.raises(UserError, match="'wide' must be float32"):
        Randomization([RandomParameter("wide", torch.zeros(3, 2, dtype=torch.float64), [0], {})], {}.get, 3, "cpu")
    shared = Randomization([RandomParameter("shared", torch.ones(1, 2), [0], {})], {}.get, 3, "cpu")
    with pytest.raises(UserError, match="without a row per world: shared"):
        shared.draw(torch.ones(3, dtype=torch.bool))
