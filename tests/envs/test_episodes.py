"""Commands, episodes and their ends, and initial states of the tasks."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.control import HIGH, IN_THE_AIR, LOW, NOMINAL
from support.settings import error_of

from legged_torque.envs import A1TorqueCfg, TorqueRobot


def euler_by_hand(quat):
    """Roll, pitch and yaw (about fixed x, y, z, in this order) from MuJoCo's rotation matrix of a quaternion."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, dtype=float))
    r = matrix.reshape(3, 3)
    return math.atan2(r[2, 1], r[2, 2]), -math.asin(r[2, 0]), math.atan2(r[1, 0], r[0, 0])


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


@pytest.mark.parametrize("probability", [0.0, 0.25, 1.0])
def test_resampling_probability(make_task, probability):
    """Each step draws all commands of a world anew with the set probability, without ending its episode."""
    task = make_task("a1_torque", 2048, **IN_THE_AIR, **{"commands.resampling_probability": probability})
    draws, changed = 4 * 2048, 0
    for _ in range(4):
        before = task.commands.clone()
        task.step(torch.zeros(2048, 12))
        differs = task.commands != before
        assert torch.equal(differs.any(dim=1), differs.all(dim=1))
        changed += differs.any(dim=1).sum().item()
    assert abs(changed - draws * probability) <= 4 * math.sqrt(draws * probability * (1 - probability))
    assert (task.episode_length_buf == 4).all()


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
    assert (obs["policy"][0, 21:] == 0).all() and (obs["critic"][0, -121:-117] == 0).all()


UPRIGHT = {"init_roll": [-math.pi / 16, math.pi / 16], "init_pitch": [-math.pi / 16, math.pi / 16]}
UPRIGHT |= {"init_yaw": [-math.pi, math.pi], "init_dof_pos_scale": [0.5, 1.5]}  # by default
LEANING = {"init_roll": [0.1, 0.2], "init_pitch": [-0.4, -0.3], "init_yaw": [1.0, 3.0]}
LEANING |= {"init_dof_pos_scale": [1.0, 1.1]}


@pytest.mark.parametrize("ranges", [UPRIGHT, LEANING])
def test_initial_states(make_task, ranges):
    """Angles fill their ranges; joints are q_nominal times a number each, inside limits; the trunk is at rest."""
    changes = {} if ranges is UPRIGHT else {f"domain_rand.{key}": value for key, value in ranges.items()}
    task = make_task("a1_torque", 512, **changes)
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


class FarRobot(TorqueRobot):
    """A robot with an end of its own, in two wrong ways, too."""

    def _termination_distance(self):
        return self.base_pos[:, :2].norm(dim=1) > self.cfg.terminations.distance

    def _termination_wrong_shape(self):
        return self.base_pos > 0

    def _termination_wrong_type(self):
        return self.base_pos[:, 0]


class FarCfg(A1TorqueCfg):
    """Its settings."""

    class env:
        num_envs = 4
        episode_length_s = 1.0

    class terminations:
        distance: float = 3.0
        wrong_shape: bool = False
        wrong_type: bool = False

    class domain_rand:
        init_roll, init_pitch = [0.0, 0.0], [0.0, 0.0]


def make(**terminations):
    """A task of such robots, high above the ground."""
    cfg = FarCfg()
    cfg.init_state.pos = IN_THE_AIR["init_state.pos"]
    for name, value in terminations.items():
        setattr(cfg.terminations, name, value)
    return FarRobot(cfg)


@pytest.mark.parametrize("roll", [True, False])
def test_tilt(roll):
    """Trunks that lean more than the angle end, whichever way; by default none does."""
    angles = torch.tensor([0.68, 0.72, -0.72, math.pi])
    sines, zeros = (angles / 2).sin(), torch.zeros(4)
    quats = torch.stack([(angles / 2).cos(), *((sines, zeros) if roll else (zeros, sines)), zeros], dim=1)
    for task, expected in ((make(tilt=0.7), [False, True, True, True]), (make(), [False] * 4)):
        task.base_quat.copy_(quats)
        assert task.step(torch.zeros(4, 12))[2].tolist() == expected


def test_height_and_a_term_of_ones_own():
    """Either ends an episode, and is no time-out, not even in the last step; contacts can be left out."""
    task = make(base_height=1.5, contact=False)
    task.base_pos[1, 2] = 1.4
    task.base_pos[2, 1] = -3.5
    task.episode_length_buf = torch.tensor([49, 49, 49, 0])
    _, _, dones, extras = task.step(torch.zeros(4, 12))
    assert dones.tolist() == [True, True, True, False] and extras["time_outs"].tolist() == [True, False, False, False]
    for contact in (True, False):
        task = make(contact=contact)
        task.dof_pos.copy_(torch.tensor([0.0, 2.6, -0.95] * 4).expand(4, 12))  # legs up
        task.base_pos[:, 2] = 0.05
        assert task.step(torch.zeros(4, 12))[2].tolist() == [contact] * 4


def test_wrong_terms():
    """Terms of another shape or type, and settings without a term, are refused by name."""
    for name in ("wrong_shape", "wrong_type"):
        assert f"'{name}'" in error_of(make(**{name: True}).try_step)

    class TypoCfg(FarCfg):
        class terminations:
            distanse: float = 1.0

    assert "did you mean 'distance'" in error_of(FarRobot, TypoCfg())
