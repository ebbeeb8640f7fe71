"""Actions, their torques and the physics steps in which they act."""

import mujoco
import numpy as np
import pytest
import torch
from support.control import CONVERGED, IN_THE_AIR, NOMINAL, TORQUE_LIMIT, pd_by_hand, random_state, time_out
from support.settings import error_of


def theta_by_hand(total_steps, end):
    """PD weight of eq. 7: from 1 to ``end`` over 50e6 steps, at the last multiple of 64k steps."""
    done = total_steps // 64_000 * 64_000
    return 1.0 + (end - 1.0) * min(done / 50e6, 1.0)


@pytest.mark.parametrize(("kp", "kd", "scale"), [(20.0, 0.5, 0.25), (35.0, 1.5, 0.5)])
def test_position_torques(make_task, kp, kd, scale):
    """Position control is eq. 8 with the gains and the scale of the settings, which are 20, 0.5 and 0.25."""
    changed = {"control.stiffness": kp, "control.damping": kd, "control.action_scale": scale}
    task = make_task("a1_position", 3, **({} if kp == 20.0 else changed))
    q, qd, action = random_state(task)
    torques = task._compute_torques(torch.tensor(action).float())
    np.testing.assert_allclose(torques, pd_by_hand(action, q, qd, kp, kd, scale), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["a1_torque", "a1_torque_curriculum"])
def test_torque_torques(make_task, name):
    """Torque control is 8 N m per unit of action, 4 N m in the curriculum, in any state."""
    task, torque_scale = make_task(name, 3), 4.0 if name == "a1_torque_curriculum" else 8.0
    _, _, action = random_state(task)
    np.testing.assert_allclose(task._compute_torques(torch.tensor(action).float()), torque_scale * action, rtol=1e-5)


@pytest.mark.parametrize("group", ["leg", "joint"])
def test_variable_stiffness_torques(make_task, group):
    """Kp is 20 and 5 per unit of action, the leg's mean or the joint's own, from 10 to 60; Kd is 0.2 sqrt(Kp)."""
    settings = {"control.stiffness_of": group, "control.decimation": 1}
    task = make_task("a1_variable_stiffness", 3, **settings, **IN_THE_AIR)
    q, qd, action = random_state(task)
    change = 4.0 * action[:, 12:]
    action[:, 12:] = change
    if group == "leg":
        change = change.reshape(3, 4, 3).mean(axis=2).repeat(3, axis=1)
    kp = np.clip(20.0 + 5.0 * change, 10.0, 60.0)
    assert kp.min() == 10.0 and kp.max() > 25.0
    expected = kp * (NOMINAL + 0.25 * action[:, :12] - q) - 0.2 * np.sqrt(kp) * qd
    np.testing.assert_allclose(task._compute_torques(torch.tensor(action).float()), expected, rtol=1e-4, atol=1e-4)
    if group == "leg":  # in the physics kernel, too
        task.step(torch.tensor(action).float())
        np.testing.assert_allclose(task.torques, np.clip(expected, -TORQUE_LIMIT, TORQUE_LIMIT), rtol=1e-4, atol=1e-4)
        assert not task.notes
    hips, others = list(range(0, 12, 3)), [i for i in range(12) if i % 3]
    image = task.mirror("actions", torch.ones(1, 24))[0].numpy()
    assert (image[hips] == -1.0).all() and (image[others] == 1.0).all() and (image[12:] == 1.0).all()
    np.testing.assert_array_equal(task.mirror("policy", torch.ones(1, 57))[0, 33:], image)  # as last action


def test_decaying_bias(make_task):
    """To 8 N m per unit of action comes PD towards the reference, which 0.99 multiplies every 409,600 steps."""
    task = make_task("a1_decap", 3)
    q, qd, action = random_state(task)
    reference = NOMINAL + 0.1 * np.arange(12)
    task.reference.copy_(torch.tensor(reference))
    for total_steps in (0, 40_960_000):
        task.total_steps.fill_(total_steps)
        task.update_curriculum()
        bias = 0.99 ** (total_steps / 409_600)
        assert float(task.curriculum_values()["bias"]) == pytest.approx(bias, rel=1e-5)
        expected = 8.0 * action + bias * (20.0 * (reference - q) - 0.5 * qd)
        torques = task._compute_torques(torch.tensor(action).float())
        np.testing.assert_allclose(torques, expected, rtol=1e-4, atol=1e-4)
    imitated = np.exp(-10.0 * np.square(q - reference).sum(axis=1))
    np.testing.assert_allclose(task._reward_imitation_angles(), imitated, rtol=1e-3, atol=1e-12)


def test_record(make_task, tmp_path):
    """Bias and imitation follow the rows of a file from each episode's start, for 20 ms each, again and again."""
    task = make_task("a1_decap", 3)
    rows = NOMINAL + np.random.default_rng(0).uniform(-0.2, 0.2, (3, 12))
    header = ",".join(task.dof_names[::-1])
    np.savetxt(tmp_path / "walk.csv", rows[:, ::-1], delimiter=",", header=header, comments="")
    settings = {"control.decap.record": str(tmp_path / "walk.csv"), **IN_THE_AIR}
    once = {"control.decimation": 1, "control.refresh_torques": False}
    for changes, per_row in [({"control.refresh_torques": False}, 1), (once, 4)]:
        task, count = make_task("a1_decap", 3, **settings, **changes), np.zeros(3, int)
        for step in range(9):
            if step == 5:
                time_out(task, [1])
            reference, q, qd = rows[count // per_row % 3], task.dof_pos.numpy().copy(), task.dof_vel.numpy().copy()
            task.step(torch.full((3, 12), 0.5))
            kept = ~task.reset_buf.numpy()
            assert kept.tolist() == [True, step != 5, True]
            torques = 4.0 + 20.0 * (reference - q) - 0.5 * qd
            np.testing.assert_allclose(task.torques[kept], torques[kept], rtol=1e-4, atol=1e-4)
            imitated = np.exp(-10.0 * np.square(task.dof_pos.numpy() - reference).sum(axis=1))
            np.testing.assert_allclose(task._reward_imitation_angles()[kept], imitated[kept], rtol=1e-3, atol=1e-6)
            count = np.where(kept, count + 1, 0)
    joint = next(name for name in task.dof_names if f"'{name}'" in error_of(lambda: task.mirror))
    assert joint.startswith(("FR", "RR"))  # it has no mirror image, as this record has none


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda lines: None, ["cannot read", "walk.csv"]),
        (
            lambda lines: [lines[0].replace("FR_hip_joint", "FR_hips_joint"), *lines[1:]],
            ["did you mean 'FR_hip_joint'"],
        ),
        (lambda lines: [line.partition(",")[2] for line in lines], ["each of these joints once", "FR_hip_joint"]),
        (lambda lines: [*lines, "0.1,0.2"], ["not a table"]),
        (lambda lines: [*lines, lines[1].replace("0.5", "exit()")], ["not a table", "exit()"]),
        (lambda lines: [*lines, lines[1].replace("0.5", "nan")], ["finite"]),
        (lambda lines: lines[:1], ["rows"]),
        (lambda lines: [], ["not a table"]),
    ],
)
def test_bad_records(make_task, tmp_path, change, words):
    """A file that is no table of numbers, or has other joints, is refused in one line."""
    lines = change([",".join(make_task("a1_position", 1).dof_names), ",".join(["0.5"] * 12)])
    if lines is not None:
        (tmp_path / "walk.csv").write_text("\n".join(lines))
    line = error_of(make_task, "a1_decap", 1, **{"control.decap.record": str(tmp_path / "walk.csv")})
    assert all(word in line for word in ["walk.csv", *words])


@pytest.mark.parametrize("total_steps", [0, 25_000_000, 50_000_000, 60_000_000])
@pytest.mark.parametrize(
    ("name", "end"), [("a1_torque_multihead", 0.0), ("a1_multihead", 0.1), ("a1_torque_curriculum_multihead", 0.0)]
)
def test_multi_head_torques(make_task, name, end, total_steps):
    """Multi-head control is eq. 7: the PD part of the first 12 actions by its weight, plus the whole torque part."""
    task = make_task(name, 3)
    task.total_steps.fill_(total_steps)
    task.update_curriculum()
    q, qd, action = random_state(task)
    expected = theta_by_hand(total_steps, end) * pd_by_hand(action[:, :12], q, qd) + 4.0 * action[:, 12:]
    torques = task._compute_torques(torch.tensor(action).float())
    np.testing.assert_allclose(torques, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["a1_position", "a1_multihead"])
def test_torques_are_clipped(make_task, name):
    """No joint gets more than 33.5 N m, and extreme actions give exactly that."""
    task = make_task(name, 2)
    signs = torch.tensor([1.0, -1.0]).repeat(2, task.num_actions // 2)
    signs[1] *= -1
    task.step(1e4 * signs)
    np.testing.assert_array_equal(task.torques, TORQUE_LIMIT * signs[:, :12])
    np.testing.assert_array_equal(task.sim.ctrl.numpy(), TORQUE_LIMIT * signs[:, :12])


@pytest.mark.parametrize(("name", "refresh"), [("a1_position", True), ("a1_position", False), ("a1_multihead", True)])
def test_step_is_four_physics_steps(make_task, name, refresh):
    """A step is plain MuJoCo's under PD torques of each physics step, or without refresh_torques of the first one."""
    task = make_task(name, 2, **IN_THE_AIR, **CONVERGED, **{"control.refresh_torques": refresh})
    random_state(task)
    action = np.random.default_rng(1).normal(size=(2, task.num_actions))
    start = task.sim.qpos.numpy().copy(), task.sim.qvel.numpy().copy()
    task.step(torch.tensor(action).float())
    model = task.sim.mj_model
    for world in range(2):
        results = {}
        for fresh in (True, False):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = start[0][world], start[1][world]
            for i in range(4):
                if fresh or i == 0:
                    torque = pd_by_hand(action[world, :12], data.qpos[7:], data.qvel[6:])
                    if name == "a1_multihead":
                        torque = torque + 4.0 * action[world, 12:]
                    torque = np.clip(torque, -TORQUE_LIMIT, TORQUE_LIMIT)
                data.ctrl[:] = torque
                mujoco.mj_step(model, data)
            results[fresh] = np.concatenate([data.qpos, 0.01 * data.qvel]), torque
        state = torch.cat([task.sim.qpos[world], 0.01 * task.sim.qvel[world]])
        np.testing.assert_allclose(state, results[refresh][0], atol=2e-4)
        np.testing.assert_allclose(task.torques[world], results[refresh][1], atol=2e-2)
        assert np.abs(results[True][0] - results[False][0]).max() > 2e-2  # the two differ


def test_contacts_are_those_of_the_last_physics_step(make_task):
    """Falling robots whose feet touch at different physics steps: after a step, flags are as MuJoCo's last contacts."""
    task = make_task("a1_torque", 8, **CONVERGED)
    model = task.sim.mj_model
    data = mujoco.MjData(model)
    start = np.concatenate([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], NOMINAL])
    touched = np.zeros((4, 8), dtype=bool)
    heights = 0.302 + 0.003 * np.arange(8)
    for world, height in enumerate(heights):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = start, 0.0, 0.0
        data.qpos[2], data.qvel[2] = height, -1.0
        for i in range(4):
            mujoco.mj_step(model, data)
            touched[i, world] = data.ncon > 0
    assert len({tuple(row) for row in touched}) == 4 and not touched[3].all()
    task.sim.qpos[:] = torch.tensor(start)
    task.base_pos[:, 2] = torch.tensor(heights)
    task.sim.qvel[:, 2] = -1.0
    task.step(torch.zeros(8, 12))
    np.testing.assert_array_equal(task.feet_contact.any(dim=1), touched[3])


@pytest.mark.parametrize(("dt", "decimation", "length"), [(0.005, 1, 4000), (0.005, 4, 1000), (0.002, 5, 2000)])
def test_decimation(make_task, dt, decimation, length):
    """Physics step and number of physics steps per control step set Delta t, episode length and free fall."""
    task = make_task("a1_torque", 2, **IN_THE_AIR, **{"sim.dt": dt, "control.decimation": decimation})
    assert task.dt == pytest.approx(dt * decimation) and task.max_episode_length == length
    task.step(torch.zeros(2, 12))
    # Without torques nothing but gravity acts, and friction holds the joints: semi-implicit Euler of a falling body.
    np.testing.assert_allclose(task.sim.qvel[:, 2], -9.81 * dt * decimation, rtol=1e-3)
    fallen = 9.81 * dt**2 * decimation * (decimation + 1) / 2
    np.testing.assert_allclose(2.0 - task.base_pos[:, 2], fallen, rtol=0.02)
