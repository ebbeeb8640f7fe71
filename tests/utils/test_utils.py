"""The small helpers."""

import ctypes.util
import os
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from legged_torque.envs import task_registry
from legged_torque.utils import devices
from legged_torque.utils.config import to_dict
from legged_torque.utils.math import quat_rotate_inverse
from legged_torque.utils.options import Options, apply_options


def quaternion_matrices(quat):
    """Rotation matrices of quaternions (w, x, y, z)."""
    w, x, y, z = quat.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def test_world_vectors_in_the_body_frame():
    """A vector is turned by the transposed rotation matrix."""
    rng = np.random.default_rng(1)
    quat, vec = rng.normal(size=(50, 4)), rng.normal(size=(50, 3))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    expected = np.einsum("nji,nj->ni", quaternion_matrices(quat), vec)
    turned = quat_rotate_inverse(torch.tensor(quat), torch.tensor(vec))
    np.testing.assert_allclose(turned, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("asked", "installed", "gpu", "chosen"),
    [
        (None, ["EGL", "OSMesa"], True, "egl"),
        (None, ["EGL", "OSMesa"], False, "osmesa"),
        (None, ["EGL"], False, "egl"),
        (None, ["OSMesa"], True, "osmesa"),
        ("egl", ["EGL", "OSMesa"], False, "egl"),
        ("OSMesa", ["EGL", "OSMesa"], True, "osmesa"),
        ("egl", ["OSMesa"], True, None),
        ("osmesa", ["EGL"], False, None),
        (None, [], True, None),
        (None, [], False, None),
    ],
)
def test_choice_of_the_renderer(asked, installed, gpu, chosen, monkeypatch):
    """What the user asks for if it is installed; else EGL on a GPU, Mesa without; else none, and a line says why."""
    monkeypatch.setenv("MUJOCO_GL", asked or "")
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: f"lib{name}.so" if name in installed else None)
    monkeypatch.setattr(devices, "Path", lambda path: SimpleNamespace(exists=lambda: gpu))
    reason = devices.choose_offscreen_renderer()
    assert os.environ["MUJOCO_GL"] == (chosen or "disable")
    if chosen:
        assert reason is None
    else:
        assert "is not installed" in reason and "apt-get install libosmesa6" in reason and "\n" not in reason
        assert asked is None or asked in reason


def test_options_that_are_not_given_change_nothing():
    """Scripts without training options, such as play.py, leave training settings alone."""
    env_cfg, train_cfg = task_registry.get_cfgs("a1_position")
    before = to_dict(train_cfg)
    apply_options(env_cfg, train_cfg, Options(device="cpu", num_envs=3))
    assert env_cfg.env.num_envs == 3 and to_dict(train_cfg) == before
