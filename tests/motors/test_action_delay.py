"""Action delay: what drives the motors at a physics step is what the policy has sent that many steps before."""

import mujoco
import numpy as np
import pytest
import torch
from support.control import CONVERGED, HIGH_UP, NOMINAL, TORQUE_LIMIT, pd_by_hand, time_out
from support.settings import error_of, torques_in_torch

from legged_torque.deploy.export import unknown_parts

EXCEEDED = {1: 10.83, 3: 16.27, 5: 20.52, 15: 37.70, 35: 66.62}
"""The 99.9% quantile of chi-square, by degrees of freedom."""


def delayed(low, high, unit="physics_steps", decimation=4, **more):
    """Settings of a task with a delay."""
    settings = {"motors.delay.range": [low, high], "motors.delay.unit": unit}
    return HIGH_UP | settings | {"control.decimation": decimation} | more


def watch(task, still=False):
    """A list that gets torques and joint states at the start of each physics step; ``still`` leaves out the physics."""
    torques_in_torch(task)
    notes, step = [], task.sim.step

    def noted_step(sense=True):
        notes.append([getattr(task, name).numpy().copy() for name in ("torques", "dof_pos", "dof_vel")])
        if not still:
            step(sense)

    task.sim.step = noted_step
    return notes


def torques_of(notes):
    """Torques of all physics steps. Shape: (steps, worlds, joints)."""
    return np.stack([torques for torques, _, _ in notes])


def send(task, steps, seed=0):
    """Act at random for some control steps, and return what was sent. Shape: (steps, worlds, actions)."""
    sent = np.random.default_rng(seed).uniform(-1, 1, (steps, task.num_envs, task.num_actions)).astype(np.float32)
    for actions in sent:
        task.step(torch.tensor(actions))
    return sent


def arrived(sent, decimation, delay):
    """The action behind each physics step of an episode: at t the one that was sent at t - delay, at first 0."""
    at_physics_step = [actions for actions in sent for _ in range(decimation)]
    nothing = np.zeros_like(sent[0])
    return np.stack([nothing if t < delay else at_physics_step[t - delay] for t in range(len(at_physics_step))])


@pytest.mark.parametrize(("decimation", "delay"), [(4, 0), (4, 1), (4, 9), (3, 4), (2, 9), (1, 3)])
def test_physics_steps(make_task, decimation, delay):
    """The torque at physics step t is 8 N m times the action of physics step t - delay."""
    task = make_task("a1_torque", 3, **delayed(delay, delay, decimation=decimation))
    notes = watch(task)
    sent = send(task, 10)
    assert np.array_equal(torques_of(notes), 8.0 * arrived(sent, decimation, delay))


@pytest.mark.parametrize("refresh", [True, False])
@pytest.mark.parametrize(("decimation", "delay"), [(4, 0), (4, 1), (3, 2)])
def test_control_steps(make_task, decimation, delay, refresh):
    """A delay of control steps is one of as many whole actions, with torques once per control step as well."""
    settings = delayed(delay, delay, "control_steps", decimation, **{"control.refresh_torques": refresh})
    task = make_task("a1_torque", 3, **settings)
    notes = watch(task)
    sent = send(task, 6)
    assert np.array_equal(torques_of(notes), 8.0 * arrived(sent, decimation, decimation * delay))


@pytest.mark.parametrize(
    ("delay", "unit", "refresh"),
    [(5, "physics_steps", True), (1, "physics_steps", True), (2, "control_steps", True), (1, "control_steps", False)],
)
def test_position_control(make_task, delay, unit, refresh):
    """The target is delayed, but joint angles and speeds are those of the physics step that computes the torques."""
    task = make_task("a1_position", 3, **delayed(delay, delay, unit, **{"control.refresh_torques": refresh}))
    notes = watch(task)
    actions = arrived(send(task, 6), 4, delay if unit == "physics_steps" else 4 * delay)
    for t, (torques, _, _) in enumerate(notes):
        _, q, qd = notes[t if refresh else t // 4 * 4]
        expected = np.clip(pd_by_hand(actions[t], q, qd), -33.5, 33.5)
        np.testing.assert_allclose(torques, expected, rtol=1e-4, atol=1e-4)
    assert np.abs(notes[0][1] - notes[3][1]).max() > 0.01  # the joints do move within a control step


def test_policy_knows_what_it_has_sent(make_task):
    """The last action of the observations and the action rate are those of the newest action."""
    task = make_task("a1_torque", 3, **delayed(6, 6, **{"rewards.scales.action_rate": -1.0}))
    rate, before = task.reward_names.index("action_rate"), np.zeros((3, 12))
    for i in range(5):
        sums = task.episode_sums[rate].numpy().copy()
        (action,) = send(task, 1, seed=i)
        seen = task.get_observations()
        assert np.array_equal(seen["policy"][:, 33:45], action) and np.array_equal(seen["critic"][:, 33:45], action)
        gained = task.episode_sums[rate].numpy() - sums
        np.testing.assert_allclose(gained, -0.02 * np.square(action - before).sum(axis=1), rtol=1e-4)
        before = action


@pytest.mark.parametrize("delay", [3, 9])
@pytest.mark.parametrize("how", ["time is over", "not finite", "all at once"])
def test_reset_forgets(make_task, how, delay):
    """A world that starts anew gets no action from before; another one goes on with all that it was sent."""
    task = make_task("a1_torque", 2, **delayed(delay, delay))
    notes = watch(task)
    first = send(task, 4)
    if how == "time is over":
        time_out(task, [0])
    last = np.full((1, 2, 12), 0.5, dtype=np.float32)
    last[:, 0] = np.nan if how == "not finite" else 0.25
    task.step(torch.tensor(last[0]))
    assert task.reset_buf.tolist() == [how != "all at once", False]
    if how == "all at once":
        task.reset()
    then = send(task, 5, seed=1)
    last = np.nan_to_num(last)  # what is not finite is taken for 0
    anew = np.concatenate([arrived(np.concatenate([first, last]), 4, delay), arrived(then, 4, delay)])
    on = arrived(np.concatenate([first, last, then]), 4, delay)
    assert np.array_equal(torques_of(notes)[:, 0], 8.0 * anew[:, 0])
    assert np.array_equal(torques_of(notes)[:, 1], 8.0 * (anew if how == "all at once" else on)[:, 1])


def delays_of(torques, sent):
    """The delay in physics steps of each world: the only one that explains all its torques."""
    fits = np.stack([(torques == 8.0 * arrived(sent, 4, k)).all(axis=(0, 2)) for k in range(len(torques))])
    assert (fits.sum(axis=0) == 1).all()
    return fits.argmax(axis=0)


def chi_square(counts):
    """How far counts are from equal ones, in units of what 1 in 1000 samples exceeds."""
    expected = counts.sum() / counts.size
    return (np.square(counts - expected) / expected).sum() / EXCEEDED[counts.size - 1]


@pytest.mark.parametrize(
    ("low", "high", "unit"), [(0, 3, "physics_steps"), (3, 8, "physics_steps"), (1, 2, "control_steps")]
)
def test_draws(make_task, low, high, unit):
    """Each world has one delay per episode, any whole number of the range as likely, whatever it had before."""
    task = make_task("a1_torque", 2000, **delayed(low, high, unit))
    notes = watch(task, still=True)
    length = 4 if unit == "control_steps" else 1
    old = send(task, 5)
    time_out(task, slice(0, 1500))
    old = np.concatenate([old, send(task, 1, seed=1)])
    new = send(task, 4, seed=2)
    torques = torques_of(notes)
    first = delays_of(torques[:24], old)
    others = delays_of(torques[:, 1500:], np.concatenate([old, new])[:, 1500:])
    assert np.array_equal(others, first[1500:])  # it holds for the whole episode
    second = delays_of(torques[24:, :1500], new[:, :1500])
    possible = [length * steps for steps in range(low, high + 1)]
    assert sorted(set(first)) == sorted(set(second)) == possible
    pairs = np.zeros((len(possible), len(possible)))
    np.add.at(pairs, ((first[:1500] // length) - low, (second // length) - low), 1)
    assert chi_square(np.bincount(first // length)[low:]) < 1.0 and chi_square(pairs) < 1.0


def test_milliseconds(make_task):
    """A range in milliseconds is one in physics steps, which must be whole ones."""
    fast = {"sim.dt": 0.0025}
    task = make_task("a1_torque", 3, **delayed(10, 10, "milliseconds", **fast))
    notes = watch(task)
    sent = send(task, 4)
    assert np.array_equal(torques_of(notes), 8.0 * arrived(sent, 4, 4))
    line = error_of(make_task, "a1_torque", 1, **delayed(0, 7, "milliseconds", **fast))
    assert "motors.delay.range" in line and "2.5 ms" in line


def test_a_delay_outside_the_chain(make_task):
    """A note tells that it has no effect."""
    settings = {"motors.chain": ["ideal"], **delayed(0, 3, "physics_steps")}
    assert make_task("a1_torque", 1, **settings).notes == ["motors.delay has no effect: motors.chain lacks 'delay'"]
    assert make_task("a1_torque", 1, **{**settings, "motors.chain": ["delay", "ideal"]}).notes == []
    for chain in (["delay", "drive"], ["delay", "perturbation"], ["delay"]):
        limitless = make_task("a1_torque", 1, **{"motors.chain": chain})
        assert limitless.notes[0].startswith("no link of motors.chain limits torques")
    assert unknown_parts(limitless, {"actions": {"terms": []}}) == ["no link of motors.chain limits torques"]


def test_a_height_scan_of_a_plane(make_task):
    """A note tells that the policy does not see it."""
    task = make_task("a1_torque", 1, **{"terrain.measure_heights": True})
    assert task.notes == ["terrain.measure_heights has no effect: terrain.mesh_type is plane"]


def test_torques_that_cannot_follow(make_task):
    """Physics steps cannot be counted where torques are computed once per control step, unless there is no delay."""
    once = {"control.refresh_torques": False}
    line = error_of(make_task, "a1_torque", 1, **delayed(0, 3, **once))
    assert "motors.delay.unit" in line and "control.refresh_torques" in line
    make_task("a1_torque", 1, **delayed(0, 0, **once))


LATENCIES = [0, 2, 5, 10]  # [ms]
KP, KD = 60.0, 0.3
"""Gains of a policy that computes PD torques itself: after 5 ms, nothing is left of their damping, Kd - Kp T."""


def calves_in_mujoco(model, latency, damping, steps):
    """Speeds of the calves of a standing A1 that gets PD torques late. Shape: (steps, 4)."""
    data, sent, speeds = mujoco.MjData(model), [np.zeros(12)] * latency, []
    data.qpos[:] = [0, 0, 0.31, 1, 0, 0, 0, *NOMINAL]
    for _ in range(steps):
        sent.append(KP * (NOMINAL - data.qpos[7:]) - KD * data.qvel[6:])
        data.ctrl[:] = np.clip(sent[-1 - latency] - damping * data.qvel[6:], -TORQUE_LIMIT, TORQUE_LIMIT)
        mujoco.mj_step(model, data)
        speeds.append(data.qvel[8::3].copy())
    return np.array(speeds)


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_shaking_and_its_cure(make_task, damping):
    """A PD law sent as torques shakes calves from a latency of Kd / Kp on; damping on the drive, not late, ends it."""
    settings = {"sim.dt": 0.001, "control.decimation": 1, "motors.drive.damping": damping, **CONVERGED}
    late = {"motors.delay.range": [0, 10], "motors.delay.unit": "milliseconds", "terminations.contact": False}
    chain = {"motors.chain": ["delay", "drive", "ideal"]}
    task = make_task("a1_torque", len(LATENCIES), **settings, **late, **chain)
    task.motors.links["delay"].queue.drawn.copy_(torch.tensor(LATENCIES).unsqueeze(1))
    start = torch.tensor([0, 0, 0.31, 1, 0, 0, 0, *NOMINAL])
    task.set_state(start.expand(len(LATENCIES), -1), torch.zeros(len(LATENCIES), 18))
    apart = np.stack([calves_in_mujoco(task.sim.mj_model, latency, damping, 1000) for latency in LATENCIES], axis=1)
    speeds = np.zeros_like(apart)
    for step in range(1000):
        task.step((KP * (task.default_dof_pos - task.dof_pos) - KD * task.dof_vel) / task.cfg.control.torque_scale)
        speeds[step] = task.dof_vel[:, 2::3]
    np.testing.assert_allclose(speeds[:200], apart[:200], atol=0.01)
    shakes = KP * np.array(LATENCIES) / 1000.0 >= KD + damping
    assert shakes.any() == (damping == 0.0)
    for calves in (speeds, apart):
        highest = np.abs(calves[900:]).max(axis=(0, 2))  # [rad/s]
        assert (highest[shakes] > 2.0).all() and (highest[~shakes] < 0.1).all()
