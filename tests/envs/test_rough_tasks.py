"""Tasks on rough ground: their settings, headings, places of starts, the late scan, stumbling."""

import math

import pytest
import torch
from support.settings import COMBINATIONS, TASKS

from legged_torque.envs import task_registry
from legged_torque.utils.config import flat, to_dict

SMALL = {"terrain.num_rows": 2, "terrain.num_cols": 20, "terrain.max_init_terrain_level": 1}
CHANGED = {"terrain.mesh_type", "commands.heading_command", "domain_rand.init_place"}


@pytest.mark.parametrize("name", TASKS + COMBINATIONS)
def test_settings(name):
    """A task on rough ground is that of the plane but for the ground; the second one sees it."""
    rough = name.replace("a1_", "a1_rough_")
    plane, *others = (task_registry.get_cfgs(task) for task in (name, rough, f"{rough}_scan"))
    for (env_cfg, train_cfg), changed in zip(others, (CHANGED, CHANGED | {"terrain.measure_heights"}), strict=True):
        before, after = flat(to_dict(plane[0])), flat(to_dict(env_cfg))
        assert {key for key in after if after[key] != before[key]} == changed
        before, after = flat(to_dict(plane[1])), flat(to_dict(train_cfg))
        differences = {key for key in after if after[key] != before[key]}
        assert differences == {"runner.total_steps", "runner.experiment_name"}
    assert task_registry.get_task_class(rough) is task_registry.get_task_class(name)


def test_headings(make_task):
    """The commanded yaw rate is half the angle that is left, the shorter way, within the range of yaw rates."""
    task = make_task("a1_rough_position", 4, **SMALL, **{"commands.ranges.ang_vel_yaw": [-0.8, 1.0]})
    yaws, headings = [0.5, 3.0, -1.0, 1.5], [1.1, -3.0, -3.1, -1.0]
    expected = [0.3, 0.5 * (2 * math.pi - 6.0), -0.8, -0.8]  # -1.05 and -1.25 are out of range
    qpos = task.sim.qpos.clone()
    qpos[:, 3:7] = torch.tensor([[math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)] for yaw in yaws])
    task.command_generator.headings.copy_(torch.tensor(headings))
    before = task.commands[:, :2].clone()
    task.set_state(qpos, torch.zeros_like(task.sim.qvel))
    torch.testing.assert_close(task.commands[:, 2], torch.tensor(expected), atol=2e-6, rtol=0)
    assert torch.equal(task.commands[:, :2], before)
    place = task.observations.policy_columns("command")[2]
    torch.testing.assert_close(task.obs_buf["policy"][:, place], 0.25 * torch.tensor(expected), atol=2e-6, rtol=0)


def test_a_held_command_has_no_heading(make_task):
    """A command that a user holds is given as it is, and headings are followed again afterwards."""
    task = make_task("a1_rough_position", 3, **SMALL)
    task.command_generator.hold((0.5, -0.2, 0.3))
    task.command_generator.resample(torch.ones(3, dtype=torch.bool))
    for _ in range(2):
        task.step(torch.zeros(3, 12))
        torch.testing.assert_close(task.commands, torch.tensor([[0.5, -0.2, 0.3]] * 3))
    task.command_generator.hold(None)
    task.step(torch.zeros(3, 12))
    assert not (task.commands == torch.tensor([0.5, -0.2, 0.3])).any()


def test_places_of_starts(make_task):
    """Episodes start within a metre of the middle of their tile, along x and y each; on a plane at 0."""
    task = make_task("a1_rough_position", 2000, **SMALL)
    offset = (task.base_pos - task.terrain.origins)[:, :2]
    assert offset.abs().max() <= 1.0
    assert offset.std(dim=0).tolist() == pytest.approx([1 / math.sqrt(3)] * 2, rel=0.06)
    assert abs(torch.corrcoef(offset.T)[0, 1].item()) < 0.1
    torch.testing.assert_close(task.base_pos[:, 2], task.terrain.origins[:, 2] + 0.4)
    assert torch.equal(make_task("a1_position", 4).base_pos[:, :2], torch.zeros(4, 2))


def test_late_scan(make_task):
    """The policy sees the scan of two steps ago, at the start of an episode that of the start; the critic both."""
    changes = {"terrain.measure_delay": 2, "env.episode_length_s": 0.1}  # five steps
    task = make_task("a1_rough_position_scan", 6, **SMALL, **changes)
    columns = task.observations.policy_columns("height_scan")
    sizes = list(task.observations.sizes.items())
    start = sum(size for _, size in sizes[: [name for name, _ in sizes].index("height_scan_now")])
    scale = task.cfg.normalization.obs_scales.height_measurements

    def seen():
        now = task.obs_buf["critic"][:, start : start + 187]
        scan = (task.terrain.height_above(task.sensors["height_scan"].points()) - 0.5).clamp(-1.0, 1.0)
        torch.testing.assert_close(now, scale * scan)
        return task.obs_buf["policy"][:, columns].clone(), now.clone()

    late, now = seen()
    assert torch.equal(late, now)
    history = [now, now, now]
    for _ in range(12):
        task.sim.qvel[:, 0] = 1.0  # so that the scan changes
        task.step(torch.zeros(6, 12))
        late, now = seen()
        new = task.reset_buf.unsqueeze(1)
        history = [now, *(torch.where(new, now, before) for before in history[:2])]
        assert torch.equal(late, history[2])
        assert torch.equal(task.obs_buf["critic"][:, columns], late)
    assert not torch.equal(history[0], history[2])


def test_stumbling(make_task):
    """A foot stumbles if it is pushed sideways with more than five times the force from below."""
    task = make_task("a1_rough_position", 4, **SMALL)
    force = task.sim.contact_force
    force.zero_()
    foot = task.feet_indices[2]
    force[0, foot] = torch.tensor([30.0, 40.0, 9.9])
    force[1, foot] = torch.tensor([30.0, 40.0, 10.1])
    force[2, foot] = torch.tensor([0.0, -51.0, -10.0])
    trunk = next(i for i in range(force.shape[1]) if i not in task.feet_indices)
    force[3, trunk, 0] = 100.0
    assert task._reward_stumble().tolist() == [1.0, 0.0, 1.0, 0.0]
