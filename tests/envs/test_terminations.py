"""Terms that end episodes."""

import math

import pytest
import torch
from support.control import IN_THE_AIR
from support.settings import error_of

from legged_torque.envs import A1TorqueCfg, TorqueRobot


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
        assert f"'{name}'" in error_of(make(**{name: True}).step, torch.zeros(4, 12))

    class TypoCfg(FarCfg):
        class terminations:
            distanse: float = 1.0

    assert "did you mean 'distance'" in error_of(FarRobot, TypoCfg())
