"""Numbers that are not finite end the episode of their world, change no bit of other worlds, and are reported."""

import math

import pytest
import torch

TASK = "a1_torque_curriculum"  # the one with the most reward terms
WORLDS, STEPS = 3, 10
RANDOM = {"domain_rand.randomize_parameters": True}
FIXED = {"domain_rand.randomize_parameters": False}
HISTORY = {"env.history_length": 3, "motors.delay.range": [1, 6], "sensing.delay.range": [1, 6]}
BUFFERS = {
    "stiffness": lambda task: task.p_gains,
    "damping": lambda task: task.d_gains,
    "motor_strength": lambda task: task.motor_strength,
    "joint_offset": lambda task: task.joint_offset,
    "torque_scale": lambda task: task.torque_scale,
    "random_parameters": lambda task: task.randomization.values,
    "commands": lambda task: task.commands,
    "feet_air_time": lambda task: task.feet_air_time,
    "last_actions": lambda task: task.last_actions,
    "last_dof_vel": lambda task: task.last_dof_vel,
    "episode_return": lambda task: task.episode_return.unsqueeze(1),
    "episode_sums": lambda task: task.episode_sums.T,
}
DRAWN_BUFFERS = {
    "body_mass": lambda task: task.sim.fields["body_mass"],
    "geom_solref": lambda task: task.sim.fields["geom_solref"].flatten(1),
    "gravity": lambda task: task.sim.fields["gravity"],
}
DELAYED_BUFFERS = {
    "delay.drawn": lambda task: task.motors.links["delay"].queue.drawn,
    "delay.before": lambda task: task.motors.links["delay"].queue.before[:, 0],
    "sensing.before": lambda task: task.sensors.sensing.queue.before[:, 0],
    "observation_history": lambda task: task.obs_buf["policy"][:, -1:],
}


class Run:
    """Four steps as warm-up, one in which something may be broken, and ten more, under the same random actions."""

    def __init__(self, make_task, break_state=None, break_action=None, **overrides):
        """Run a new task; the functions get the task or the actions before the fifth step."""
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
                record = {"state": state, "rewards": rewards, "dones": dones, "time_outs": extras["time_outs"], **obs}
                record |= {"episode_length": task.episode_length_buf, "contacts": task.contacts}
                record |= {"forces": task.sim.contact_force, "num_diverged": task.num_diverged.expand(WORLDS)}
                self.records.append({name: value.clone() for name, value in record.items()})


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


@pytest.fixture(scope="module")
def healthy(make_task):
    """The runs in which nothing is broken, by their settings."""
    return [(overrides, Run(make_task, **overrides)) for overrides in (FIXED, RANDOM, HISTORY)]


def reported(task):
    """Names of the tensors that the task reports as not finite, each with its number of worlds."""
    return {str(tensor): count for tensor, count in task.health.read()[1].items()}


CASES = [(0, name, buffer, math.inf) for name, buffer in BUFFERS.items()]
CASES += [(1, name, buffer, math.nan) for name, buffer in {**BUFFERS, **DRAWN_BUFFERS}.items()]
CASES += [(2, name, buffer, math.nan) for name, buffer in DELAYED_BUFFERS.items()]


@pytest.mark.parametrize(("settings", "name", "buffer", "value"), CASES)
def test_bad_buffer(make_task, healthy, settings, name, buffer, value):
    """The world starts anew, drawn or not drawn, with history and delay or without, and the buffer is reported once."""
    overrides, expected = healthy[settings]

    def break_state(task):
        buffer(task)[1, -1] = value

    run = Run(make_task, break_state=break_state, **overrides)
    check(run, expected, [1])
    assert torch.isfinite(buffer(run.task)).all()
    assert reported(run.task) == {f"buffer '{name}'": 1}
    if overrides == FIXED:
        assert torch.equal(run.task.p_gains[1], run.task.p_gains[0])
        assert (run.task.motor_strength == 1.0).all() and (run.task.joint_offset == 0.0).all()


@pytest.mark.parametrize("field", ["qpos", "qvel", "qacc_warmstart"])
@pytest.mark.parametrize("value", [math.nan, 1e30])
def test_bad_state(make_task, healthy, field, value):
    """One bad number in the state ends the episode of its world, and no buffer is reported for it."""

    def break_state(task):
        getattr(task.sim, field)[1, 9] = value

    run = Run(make_task, break_state=break_state)
    check(run, healthy[0][1], [1])
    assert reported(run.task) == {}


def test_all_worlds_bad(make_task, healthy):
    """With every world broken in its own way, all start anew."""
    contacts = torch.stack([record["contacts"] for record in healthy[0][1].records])
    assert contacts.any(dim=0).any(dim=1).all()  # in the healthy run all worlds touch the ground

    def break_state(task):
        task.sim.qpos[0] = math.nan
        task.sim.qvel[1] = math.inf
        task.sim.qacc_warmstart[2] = -1e30

    check(Run(make_task, break_state=break_state), healthy[0][1], [0, 1, 2])


@pytest.mark.parametrize("value", [math.nan, -math.inf, 1e30])
def test_bad_action(make_task, healthy, value):
    """An action that is not finite resets its world and is reported; a huge finite one is only clipped."""

    def break_action(actions):
        actions[1, 4] = value

    run = Run(make_task, break_action=break_action)
    if math.isfinite(value):
        assert run.task.num_diverged.item() == 0 and reported(run.task) == {}
        assert all(torch.isfinite(value).all() for record in run.records for value in record.values())
    else:
        check(run, healthy[0][1], [1])
        assert reported(run.task) == {"buffer 'actions'": 1}


def test_divergence_during_the_physics(make_task):
    """A state of possible numbers that explodes within the step is found at its end."""
    task = make_task(TASK, WORLDS)
    task.sim.qvel[1, 3:6] = 9e3  # each number is below the limit of a valid state
    task.sim.qvel[1, 6:] = -9e3
    obs, rewards, dones, _ = task.step(torch.zeros(WORLDS, 12))
    assert dones.tolist() == [False, True, False] and task.num_diverged.item() == 1
    assert torch.isfinite(obs["critic"]).all() and torch.isfinite(rewards).all() and rewards[1] == 0.0
    assert torch.isfinite(task.sim.qpos).all() and (task.sim.qvel[1] == 0).all()
