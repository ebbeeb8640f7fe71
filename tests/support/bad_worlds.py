"""Shared by tests: bad_worlds."""

import math

import pytest
import torch

WORLDS = 3


STEPS = 10


TASK = "a1_torque_curriculum"  # the one with the most reward terms


class Run:
    """Four steps as warm-up, one in which something may be broken, and ten more, under the same random actions."""

    def __init__(self, make_task, break_state=None, break_action=None, **overrides):
        """Run a fresh task.

        Args:
            make_task: The factory.
            break_state: Called with the task before the fifth step.
            break_action: Called with the actions of the fifth step.
            overrides: Settings by dotted path.
        """
        self.task = task = make_task(TASK, WORLDS, seed=3, **overrides)
        generator = torch.Generator().manual_seed(7)
        task.base_pos[:, 2] = 0.3  # on the ground soon, so that warm starts matter
        self.records = []
        for step in range(5 + STEPS):
            actions = torch.randn(WORLDS, 12, generator=generator)
            if step == 4:
                assert task.num_diverged.item() == 0 and task.log.read(1.0)["Health/diverged_worlds"] == 0.0
                if break_state:
                    break_state(task)
                if break_action:
                    break_action(actions)
            obs, rewards, dones, extras = task.step(actions)
            if step >= 4:
                state = torch.cat([task.sim.qpos, task.sim.qvel, task.sim.qacc_warmstart, task.commands], dim=1)
                self.records.append(
                    {
                        "state": state.clone(),
                        "policy": obs["policy"],
                        "critic": obs["critic"],
                        "rewards": rewards.clone(),
                        "dones": dones.clone(),
                        "time_outs": extras["time_outs"].clone(),
                        "episode_length": task.episode_length_buf.clone(),
                        "contacts": task.contacts.clone(),
                        "forces": task.sim.contact_force.clone(),
                        "num_diverged": task.num_diverged.clone().expand(WORLDS),
                    }
                )


def check(run, healthy, broken):
    """Compare a run in which the worlds ``broken`` were broken before the first recorded step with the healthy one."""
    others = [world for world in range(WORLDS) if world not in broken]
    for step, (record, expected) in enumerate(zip(run.records, healthy.records, strict=True)):
        for name, value in record.items():
            assert torch.isfinite(value).all(), (step, name)
            if name != "num_diverged":
                assert torch.equal(value[others], expected[name][others]), (step, name)
        assert (record["num_diverged"] == len(broken)).all(), step
    first = run.records[0]
    for world in broken:
        assert first["dones"][world] and not first["time_outs"][world]
        assert first["rewards"][world] == 0.0 and first["episode_length"][world] == 0
        assert first["state"][world, :3].tolist() == pytest.approx([0.0, 0.0, 0.4])  # a new start, at rest
        assert first["state"][world, 3:7].norm().item() == pytest.approx(1.0, abs=1e-5)
        assert (first["state"][world, 19:55] == 0).all()  # velocities and warm start
        assert run.records[-1]["episode_length"][world] == STEPS  # and no second reset
    log = run.task.log.read(1.0)
    assert log["Health/diverged_worlds"] == len(broken)
    assert all(math.isfinite(value) for value in log.values())
