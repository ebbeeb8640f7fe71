"""Sensors from outside of the package: rays to the ground, in torch and as a kernel, with rate, delay and errors."""

import pytest
import torch
import warp as wp
from support.settings import error_of

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
    """A rate that does not divide, a group that exists, and mirror images that are not known are refused by name."""
    assert "a sensor's rate must divide that of the control steps, 50 Hz, not 30" in error_of(make, rate=30.0)
    assert "'rays' in 'policy' is not known" in error_of(lambda: make().mirror)

    class Taken(RayRobot):
        def observation_terms(self):
            return [*super().observation_terms(), ObservationTerm("more", lambda: self.commands, None, group="critic")]

    assert "the observation group 'critic' of 'more' exists already" in error_of(Taken, RayCfg())
    train_cfg = A1TorqueCfgPPO()
    train_cfg.obs_groups.actor = ["policy", "camera"]
    refused = error_of(lambda: task_registry.make_alg_runner(make(), train_cfg=train_cfg, log_root=None))
    assert refused.startswith("obs_groups: The MLP model only supports 1D observations") and "'camera'" in refused


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
