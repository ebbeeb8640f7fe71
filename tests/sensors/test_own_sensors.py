"""Sensors of a user, and joint encoders and IMU that are late: the policy sees what has arrived."""

import numpy as np
import pytest
import torch
import warp as wp
from support.control import HIGH_UP, NOMINAL, time_out
from support.settings import error_of, torques_in_torch

from legged_torque.envs.approaches.torque import TorqueRobot
from legged_torque.envs.base.observations import ObservationTerm
from legged_torque.envs.tasks import A1TorqueCfg, A1TorqueCfgPPO, task_registry
from legged_torque.sensors.config import SensorCfg
from legged_torque.sensors.sensor import Sensor
from legged_torque.utils.math import quat_rotate_yaw


class DownwardRayCfg(SensorCfg):
    """Settings of rays that point down."""

    places: list[list[float]] = [[0.2, 0.0], [-0.2, 0.0], [0.0, 0.1]]  # [m] along the trunk's heading

    def build(self, state):
        return DownwardRay(self, state)


class DownwardRay(Sensor):
    """Lengths of rays from the trunk's level to the ground [m]."""

    def __init__(self, cfg, state):
        self.places = torch.tensor([[x, y, 0.0] for x, y in cfg.places], device=state.device)
        super().__init__(cfg, state)

    def shape(self):
        return (len(self.places),)

    def measure(self):
        points = quat_rotate_yaw(self.state.base_quat.unsqueeze(1), self.places.unsqueeze(0))
        return self.state.ground.height_above(self.state.base_pos.unsqueeze(1) + points)


class GridCfg(SensorCfg):
    """Settings of an image of distances."""

    def build(self, state):
        return Grid(self, state)


@wp.kernel
def measure_grid(qpos: wp.array2d[float], out: wp.array3d[float]):
    """Write the trunk's height, plus a number for each pixel."""
    world, row, column = wp.tid()
    out[world, row, column] = qpos[world, 2] + 0.1 * float(row) + 0.01 * float(column)


class Grid(Sensor):
    """An image that a kernel of Warp makes."""

    compilable = False

    def __init__(self, cfg, state):
        super().__init__(cfg, state)
        self.image = torch.zeros(state.num_envs, 2, 3, device=state.device)

    def shape(self):
        return (2, 3)

    def measure(self):
        arrays = [wp.from_torch(self.state.qpos), wp.from_torch(self.image)]
        wp.launch(measure_grid, self.image.shape, arrays, device=arrays[0].device)
        return self.image


class RayRobot(TorqueRobot):
    """Sees rays as well, and an image in a group of its own."""

    def observation_terms(self):
        ray, grid = self.sensors["ray"], self.sensors["grid"]
        return [
            *super().observation_terms(),
            ObservationTerm("rays", lambda: ray.values, None, scale=2.0),
            ObservationTerm("image", lambda: grid.values, None, scale=0.5, group="camera"),
        ]


class RayCfg(A1TorqueCfg):
    """An A1 with both sensors."""

    class sensors:
        class ray(DownwardRayCfg):
            pass

        class grid(GridCfg):
            pass


def make(num_envs=4, **changes):
    """A task with these sensors; ``changes`` are settings of the rays."""
    cfg = RayCfg()
    cfg.env.num_envs, cfg.env.episode_length_s = num_envs, 0.3
    for name, value in changes.items():
        setattr(cfg.sensors.ray, name, value)
    torch.manual_seed(0)
    return RayRobot(cfg)


def expected_rays(task):
    """On a plane, all rays are as long as the trunk is high."""
    return task.base_pos[:, 2:].expand(-1, 3)


def test_values_and_groups():
    """Values of this moment are observed, by policy and critic, or as an image in a group of its own."""
    task = make()
    for _ in range(4):
        obs = task.step(torch.randn(4, 12))[0]
        torch.testing.assert_close(obs["policy"][:, -3:], 2.0 * expected_rays(task))
        grid = 0.1 * torch.arange(2.0).view(2, 1) + 0.01 * torch.arange(3.0)
        torch.testing.assert_close(obs["camera"], 0.5 * (task.base_pos[:, 2].view(4, 1, 1) + grid))
    assert obs["camera"].shape == (4, 2, 3)


def test_rate_and_delay():
    """A measurement is new every other step, and two steps late; an episode starts with that of its first moment."""
    task = make(6, rate=25.0, delay=0.04)
    history = [expected_rays(task).clone()] * 3
    held = history[0]
    for step in range(20):
        obs = task.step(torch.randn(6, 12))[0]
        new, now = task.reset_buf.unsqueeze(1), expected_rays(task).clone()
        due = (task.episode_length_buf % 2 == 0).unsqueeze(1) | new
        held = torch.where(due, now, held)
        history = [held, *(torch.where(new, held, before) for before in history[:2])]
        torch.testing.assert_close(obs["policy"][:, -3:], 2.0 * history[2])
        assert step < 15 or not torch.equal(held, now)


def test_errors():
    """Errors are uniform within their limits, where sensors have any."""
    cfg = RayCfg()
    cfg.env.num_envs, cfg.noise.add_noise, cfg.sensors.ray.noise = 2000, True, 0.05
    task = RayRobot(cfg)
    error = task.sensors["ray"].values - expected_rays(task)
    assert 0.049 < error.abs().max() <= 0.05 + 1e-6 and error.mean().abs() < 2e-3
    assert not make(noise=0.05).sensors["ray"].has_noise


def test_state():
    """What a sensor keeps is a part of the worlds' state."""
    task = make(delay=0.1)
    for _ in range(3):
        task.step(torch.randn(4, 12))
    kept = task.sensors["ray"].state_dict()
    assert kept["kept"].shape == (4, 6, 3) and kept["kept"].std() > 0.0


def test_mistakes():
    """Rates that do not divide, half a step, a group that exists and unknown mirror images are refused by name."""
    assert "a sensor's rate must divide that of the control steps, 50 Hz, not 30" in error_of(make, rate=30.0)
    assert "a sensor's delay must be whole control steps of 0.02 s, not 0.03 s" in error_of(make, delay=0.03)
    assert "'rays' in 'policy' is not known" in error_of(lambda: make().mirror)

    class Taken(RayRobot):
        def observation_terms(self):
            return [*super().observation_terms(), ObservationTerm("more", lambda: self.commands, None, group="critic")]

    assert "the observation group 'critic' of 'more' exists already" in error_of(Taken, RayCfg())
    train_cfg = A1TorqueCfgPPO()
    train_cfg.obs_groups.actor = ["policy", "camera"]
    refused = error_of(lambda: task_registry.make_alg_runner(make(), train_cfg=train_cfg, log_root=None))
    assert refused.startswith("obs_groups: The MLP model only supports 1D observations") and "'camera'" in refused


class FlatCfg(SensorCfg):
    """Settings of a sensor with measurements of one shape, which says that they have another."""

    measured: list[int] = [2]

    def build(self, state):
        flat = {"shape": lambda sensor: (3,), "measure": lambda sensor: torch.zeros(self.measured)}
        return type("Flat", (Sensor,), flat)(self, state)


def test_sensors_write_in_place(monkeypatch):
    """The measurements that others read are not bound to another tensor."""
    monkeypatch.setattr(DownwardRay, "measure", lambda sensor: setattr(sensor, "values", sensor.values.clone()))
    cfg = RayCfg()
    cfg.env.num_envs = 2
    assert error_of(RayRobot, cfg).startswith("write values of DownwardRay in place")


@pytest.mark.parametrize(("shape", "delay"), [([2], 0.0), ([2], 0.04), ([2, 1], 0.0), ([2, 2], 0.04)])
def test_other_shapes(shape, delay):
    """A measurement of another shape than the sensor's is refused when the task is built."""
    cfg = RayCfg()
    cfg.env.num_envs, cfg.sensors.flat = 2, FlatCfg()
    cfg.sensors.flat.measured, cfg.sensors.flat.delay = shape, delay
    assert f"must be float32 (2, 3) on cpu, not float32 {tuple(shape)} on cpu" in error_of(RayRobot, cfg)


def test_sections_that_are_no_sensors():
    """They are refused by name, as are sensors that do not exist."""

    class Cfg(A1TorqueCfg):
        class sensors:
            class forgotten:
                rate = 25.0

    message = error_of(TorqueRobot, Cfg())
    assert message == "sensors.forgotten must inherit SensorCfg, as all sections of sensors"
    cfg = RayCfg()
    cfg.env.num_envs, cfg.sensors.none = 2, type("NoneCfg", (SensorCfg,), {"build": lambda self, state: None})()
    assert error_of(RayRobot, cfg) == "sensors.none.build must return a Sensor"
    assert error_of(lambda: make().sensors["gird"]).startswith("unknown sensor 'gird'; did you mean 'grid'?")


def test_a_shape_that_is_a_number(monkeypatch):
    """It is refused by name."""
    monkeypatch.setattr(DownwardRay, "shape", lambda sensor: 3)
    assert error_of(RayRobot, RayCfg()) == "DownwardRay.shape must return a tuple, such as (3,), not 3"


def test_the_name_of_the_height_scan():
    """On rough ground, where it is taken, no other sensor can have it."""
    cfg = task_registry.get_cfgs("a1_rough_torque")[0]
    cfg.env.num_envs, cfg.terrain.num_rows, cfg.terrain.max_init_terrain_level = 2, 1, 0
    cfg.sensors.height_scan = DownwardRayCfg()
    assert "sensors.height_scan has the name of the height scan" in error_of(TorqueRobot, cfg)


@pytest.mark.parametrize("changes", [{}, {"delay": 0.04}])
def test_final_observations(changes):
    """With the option, a step also gives the observations before resets; nothing else changes."""
    plain, task = make(5, **changes), make(5, **changes)
    task.keep_final_observations = True
    ended = 0
    for step in range(40):
        actions = torch.randn(5, 12, generator=torch.Generator().manual_seed(step))
        states = []
        apply = task.events.apply
        task.events.apply = lambda mask, run=apply, kept=states: (kept.append(task.sim.qpos.clone()), run(mask))
        torch.manual_seed(step)
        obs, _, dones, extras = task.step(actions)
        task.events.apply = apply
        torch.manual_seed(step)
        expected, _, _, nothing = plain.step(actions)
        for group in ("policy", "critic", "camera"):
            assert torch.equal(obs[group], expected[group])
        final = extras["final_observations"]
        joints = states[0][:, 7:] - task.default_dof_pos
        torch.testing.assert_close(final["policy"][:, 9:21], joints)
        torch.testing.assert_close(final["policy"][:, 33:45], actions)
        if not changes:
            torch.testing.assert_close(final["policy"][:, -1], 2.0 * states[0][:, 2])
        assert "final_observations" not in nothing
        still = ~dones
        torch.testing.assert_close(final["policy"][still][:, 9:], obs["policy"][still][:, 9:])
        ended += int(dones.sum())
    assert ended > 3


def policy_of(qpos, qvel, action):
    """What a policy sees of measurements: gravity, angular velocity, command, joints, last action."""
    w, x, y, z = qpos[:, 3:7].T
    gravity = -np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    parts = [gravity, 0.25 * qvel[:, 3:6], np.zeros((len(w), 3)), qpos[:, 7:] - NOMINAL, 0.05 * qvel[:, 6:], action]
    return np.concatenate(parts, axis=1)


@pytest.mark.parametrize("in_torch", [False, True], ids=["kernel", "torch"])
@pytest.mark.parametrize(("delay", "decimation"), [(0, 4), (2, 4), (5, 2)])
def test_physics_steps(make_task, in_torch, delay, decimation):
    """The policy sees the state of some physics steps ago, of this episode at most; the critic sees the present."""
    changes = {"sensing.delay.range": [delay, delay], "sensing.delay.jitter": 0, "control.decimation": decimation}
    changes |= {"sensing.delay.loss": 1e-9}  # so that there is a queue without delay, too
    task = make_task("a1_torque", 3, **HIGH_UP, **changes, **{"domain_rand.init_ang_vel": [-2, 2]})
    if in_torch:
        torques_in_torch(task)
    task.commands.zero_()
    task.command_generator.values.zero_()
    now = lambda: (task.sim.qpos.numpy().copy(), task.sim.qvel.numpy().copy())  # noqa: E731
    history, move = [now()], task.sim.step
    task.sim.step = lambda sense: (move(sense), history.append(now()))
    start = np.zeros(3, int)
    for step in range(6):
        if step == 3:
            time_out(task, [0])
        action = torch.randn(3, 12)
        obs, _, dones, _ = task.step(action)
        if dones[0]:
            start[0], history[-1] = len(history) - 1, now()
            action[0] = 0.0
        at = np.maximum(len(history) - 1 - delay, start)
        seen, present = (
            [np.stack([history[t][i][w] for w, t in enumerate(ts)]) for i in (0, 1)] for ts in (at, at * 0 - 1)
        )
        seen, present = policy_of(*seen, action.numpy()), policy_of(*present, action.numpy())
        own = [*range(6), *range(9, 45)]  # without commands
        np.testing.assert_allclose(obs["policy"].numpy()[:, own], seen[:, own], atol=1e-5)
        np.testing.assert_allclose(obs["critic"].numpy()[:, own], present[:, own], atol=1e-5)
        assert delay == 0 or np.abs(seen - present)[1:].max() > 1e-3
    assert start[0] > 0


def test_jitter_and_loss(make_task):
    """Time goes on for the policy but never back; each world has a delay of its own; lost measurements are held."""
    changes = {"sensing.delay.range": [0, 3], "sensing.delay.jitter": 3, "sensing.delay.loss": 0.3}
    task = make_task("a1_torque", 500, **HIGH_UP, **changes, **{"control.decimation": 1})
    queue, clock = task.sensors.sensing.queue, torch.zeros(500)
    assert sorted(set(queue.drawn.floor()[:, 0].tolist())) == [0.0, 1.0, 2.0, 3.0]
    send, seen = queue.send, []
    queue.send = lambda *parts: send(*(torch.full_like(part, len(seen) + 1.0) for part in parts[:2]), parts[2])
    for step in range(1, 40):
        task.step(torch.zeros(500, 12))
        arrived = task.sensors.sensing.dof_vel[:, 0].clone()
        assert (arrived >= clock).all() and (arrived <= step).all()
        clock = arrived
        seen.append(step - arrived)
    ages = torch.stack(seen[10:]).mean(dim=0)
    by_delay = [ages[queue.drawn.floor()[:, 0] == delay].mean() for delay in range(4)]
    np.testing.assert_allclose(np.diff(by_delay), 1.0, atol=0.1)  # a step of constant delay is a step of age
    assert error_of(make_task, "a1_torque", 1, **{"sensing.delay.range": [2, 1]}).startswith("sensing.delay.range")
