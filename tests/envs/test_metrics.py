"""The metrics of walking against loops over written-down steps, and forces against MuJoCo's own contacts."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.control import CONVERGED, WEIGHT, contacts_by_hand, pd_by_hand
from support.settings import torques_in_torch

from legged_torque.envs.base.metrics import CommandBreakdown, WalkingMetrics, measure
from legged_torque.utils.metrics import UNITS, estimate, hide_nan, step_sums

STATE = ("qpos", "qvel", "qacc_warmstart")
RANGES = {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [-2.0, 0.0], "ang_vel_yaw": [0.5, 2.5]}
STILL = {f"domain_rand.init_{angle}": [0.0, 0.0] for angle in ("roll", "pitch", "yaw")}
COPPER = {"hip": 0.3, "joint": 0.1}  # [W/(N m)^2]
COPPER_OF_JOINTS = np.array([0.3, 0.1, 0.1] * 4)
STILL |= {"domain_rand.init_dof_pos_scale": [1.0, 1.0]}


@pytest.fixture(scope="module")
def task(make_task):
    """Worlds whose tensors a test writes; they take no steps."""
    ranges = {f"commands.ranges.{name}": limits for name, limits in RANGES.items()}
    return make_task("a1_position", 5, **ranges, **{"control.copper_loss": COPPER})


def random_steps(count, worlds, geoms, seed=0):
    """Steps of numbers without meaning, with commands of 0, falls and time-outs, as arrays (count, worlds, ...)."""
    rng = np.random.default_rng(seed)

    def normal(*shape, scale=1.0):
        return (scale * rng.normal(size=(count, worlds, *shape))).astype(np.float32)

    commands = normal(3)
    commands[rng.random(commands.shape) < 0.3] = 0.0
    commands[::7, 1] = 0.0
    reset, time_out = rng.random((count, worlds)) < 0.2, rng.random((count, worlds)) < 0.5
    height = np.where(reset, np.nan, 0.3 + normal(scale=0.05))  # resets must not spoil the sums
    force = normal(geoms, 3, scale=20.0) * (rng.random((count, worlds, geoms, 1)) < 0.3)
    steps = {"commands": commands, "lin_vel": normal(3), "ang_vel": normal(3), "torques": normal(12, scale=5.0)}
    steps |= {"joint_vel": normal(12), "height": height, "force": force, "reset": reset, "time_out": reset & time_out}
    return steps


def add(task, metrics, **step):
    """Write a step into the task's tensors, where they are left out as 0, and let the metrics add it."""
    places = {"lin_vel": task.base_lin_vel, "ang_vel": task.base_ang_vel, "torques": task.torques}
    places |= {"joint_vel": task.dof_vel, "height": task.base_pos[:, 2], "force": task.sim.contact_force}
    steps = 4 * task.meter.begin()  # of four physics steps, all alike
    places |= {"reset": task.reset_buf, "time_out": task.time_out_buf}
    for name, place in places.items():
        place.copy_(torch.as_tensor(step.get(name, 0)))
    for add_physics_step in steps:
        add_physics_step()
    metrics.add_step(torch.as_tensor(step["commands"], dtype=torch.float32))


def follow(command, lin_vel, ang_vel):
    """Share of a command that is followed, None if there is none."""
    actual = (lin_vel[0], lin_vel[1], ang_vel[2])
    parts = [1.0 - abs(v - wanted) / abs(wanted) for v, wanted in zip(actual, command, strict=True) if wanted != 0.0]
    return max(0.0, sum(parts) / len(parts)) if parts else None


def sums_by_hand(steps, dt):
    """Numerator and denominator of every metric, one number per world, by a loop over worlds and steps."""
    count, worlds = steps["reset"].shape
    result, peaks = {name: np.zeros((2, worlds)) for name in UNITS}, np.zeros(worlds)
    for t in range(count):
        for w in range(worlds):
            now = {name: values[t, w].astype(float) for name, values in steps.items()}
            force = sum(math.sqrt(f @ f) for f in now["force"])
            peaks[w] = max(peaks[w], force)
            if now["reset"]:
                result["peak_force"][:, w] += peaks[w], 1.0
                peaks[w] = 0.0
                result["falls_per_minute"][0, w] += not now["time_out"]
                continue
            followed = follow(now["commands"], now["lin_vel"], now["ang_vel"])
            if followed is not None:
                result["track_percentage"][:, w] += followed, 1.0
            vx, vy, yaw_rate = now["lin_vel"][0], now["lin_vel"][1], now["ang_vel"][2]
            x, y, yaw = now["commands"]
            speed = math.hypot(vx, vy)
            power = sum(abs(tau * v) for tau, v in zip(now["torques"], now["joint_vel"], strict=True))
            is_first = t == 0 or steps["reset"][t - 1, w]  # of an episode
            change = 0.0 if is_first else np.abs(now["torques"] - steps["torques"][t - 1, w]).mean()
            heat = sum(c * tau**2 for tau, c in zip(now["torques"], COPPER_OF_JOINTS, strict=True))
            result["track_xy"][:, w] += (vx - x) ** 2 + (vy - y) ** 2, 1.0
            result["track_angular"][:, w] += (yaw_rate - yaw) ** 2, 1.0
            result["collision_force"][:, w] += force, 1.0
            result["cost_of_transport"][:, w] += power, WEIGHT * speed
            result["mechanical_power"][:, w] += power, 1.0
            result["electrical_cost"][:, w] += power + heat, WEIGHT * speed
            result["electrical_power"][:, w] += power + heat, 1.0
            result["torque_rate"][:, w] += change, dt
            result["height"][:, w] += now["height"], 1.0
            result["speed"][:, w] += speed, 1.0
            result["falls_per_minute"][1, w] += dt / 60.0
    return result


def error_by_hand(numerator, denominator):
    """Standard error of a ratio of sums by the delta method."""
    ratio, n = sum(numerator) / sum(denominator), len(numerator)
    residuals = [(x - ratio * y) ** 2 for x, y in zip(numerator, denominator, strict=True)]
    return math.sqrt(sum(residuals) / (n - 1)) / (sum(denominator) / n) / math.sqrt(n)


def test_every_metric_of_a_written_trajectory(task):
    """Means and standard errors are those of loops over the same numbers; clearing forgets the steps before."""
    metrics = WalkingMetrics(task)
    add(task, metrics, commands=np.zeros((5, 3)))
    assert math.isnan(metrics.means()["track_percentage"]) and metrics.means()["track_xy"] == 0.0
    steps = random_steps(40, task.num_envs, task.sim.contact_force.shape[1])
    assert steps["time_out"].any() and (steps["reset"] & ~steps["time_out"]).any()
    for seed in (1, 0):
        add(task, metrics, commands=np.zeros((5, 3)), reset=1, torques=math.nan)  # it must not spoil the next one
        metrics.clear()
        steps = random_steps(40, task.num_envs, task.sim.contact_force.shape[1], seed)
        for t in range(40):
            add(task, metrics, **{name: values[t] for name, values in steps.items()})
    means, estimates = metrics.means(), metrics.estimates()
    expected = sums_by_hand(steps, task.dt)
    assert list(means) == list(estimates) == list(UNITS) and task.dt == pytest.approx(0.02)
    for name, (numerator, denominator) in expected.items():
        mean = numerator.sum() / denominator.sum()
        assert means[name] == pytest.approx(mean, rel=2e-5), name
        assert estimates[name].mean == pytest.approx(mean, rel=2e-5), name
        assert estimates[name].standard_error == pytest.approx(error_by_hand(numerator, denominator), rel=2e-4), name
        assert mean > 0.0


def test_tracking_of_headings_by_hand(make_task):
    """A yaw rate that turns to a heading does not count for the percentage, but for its own error."""
    task = make_task("a1_position", num_envs=2, **{"commands.heading_command": True})
    metrics = WalkingMetrics(task)
    commands = [[0.5, 0.0, 0.001], [1.0, 0.5, 0.0]]
    add(task, metrics, commands=commands, lin_vel=[[0.4, 0.3, 0.0], [0.5, 0.5, 0.0]], ang_vel=[[0.0, 0.0, 0.3]] * 2)
    numerator, counted = metrics.ratios()["track_percentage"]
    assert counted.tolist() == [1.0, 1.0] and numerator.tolist() == pytest.approx([0.8, (0.5 + 1.0) / 2])
    assert metrics.means()["track_angular"] == pytest.approx((0.299**2 + 0.3**2) / 2)
    task.cfg.commands.fix([0.0, 0.0, 0.5])  # which turns to no heading
    metrics.clear()
    add(task, metrics, commands=[[0.0, 0.0, 0.5]] * 2, lin_vel=[[0.0] * 3] * 2, ang_vel=[[0.0, 0.0, 0.25]] * 2)
    assert metrics.means()["track_percentage"] == pytest.approx(0.5)


def test_lines_of_results():
    """What was not measured is "-", and one world has no standard error."""
    lines = {"height     nan +- nan m": "height                - m", "height  1.000 +- nan m": "height  1.000 m"}
    lines |= {"peak_force      nan N": "peak_force        - N", "height  1.000 +- 0.100 m": "height  1.000 +- 0.100 m"}
    assert {line: hide_nan(line) for line in lines} == lines


def test_standard_error_by_hand():
    """A ratio of sums with its standard error, which is unknown with one world."""
    result = estimate(np.array([2.0, 0.0, 4.0]), np.array([1.0, 2.0, 3.0]))  # residuals 1, -2, 1
    assert (result.mean, result.standard_error) == pytest.approx((1.0, 0.5), rel=1e-12)
    assert math.isnan(estimate(np.array([3.0, 0.0]), np.array([2.0, 0.0])).standard_error)  # one took part


def test_lying_robots_against_mujoco(make_task):
    """Limp robots that drop on belly, side and back touch with many geoms; forces are those of mj_contactForce."""
    settings = {"control.decimation": 1, "control.stiffness": 0.0, "asset.terminate_after_contacts_on": []}
    task = make_task("a1_position", 3, **STILL, **CONVERGED, **settings)
    sim, model = task.sim, task.sim.mj_model
    task.base_pos[:, 2] = torch.tensor([0.12, 0.12, 0.10])
    task.base_quat.copy_(torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.5**0.5, 0.5**0.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]))
    data, metrics = mujoco.MjData(model), WalkingMetrics(task)
    assert not {"electrical_power", "electrical_cost"} & set(metrics.means()), "without copper losses"
    expected, touching = np.zeros((150, 3)), np.zeros((3, sim.contact_found.shape[1]), bool)
    for t in range(150):
        before = [getattr(sim, name).numpy().copy() for name in STATE]
        task.step(torch.zeros(3, 12))
        metrics.add_step(task.commands)
        for w in range(3):
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = (values[w] for values in before)
            data.ctrl[:] = sim.ctrl[w]
            mujoco.mj_step(model, data)
            found, force = contacts_by_hand(model, data)
            expected[t, w] = np.linalg.norm(force, axis=1).sum()
            touching[w] |= found > 0
    force, steps = metrics.ratios()["collision_force"]
    assert steps.tolist() == [150.0] * 3
    np.testing.assert_allclose(task.meter.peak_force, expected.max(axis=0), rtol=2e-3)
    np.testing.assert_allclose(force / steps, expected.mean(axis=0), rtol=2e-3)
    assert (touching.sum(axis=1) >= 4).all() and touching[:, 0].any()


FRICTION = {"motors.chain": ["delay", "ideal", "friction"], "motors.friction.viscous_friction": 0.3}


@pytest.mark.parametrize(
    ("name", "torques", "motors", "viscous"),
    [
        ("a1_position", pd_by_hand, {}, 0.0),
        ("a1_torque", lambda a, q, qd: 8.0 * a, {}, 0.0),
        ("a1_torque", lambda a, q, qd: 8.0 * a, FRICTION, 0.3),
    ],
)
def test_power_of_all_physics_steps(make_task, name, torques, motors, viscous):
    """Work and heat are those of a plain MuJoCo loop, kernel or torch, and measuring changes no bit of the motion."""
    settings = {**CONVERGED, "control.copper_loss": COPPER, "env.episode_length_s": 1e3, **motors}
    plain, *measured = (make_task(name, 2, **settings) for _ in range(3))
    torques_in_torch(measured[1])
    walking = [WalkingMetrics(task) for task in measured]
    data, rng = mujoco.MjData(plain.sim.mj_model), np.random.default_rng(0)
    expected, last = np.zeros((3, 2)), [None, None]
    for _ in range(12):
        actions, before = rng.normal(size=(2, 12)), [getattr(plain.sim, part).numpy().copy() for part in STATE]
        for task in (plain, *measured):
            task.step(torch.tensor(actions, dtype=torch.float32))
        assert not plain.reset_buf.any()
        for world in range(2):
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = (values[world] for values in before)
            for _ in range(4):
                made = np.clip(torques(actions[world], data.qpos[7:], data.qvel[6:]), -33.5, 33.5)
                data.ctrl[:] = made - viscous * data.qvel[6:]
                mujoco.mj_step(plain.sim.mj_model, data)
                change = 0.0 if last[world] is None else np.abs(made - last[world]).mean()
                expected[:, world] += np.abs(made * data.qvel[6:]).sum() / 4, COPPER_OF_JOINTS @ made**2 / 4, change
                last[world] = made
        assert all(torch.equal(getattr(plain.sim, part), getattr(measured[0].sim, part)) for part in STATE)
        for part in STATE:
            getattr(measured[1].sim, part).copy_(getattr(plain.sim, part))  # rounding errors do not add up
        for each in walking:
            each.add_step(plain.commands)
    for each in walking:
        ratios = each.ratios()
        names = ("mechanical_power", "electrical_power", "torque_rate")
        work, total, change = (ratios[name][0].numpy() for name in names)
        np.testing.assert_allclose([work, total - work, change], expected, rtol=2e-3)


def test_breakdown_by_hand(task):
    """Shares, tracking and errors of each part of each command's range; resets and empty parts are left out."""
    breakdown = CommandBreakdown(task)
    zeros = np.zeros(5)
    commands = np.array([[-1.0, -1.9, 0.6], [-0.6, -0.1, 2.5], [0.1, -0.1, 0.6], [1.0, 0.0, 2.4], [0.3, -1.2, 1.2]])
    speeds = np.array([[-0.5, -1.9, 0.6], [-0.6, -0.2, 1.5], [0.1, -0.1, 0.3], [0.0, 1.0, 2.4], [9.0, 9.0, 9.0]])
    step = {"commands": commands, "lin_vel": np.c_[speeds[:, :2], zeros], "ang_vel": np.c_[zeros, zeros, speeds[:, 2]]}
    add(task, breakdown, **step, reset=np.arange(5) == 4)
    add(task, breakdown, **step, reset=np.arange(5) >= 2)
    # followed: (0.5 + 1 + 1) / 3, (1 + 0 + 0.6) / 3, (1 + 1 + 0.5) / 3 once, (0 + 1) / 2 once
    a, b, c, d = 2.5 / 3, 1.6 / 3, 2.5 / 3, 0.5
    x = [(-1.0, -0.5, 4 / 6, (a + b) / 2, 0.25), (0.0, 0.5, 1 / 6, c, 0.0), (0.5, 1.0, 1 / 6, d, 1.0)]
    y = [(-2.0, -1.5, 2 / 6, a, 0.0), (-0.5, 0.0, 4 / 6, (2 * b + c + d) / 4, 1.2 / 4)]
    yaw = [(0.5, 1.0, 3 / 6, (2 * a + c) / 3, 0.3 / 3), (2.0, 2.5, 3 / 6, (2 * b + d) / 3, 2.0 / 3)]
    expected = {"lin_vel_x": x, "lin_vel_y": y, "ang_vel_yaw": yaw}
    table = breakdown.table()
    assert list(table) == list(expected)
    for name, parts in table.items():
        columns = [[part[key] for key in ("from", "to", "share", "track_percentage", "error")] for part in parts]
        assert np.array(columns) == pytest.approx(np.array(expected[name]), abs=1e-6)
        assert sum(part["share"] for part in parts) == pytest.approx(1.0, abs=1e-9)
    # two worlds are in the first part of x for two steps each: their errors of 1.0 and 0.0 in all differ by 0.5 from
    # the 2 x 0.25 of the mean; one is in each of the others
    errors = [part["error_standard_error"] for part in table["lin_vel_x"]]
    assert errors == pytest.approx([np.sqrt(2 * 0.5**2 * 2 / 1) / 4, np.nan, np.nan], nan_ok=True)


def test_robots_that_stand_are_in_no_part(make_task):
    """Parts of a range without 0 have only those that walk, as shares of all; a fixed command is its own range."""
    task = make_task("a1_torque", 100, **{"commands.ranges.lin_vel_x": [0.5, 1.0], "commands.standing_share": 0.5})
    breakdown, commands = CommandBreakdown(task), task.commands.clone()
    task.step(torch.zeros(100, 12))
    breakdown.add_step(commands)
    counted = commands[~task.reset_buf, 0].numpy()
    parts = np.histogram(counted, np.linspace(0.5, 1.0, 5))[0]
    assert 0.2 < parts.sum() / len(counted) < 0.8 and parts.all()
    shares = [part["share"] for part in breakdown.table()["lin_vel_x"]]
    assert shares == pytest.approx((parts / len(counted)).tolist())
    fixed = make_task("a1_torque", 2, **{"commands.fixed": [2.0, 0.0, 0.0]})
    add(fixed, held := CommandBreakdown(fixed), commands=[[2.0, 0.0, 0.0]] * 2)
    assert [(part["from"], part["to"], part["share"]) for part in held.table()["lin_vel_x"]] == [(2.0, 2.0, 1.0)]


def test_measure_uses_the_commands_of_the_step(make_task):
    """A step is compared with the command that held in it, although its end draws a new one; episodes begin anew."""
    task = make_task("a1_position", 3, **{"commands.resampling_probability": 1.0})
    task.episode_length_buf = torch.full((3,), 500)
    held, seen, velocity, step = [], [], [], task.step

    def noted_step(actions):
        held.append(task.commands.clone())
        result = step(actions)
        velocity.append(task.base_lin_vel[:, :2].clone())
        return result

    task.step = noted_step
    means = measure(task, lambda obs: torch.zeros(3, 12), 6, seen.append).means()
    assert len(seen) == 6 and all(torch.equal(*pair) for pair in zip(held, seen, strict=True))
    assert not torch.equal(held[0], held[1]) and task.episode_length_buf.tolist() == [6] * 3
    errors = [((a[:, :2] - b) ** 2).sum(dim=1).mean() for a, b in zip(held, velocity, strict=True)]
    assert means["track_xy"] == pytest.approx(float(torch.stack(errors).mean()), rel=1e-5)


def test_arrays_and_tensors_give_the_same():
    """One robot after another in numpy is counted as a batch of worlds in torch, commands of 0 and falls included."""
    generator = torch.Generator().manual_seed(5)
    commands, velocity = (torch.randn(50, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    commands[:10, 1], commands[10:20] = 0.0, 0.0
    *parts, peak = [torch.rand(50, generator=generator, dtype=torch.float64) for _ in range(7)]
    ended = torch.arange(50) % 7 == 0
    fell = ended & (torch.arange(50) % 2 == 0)
    batch = step_sums(torch, commands, velocity, *parts, fell, ended, peak).numpy()
    for world in range(50):
        rows = (tensor[world : world + 1].numpy() for tensor in (commands, velocity, *parts, fell, ended, peak))
        np.testing.assert_allclose(step_sums(np, *rows)[:, 0], batch[:, world], rtol=1e-12)
