"""Actions and their torques, observations, commands, episodes and initial states of the tasks."""

import math

import mujoco
import numpy as np
import pytest
import torch

JOINTS = [f"{leg}_{link}" for leg in ("FR", "FL", "RR", "RL") for link in ("hip", "thigh", "calf")]
NOMINAL = np.array([-0.1, 0.8, -1.5, 0.1, 0.8, -1.5, -0.1, 1.0, -1.5, 0.1, 1.0, -1.5])
RANGE = {"hip": (-0.802851, 0.802851), "thigh": (-1.0472, 4.18879), "calf": (-2.69653, -0.916298)}
LOW, HIGH = np.array([RANGE[name[3:]] for name in JOINTS]).T
TORQUE_LIMIT = 33.5
FEET = [4, 8, 12, 16]
"""Columns of the feet in the contact buffers: after the trunk, each leg has hip, thigh, calf, foot."""
POSITION_TASKS, TORQUE_TASKS = ["a1_position"], ["a1_torque", "a1_torque_curriculum"]
MULTI_HEAD_TASKS = ["a1_torque_multihead", "a1_multihead"]
IN_THE_AIR = {"init_state.pos": [0.0, 0.0, 2.0]}
CONVERGED = {"sim.solver_iterations": 100, "sim.ls_iterations": 50}
KEEP_COMMANDS = {"commands.resampling_probability": 0.0}


def pd_by_hand(action, q, qd, kp=20.0, kd=0.5, scale=0.25):
    """Eq. 8 in numpy."""
    return kp * (NOMINAL + scale * action - q) - kd * qd


def theta_by_hand(total_steps, end):
    """PD weight of eq. 7: from 1 to ``end`` over 50e6 steps, at the last multiple of 64k steps."""
    done = total_steps // 64_000 * 64_000
    return 1.0 + (end - 1.0) * min(done / 50e6, 1.0)


def random_state(task, seed=0):
    """Put joints into random angles and speeds; return them with random actions, in double precision."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(LOW, HIGH, (task.num_envs, 12))
    qd = rng.uniform(-5, 5, q.shape)
    action = rng.normal(size=(task.num_envs, task.num_actions))
    task.dof_pos.copy_(torch.tensor(q))
    task.dof_vel.copy_(torch.tensor(qd))
    return q, qd, action


def euler_by_hand(quat):
    """Roll, pitch and yaw (about fixed x, y, z, in this order) from MuJoCo's rotation matrix of a quaternion."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, dtype=float))
    r = matrix.reshape(3, 3)
    return math.atan2(r[2, 1], r[2, 2]), -math.asin(r[2, 0]), math.atan2(r[1, 0], r[0, 0])


# --------------------------------------------------------------------------------------------------- torques


@pytest.mark.parametrize(("kp", "kd", "scale"), [(20.0, 0.5, 0.25), (35.0, 1.5, 0.5)])
def test_position_torques(make_task, kp, kd, scale):
    """Position control is eq. 8 with the gains and the scale of the settings, which are 20, 0.5 and 0.25."""
    changed = {"control.stiffness": kp, "control.damping": kd, "control.action_scale": scale}
    task = make_task("a1_position", 3, **({} if kp == 20.0 else changed))
    q, qd, action = random_state(task)
    torques = task._compute_torques(torch.tensor(action).float())
    np.testing.assert_allclose(torques, pd_by_hand(action, q, qd, kp, kd, scale), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", TORQUE_TASKS)
def test_torque_torques(make_task, name):
    """Torque control is 4 N m per unit of action, whatever the state."""
    task = make_task(name, 3)
    _, _, action = random_state(task)
    np.testing.assert_allclose(task._compute_torques(torch.tensor(action).float()), 4.0 * action, rtol=1e-5)


@pytest.mark.parametrize("total_steps", [0, 25_000_000, 50_000_000, 60_000_000])
@pytest.mark.parametrize(("name", "end"), [(MULTI_HEAD_TASKS[0], 0.0), (MULTI_HEAD_TASKS[1], 0.1)])
def test_multi_head_torques(make_task, name, end, total_steps):
    """Multi-head control is eq. 7: the PD part of the first 12 actions by its weight, plus the whole torque part."""
    task = make_task(name, 3)
    task.total_steps.fill_(total_steps)
    task.update_curriculum()
    q, qd, action = random_state(task)
    expected = theta_by_hand(total_steps, end) * pd_by_hand(action[:, :12], q, qd) + 4.0 * action[:, 12:]
    torques = task._compute_torques(torch.tensor(action).float())
    np.testing.assert_allclose(torques, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("total_steps", "weights"),
    [
        (0, (1.0, 1.0)),
        (25_000_000, (0.5008, 0.55072)),  # at 24 960 000, the 390th multiple of 64 000
        (50_000_000, (0.00032, 0.100288)),  # at 49 984 000
        (50_048_000, (0.0, 0.1)),
        (60_000_000, (0.0, 0.1)),
    ],
)
def test_mixing_weights(make_task, total_steps, weights):
    """The PD weight goes from 1 to 0 or to 0.1 over 50e6 steps, in intervals of 64k; the torque weight stays 1."""
    for name, weight in zip(MULTI_HEAD_TASKS, weights, strict=True):
        task = make_task(name, 1)
        task.total_steps.fill_(total_steps)
        task.update_curriculum()
        assert task.mixing.tolist() == pytest.approx([weight, 1.0], rel=1e-5, abs=1e-7)
        values = task.curriculum_values()
        assert (values["mixing_pd"], values["mixing_torque"]) == tuple(task.mixing)


def test_mixing_is_constant_within_an_interval(make_task):
    """Between two multiples of 64k steps an update changes nothing, at the next multiple it does."""
    task = make_task("a1_torque_multihead", 1)
    seen = []
    for total_steps in (640_000, 640_001, 671_999, 703_999, 704_000):
        task.total_steps.fill_(total_steps)
        task.update_curriculum()
        seen.append(task.mixing[0].item())
    assert seen[0] == pytest.approx(1 - 0.64 / 50, rel=1e-6) and seen[4] == pytest.approx(1 - 0.704 / 50, rel=1e-6)
    assert seen[:4] == [seen[0]] * 4


def test_mixing_changes_between_rollouts_only(make_task):
    """Steps alone never change the mixing weights, however many intervals pass; the hook between rollouts does."""
    task = make_task("a1_multihead", 2)
    task.total_steps.fill_(24_999_999)
    for _ in range(2):
        task.step(torch.zeros(2, 24))
    task.reset()
    assert task.mixing.tolist() == [1.0, 1.0]
    task.update_curriculum()
    assert task.mixing[0].item() == pytest.approx(0.55072, rel=1e-5)


@pytest.mark.parametrize("name", [*POSITION_TASKS, *TORQUE_TASKS, *MULTI_HEAD_TASKS])
def test_torques_are_clipped(make_task, name):
    """Whatever the action, no joint gets more than 33.5 N m, and extreme actions give exactly that."""
    task = make_task(name, 2)
    signs = torch.tensor([1.0, -1.0]).repeat(2, task.num_actions // 2)
    signs[1] *= -1
    task.step(1e4 * signs)
    np.testing.assert_array_equal(task.torques, TORQUE_LIMIT * signs[:, :12])
    np.testing.assert_array_equal(task.sim.data.ctrl.numpy(), TORQUE_LIMIT * signs[:, :12])


def test_actions_are_clipped(make_task):
    """Actions beyond +-clip_actions count as that, in the torques, in the buffer and in the observation."""
    task = make_task("a1_torque", 2, **IN_THE_AIR, **{"normalization.clip_actions": 2.0})
    obs, *_ = task.step(torch.tensor([3.0, -5.0, 1.5] * 4).repeat(2, 1))
    expected = np.tile([2.0, -2.0, 1.5], (2, 4))
    np.testing.assert_array_equal(task.actions, expected)
    np.testing.assert_array_equal(obs["policy"][:, -12:], expected)
    np.testing.assert_allclose(task.torques, 4.0 * expected)


@pytest.mark.parametrize(("name", "refresh"), [("a1_position", True), ("a1_position", False), ("a1_multihead", True)])
def test_step_is_four_physics_steps(make_task, name, refresh):
    """One step moves each world as plain MuJoCo under PD torques that are computed anew before each physics step.

    With refresh_torques off they are computed once and held.
    """
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
        assert np.abs(results[True][0] - results[False][0]).max() > 2e-2  # the two are told apart


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


@pytest.mark.parametrize(("decimation", "dt", "length"), [(1, 0.005, 4000), (4, 0.02, 1000), (8, 0.04, 500)])
def test_decimation(make_task, decimation, dt, length):
    """Decimation is the number of physics steps per control step: it sets Delta t, episode length and free fall."""
    task = make_task("a1_torque", 2, **IN_THE_AIR, **{"control.decimation": decimation})
    assert task.dt == pytest.approx(dt) and task.max_episode_length == length
    task.step(torch.zeros(2, 12))
    # Without torques nothing but gravity acts, and friction holds the joints: semi-implicit Euler of a falling body.
    np.testing.assert_allclose(task.sim.qvel[:, 2], -9.81 * dt, rtol=1e-3)
    fallen = 9.81 * 0.005**2 * decimation * (decimation + 1) / 2
    np.testing.assert_allclose(2.0 - task.base_pos[:, 2], fallen, rtol=0.02)


def test_physics_step_is_a_setting(make_task):
    """sim.dt is the simulator's time step."""
    task = make_task("a1_torque", 1, **IN_THE_AIR, **{"sim.dt": 0.002, "control.decimation": 5})
    assert task.dt == pytest.approx(0.01)
    task.step(torch.zeros(1, 12))
    np.testing.assert_allclose(task.sim.qvel[:, 2], -9.81 * 0.01, rtol=1e-3)


# --------------------------------------------------------------------------------------------------- observations


@pytest.mark.parametrize(("name", "num_actions"), [("a1_position", 12), ("a1_torque", 12), ("a1_multihead", 24)])
def test_observation_layout(make_task, name, num_actions):
    """Both observation groups, number by number, of a constructed state."""
    task = make_task(name, 2)
    q, qd, action = random_state(task, seed=3)
    angle = 2 * math.pi / 3  # about the diagonal: body x, y, z are world y, z, x
    half = math.sin(angle / 2) / math.sqrt(3)
    task.base_quat.copy_(torch.tensor([math.cos(angle / 2), half, half, half]).expand(2, 4))
    task.base_pos.copy_(torch.tensor([5.0, 6.0, 0.35]).expand(2, 3))
    task.sim.qvel[:, :3] = torch.tensor([0.1, 0.2, 0.3])
    task.sim.qvel[:, 3:6] = torch.tensor([1.0, -2.0, 4.0])
    task.commands.copy_(torch.tensor([[0.5, -0.25, 1.0], [-1.0, 0.75, -0.5]]))
    task.actions.copy_(torch.tensor(action))
    task.sim.contact_found.zero_()
    task.sim.contact_found[:, [0, 1, 2, FEET[0], FEET[3]]] = torch.tensor([1.0, 1.0, 2.0, 1.0, 1.0])
    task._update_state()
    assert task.contacts[0].nonzero().flatten().tolist() == [0, 1, 2, FEET[0], FEET[3]] and task.contacts.max() == 1
    task.compute_observations()
    obs = task.get_observations()
    assert obs["policy"].shape == (2, 33 + num_actions) and obs["critic"].shape == (2, 125 + num_actions)
    for world, commands in enumerate(([1.0, -0.5, 0.25], [-2.0, 1.5, -0.125])):
        policy = [0.0, -1.0, 0.0, 0.25, -0.5, 1.0, *commands]
        policy += [*(q[world] - NOMINAL), *(0.05 * qd[world]), *action[world]]
        critic = [0.4, 0.6, 0.2, 0.35, 1.0, 0.0, 0.0, 1.0]
        np.testing.assert_allclose(obs["policy"][world], policy, atol=2e-6)
        np.testing.assert_allclose(obs["critic"][world, :-84], policy + critic, atol=2e-6)


def test_history(make_task):
    """The policy sees the steps before as it saw them then, the newest first; an episode starts with copies."""
    task = make_task("a1_torque", 3, **{"env.history_length": 3, "noise.add_noise": True, "env.episode_length_s": 0.08})
    task.base_pos[:, 2] = 5.0
    task.episode_length_buf = torch.tensor([0, 0, 1])
    first = task.get_observations()
    assert first["policy"].shape == (3, 135) and first["critic"].shape == (3, 137)
    torch.testing.assert_close(first["policy"], first["policy"][:, :45].repeat(1, 3))
    seen = [first["policy"][:, :45]]
    for _ in range(3):
        policy = task.step(torch.randn(3, 12))[0]["policy"]
        seen.append(policy[:, :45])
    assert torch.equal(policy[:2], torch.cat(seen[:0:-1], dim=1)[:2])
    assert torch.equal(policy[2], seen[-1][2].repeat(3)) and task.reset_buf.tolist() == [False, False, True]


def test_observation_scales(make_task):
    """Every scale is a setting that acts on its own entries alone."""
    scales = {"lin_vel": 3.0, "ang_vel": 5.0, "dof_pos": 7.0, "dof_vel": 11.0}
    task = make_task("a1_torque", 1, **{f"normalization.obs_scales.{key}": value for key, value in scales.items()})
    task.base_quat.copy_(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))
    task.sim.qvel.fill_(0.5)
    task.commands.fill_(0.25)
    task.dof_pos.copy_(task.default_dof_pos.unsqueeze(0) + 0.1)
    task._update_state()
    task.compute_observations()
    policy = [0, 0, -1, *[2.5] * 3, 0.75, 0.75, 1.25, *[0.7] * 12, *[5.5] * 12, *[0] * 12]
    np.testing.assert_allclose(task.get_observations()["policy"][0], policy, atol=1e-5)
    np.testing.assert_allclose(task.get_observations()["critic"][0, 45:48], [1.5] * 3, atol=1e-5)


def test_observations_are_clipped_and_copied(make_task):
    """Observations stay within +-100, and what a step returns is not changed by the next one."""
    task = make_task("a1_torque", 1, **IN_THE_AIR)
    task.dof_vel.copy_(torch.tensor([[5000.0, -5000.0] * 6]))
    task.compute_observations()
    for group in ("policy", "critic"):
        np.testing.assert_array_equal(task.get_observations()[group][0, 21:33], [100.0, -100.0] * 6)
    task.dof_vel.zero_()
    first, *_ = task.step(torch.ones(1, 12))
    kept = first.clone()
    second, *_ = task.step(-torch.ones(1, 12))
    assert torch.equal(first["critic"], kept["critic"]) and not torch.equal(first["critic"], second["critic"])


def test_observations_follow_the_step(make_task):
    """What a step returns describes the state after it, the action that was given and the commands in force."""
    task = make_task("a1_torque", 3, **IN_THE_AIR)
    action = torch.randn(3, 12)
    policy = task.step(action)[0]["policy"]
    np.testing.assert_allclose(policy[:, 9:21], task.sim.qpos[:, 7:].numpy() - NOMINAL, atol=1e-6)
    np.testing.assert_allclose(policy[:, 21:33], 0.05 * task.sim.qvel[:, 6:], atol=1e-6)
    np.testing.assert_allclose(policy[:, 33:], action)
    np.testing.assert_allclose(policy[:, 6:9], task.commands * torch.tensor([2.0, 2.0, 0.25]))


# --------------------------------------------------------------------------------------------------- commands

RANGES = {"lin_vel_x": [-1.0, 0.5], "lin_vel_y": [0.6, 0.75], "ang_vel_yaw": [-2.0, -1.5]}


@pytest.mark.parametrize("ranges", [{}, RANGES])
def test_commands_fill_their_ranges(make_task, ranges):
    """Drawn at a reset, commands are uniform over their ranges, by default +-1 m/s and +-1 rad/s, one per world."""
    task = make_task("a1_torque", 1024, **{f"commands.ranges.{key}": value for key, value in ranges.items()})
    for column, key in enumerate(RANGES):
        low, high = ranges.get(key, (-1.0, 1.0))
        drawn = np.sort((task.commands[:, column].numpy() - low) / (high - low))
        assert drawn[0] >= -1e-6 and drawn[-1] <= 1 + 1e-6 and len(np.unique(drawn)) > 1000
        assert np.abs(drawn - np.linspace(0, 1, 1024)).max() < 0.0611  # Kolmogorov-Smirnov at 0.1%
    correlation = np.corrcoef(task.commands.numpy().T)
    assert np.abs(correlation - np.eye(3)).max() < 0.12


@pytest.mark.parametrize("probability", [0.0, 0.002, 0.25, 1.0])
def test_resampling_probability(make_task, probability):
    """Commands are drawn anew with the set probability per world and step, and otherwise stay bitwise."""
    task = make_task("a1_torque", 2048, **{"commands.resampling_probability": probability})
    task.reset_buf.fill_(False)
    draws, changed = 20 * 2048, 0
    for _ in range(20):
        before = task.commands.clone()
        task._reset_worlds()
        changed += (task.commands != before).all(dim=1).sum().item()
        assert ((task.commands != before).all(dim=1) | (task.commands == before).all(dim=1)).all()
    assert abs(changed - draws * probability) <= 4 * math.sqrt(draws * probability * (1 - probability))


def test_default_resampling_probability(make_task):
    """By default commands change with probability 0.002 per step, about every 10 s."""
    assert make_task("a1_torque", 1).cfg.commands.resampling_probability == 0.002


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_resampling_within_step(make_task, probability):
    """A step keeps all commands at probability 0 and draws all anew at 1, without ending an episode."""
    task = make_task("a1_torque", 3, **IN_THE_AIR, **{"commands.resampling_probability": probability})
    before = task.commands.clone()
    task.step(torch.zeros(3, 12))
    assert ((task.commands != before) == bool(probability)).all()
    assert task.episode_length_buf.tolist() == [1, 1, 1]


# --------------------------------------------------------------------------------------------------- episodes


def test_time_out(make_task):
    """An episode ends after its length as a time-out, and counting starts anew."""
    task = make_task("a1_torque", 3, **IN_THE_AIR, **{"env.episode_length_s": 0.1})
    task.episode_length_buf = torch.tensor([0, 2, 0])
    for step in range(1, 9):
        _, _, dones, extras = task.step(torch.zeros(3, 12))
        expected = [step == 5, step in (3, 8), step == 5]
        assert dones.tolist() == expected and extras["time_outs"].tolist() == expected
        assert task.episode_length_buf.tolist() == [step % 5, (step + 2) % 5, step % 5]
        assert ((task.base_pos[:, 2] == 2.0) == torch.tensor(expected)).all()


def test_termination(make_task):
    """A trunk on the ground ends its episode, which is no time-out, even in the very last step; others go on."""
    task = make_task("a1_torque", 4, **IN_THE_AIR, **{"env.episode_length_s": 0.1})
    task.episode_length_buf = torch.tensor([1, 1, 4, 4])
    low = torch.tensor([False, True, False, True])
    task.base_quat.copy_(torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4, 4))
    task.dof_pos.copy_(torch.tensor([0.0, 2.6, -0.95] * 4).expand(4, 12))  # legs up
    task.base_pos[low, 2] = 0.05
    _, _, dones, extras = task.step(torch.zeros(4, 12))
    assert dones.tolist() == [False, True, True, True]
    assert extras["time_outs"].tolist() == [False, False, True, False]
    assert task.episode_length_buf.tolist() == [2, 0, 0, 0]
    np.testing.assert_array_equal(task.base_pos[1:], [[0.0, 0.0, 2.0]] * 3)


@pytest.mark.parametrize("part", ["feet", "knees"])
def test_no_termination_by_legs(make_task, part):
    """Feet, calves and thighs on the ground end no episode."""
    task = make_task("a1_torque", 1)
    height, calf = {"feet": (0.333, -0.95), "knees": (0.207, -2.6)}[part]
    task.sim.qpos[0] = torch.tensor([0, 0, height, 1, 0, 0, 0, *[0.0, 0.0, calf] * 4])
    _, _, dones, _ = task.step(torch.zeros(1, 12))
    assert task.contacts.sum() >= 4 and not dones.any()


def test_reset_clears_what_belongs_to_the_episode(make_task):
    """After its end an episode leaves no action, air time, sum, speed or contact behind; the other world keeps all."""
    task = make_task("a1_torque", 2, **{"env.episode_length_s": 0.1, "rewards.only_positive_rewards": False})
    task.base_pos[:, 2] = 0.2
    task.episode_length_buf = torch.tensor([2, 0])
    for _ in range(3):
        task.feet_air_time.fill_(0.3)
        task.base_quat.copy_(torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2))
        task.base_pos[:, 2] = 0.25
        obs, *_ = task.step(torch.full((2, 12), 0.5))
    assert task.reset_buf.tolist() == [True, False]
    for buffer in (task.actions, task.last_actions, task.episode_sums.T, task.episode_return, task.last_dof_vel):
        assert (buffer[0] == 0).all() and (buffer[1] != 0).any()
    for buffer in (task.feet_air_time, task.sim.qvel, task.sim.qacc_warmstart, task.contacts, task.base_lin_vel):
        assert (buffer[0] == 0).all()
    assert (task.contacts[1] != 0).any() and (task.sim.qvel[1] != 0).any()
    assert (obs["policy"][0, 21:] == 0).all() and (obs["critic"][0, -88:-84] == 0).all()


def test_reset_of_all_worlds(make_task):
    """reset() starts every world anew, so that the first step's action rate and acceleration count from rest."""
    task = make_task("a1_torque", 2, **IN_THE_AIR)
    for _ in range(3):
        task.step(torch.ones(2, 12))
    obs = task.reset()
    np.testing.assert_allclose(task.base_pos, [[0.0, 0.0, 2.0]] * 2)
    assert (task.sim.qvel == 0).all() and (obs["policy"][:, 21:] == 0).all()
    assert (task.episode_length_buf == 0).all() and (task.episode_sums == 0).all() and (task.episode_return == 0).all()
    task.step(torch.zeros(2, 12))
    sums = dict(zip(task.reward_names, task.episode_sums, strict=True))
    assert (sums["action_rate"] == 0).all()
    change = (task.sim.qvel[:, 6:] / 0.02).square().sum(dim=1)
    np.testing.assert_allclose(sums["dof_acc"], -2.5e-7 * 0.02 * change, rtol=1e-3, atol=1e-9)


# --------------------------------------------------------------------------------------------------- initial states


@pytest.mark.parametrize(
    "ranges",
    [
        {
            "init_roll": [-math.pi / 16, math.pi / 16],
            "init_pitch": [-math.pi / 16, math.pi / 16],
            "init_yaw": [-math.pi, math.pi],
            "init_dof_pos_scale": [0.5, 1.5],
        },
        {"init_roll": [0.1, 0.2], "init_pitch": [-0.4, -0.3], "init_yaw": [1.0, 3.0], "init_dof_pos_scale": [1.0, 1.1]},
    ],
)
def test_initial_states(make_task, ranges):
    """Initial angles fill their ranges, by default those of the design; the trunk is at rest at its place.

    Joints are at q_nominal times a number of their own, kept inside their limits.
    """
    default = ranges["init_roll"][0] < 0
    task = make_task("a1_torque", 512, **({} if default else {f"domain_rand.{k}": v for k, v in ranges.items()}))
    np.testing.assert_allclose(task.base_pos, np.tile([0.0, 0.0, 0.4], (512, 1)), atol=1e-6)
    assert (task.sim.qvel == 0).all()
    angles = np.array([euler_by_hand(quat) for quat in task.base_quat.numpy()])
    for column, key in enumerate(("init_roll", "init_pitch", "init_yaw")):
        low, high = ranges[key]
        drawn = (angles[:, column] - low) / (high - low)
        assert -1e-4 < drawn.min() < 0.03 and 0.97 < drawn.max() < 1 + 1e-4, key
        assert abs(drawn.mean() - 0.5) < 0.05 and len(np.unique(drawn)) > 500, key
    q = task.dof_pos.numpy()
    low, high = ranges["init_dof_pos_scale"]
    assert (q >= LOW - 1e-6).all() and (q <= HIGH + 1e-6).all()
    ends = np.sort([np.clip(NOMINAL * low, LOW, HIGH), np.clip(NOMINAL * high, LOW, HIGH)], axis=0)
    assert (q >= ends[0] - 1e-6).all() and (q <= ends[1] + 1e-6).all()
    inside = (q > LOW + 1e-4) & (q < HIGH - 1e-4)
    scale = (np.where(inside, q / NOMINAL, np.nan) - low) / (high - low)
    assert (np.nanmax(scale, axis=0) > 0.97).all() and (np.nanmin(scale[:, :2], axis=0) < 0.03).all()
    front = scale[:, [0, 1, 3, 4, 6, 7]]  # hips and thighs are never clipped
    assert np.abs(np.corrcoef(front.T) - np.eye(6)).max() < 0.2  # one draw per joint, not one per world


def test_draws_differ_and_repeat_with_the_seed(make_task):
    """No two worlds start alike; the same seed gives the same start, another seed another one."""
    first, same, other = (make_task("a1_torque", 16, seed=seed) for seed in (5, 5, 6))
    assert len(torch.unique(first.sim.qpos, dim=0)) == 16 and len(torch.unique(first.commands, dim=0)) == 16
    assert torch.equal(first.sim.qpos, same.sim.qpos) and torch.equal(first.commands, same.commands)
    assert not (first.sim.qpos[:, 3:] == other.sim.qpos[:, 3:]).all(dim=1).any()
