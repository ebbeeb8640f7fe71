"""A physics engine of a user's, in one file: plain MuJoCo on a CPU, one world after another."""

import mujoco
import pytest
import torch
from support.engine_suite import EngineSuite
from support.scripts import assert_told_in_one_line, run_here

from legged_torque.sim.engine import Engine, check_mask
from legged_torque.sim.registry import ENGINES

STATE = ("qpos", "qvel", "qacc_warmstart", "ctrl")


class PlainMuJoCo(Engine):
    """``mj_step`` in double precision; states are kept as float32."""

    name = "mujoco"
    capabilities = frozenset({"self_collision"})

    def __init__(self, model, num_envs, device):
        """Build the worlds."""
        self.mj_model, self.num_envs, self.device = model, num_envs, device
        self._data = mujoco.MjData(model)
        self._reference = torch.tensor(model.qpos0, dtype=torch.float32)
        self.qpos = self._reference.repeat(num_envs, 1)
        self.qvel, self.qacc_warmstart = torch.zeros(2, num_envs, model.nv)
        self.ctrl, self._sensors = torch.zeros(num_envs, model.nu), torch.zeros(num_envs, model.nsensor, 4)
        self.contact_found, self.contact_force = self._sensors[:, :, 0], self._sensors[:, :, 1:]
        self.diverged = torch.zeros(num_envs, dtype=torch.bool)

    def step(self, sense=True):
        """Step one world after another; one that is not finite stays as it is."""
        for world in range(self.num_envs):
            state = [getattr(self, name)[world] for name in STATE]
            if not all(values.isfinite().all() and values.abs().max() < 1e10 for values in state[:3]):
                continue
            mujoco.mj_resetData(self.mj_model, self._data)
            for name, values in zip(STATE, state, strict=True):
                getattr(self._data, name)[:] = values
            mujoco.mj_step(self.mj_model, self._data)
            for name, values in zip(STATE[:3], state, strict=False):
                values.copy_(torch.tensor(getattr(self._data, name)))
            self._sensors[world] = torch.tensor(self._data.sensordata.reshape(-1, 4))

    def reset(self, mask):
        """Put worlds back."""
        check_mask(self, mask)
        self.qpos[mask] = self._reference
        for tensor in (self.qvel, self.qacc_warmstart, self.ctrl, self._sensors):
            tensor[mask] = 0.0

    def flag_diverged(self):
        """Look at all numbers."""
        state = torch.cat([self.qpos, self.qvel], dim=1)
        self.diverged |= ~(state.abs() <= 1e4).all(dim=1) | ~(self.qacc_warmstart.abs() <= 1e10).all(dim=1)
        self.diverged |= ~self.ctrl.isfinite().all(dim=1)

    def state_dict(self):
        """Return what worlds carry."""
        names = (*STATE, "contact_found", "contact_force", "diverged")
        return {name: getattr(self, name) for name in names}


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """What the user's file does when it is imported."""
    monkeypatch.setitem(ENGINES, "mujoco", PlainMuJoCo)


class TestPlainMuJoCo(EngineSuite):
    """It is the truth, up to float32."""

    engine, tolerance = "mujoco", 1e-3


WORDS = ["--task=a1_multihead", "--device=cpu", "--num_envs=3", "--logger=none", "--set=sim.engine=mujoco"]
WORDS += ["--set=runner.num_steps_per_env=4", "--set=algorithm.num_mini_batches=2", "--set=evaluation.interval=0"]


def test_training(tmp_path):
    """A task trains on it without a change in the package."""
    status, _, error = run_here("train.py", *WORDS, "--max_iterations=2", root=tmp_path)
    assert status == 0, error
    assert len(list(tmp_path.glob("logs/*/*/model_2.pt"))) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("--set=domain_rand.randomize_parameters=True", "'per_world', which domain_rand.randomize_parameters needs"),
        ("--set=sim.engine=mujoko", "did you mean 'mujoco'? allowed: fused, mujoco, mujoco_warp"),
    ],
)
def test_refusals(tmp_path, change, message):
    """What a task needs and the engine lacks is one line."""
    assert_told_in_one_line(run_here("train.py", *WORDS, change, root=tmp_path), message)
