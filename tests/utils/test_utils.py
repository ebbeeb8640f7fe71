"""The small helpers: vectors and headings, renderers, busy cores, paths, seconds by stage."""

import ctypes.util
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from legged_torque.utils import devices
from legged_torque.utils.files import portable_path, without_machine
from legged_torque.utils.heading import heading
from legged_torque.utils.math import quat_rotate_inverse, rotate_yaw, yaw


def test_world_vectors_in_the_body_frame():
    """Turned back into the world by MuJoCo, they are what they were."""
    rng = np.random.default_rng(1)
    quats, vectors = rng.normal(size=(50, 4)), rng.normal(size=(50, 3))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    in_body, in_world = quat_rotate_inverse(torch.tensor(quats), torch.tensor(vectors)).numpy(), np.empty(3)
    for quat, vector, turned_back in zip(quats, vectors, in_body, strict=True):
        mujoco.mju_rotVecQuat(in_world, turned_back, quat)
        np.testing.assert_allclose(in_world, vector, atol=1e-12)


def turned(angle, tilt, about):
    """A turn about z [rad] after a tilt [rad] about a horizontal axis at an angle ``about``: (w, x, y, z)."""
    w, x, y = math.cos(tilt / 2), math.sin(tilt / 2) * math.cos(about), math.sin(tilt / 2) * math.sin(about)
    cos, sin = math.cos(angle / 2), math.sin(angle / 2)
    return np.array([cos * w, cos * x - sin * y, cos * y + sin * x, sin * w])


@pytest.mark.parametrize("angle", [-3.0, -0.4, 0.0, 1.2, 3.1])
@pytest.mark.parametrize("tilt", [0.0, 0.7, 2.0])
def test_heading(angle, tilt):
    """A tilt about a horizontal axis does not change the heading, and numpy and torch agree."""
    quat = turned(angle, tilt, 0.9)
    x, y, length = heading(quat)
    assert math.atan2(y, x) == pytest.approx(angle)
    assert (x / length, y / length) == pytest.approx((math.cos(angle), math.sin(angle)))
    quats, one = torch.from_numpy(np.stack([quat, quat])), torch.ones(2, dtype=torch.float64)
    torch.testing.assert_close(yaw(quats), angle * one)
    torch.testing.assert_close(rotate_yaw(quats, one, 0.0 * one), (math.cos(angle) * one, math.sin(angle) * one))


def test_upside_down():
    """Without a heading, results are finite."""
    x, y, length = heading(np.array([0.0, 1.0, 0.0, 0.0]))
    assert (x, y) == (0.0, 0.0) and length > 0.0


@pytest.mark.parametrize(
    ("asked", "installed", "gpu", "chosen"),
    [
        (None, ["EGL", "OSMesa"], True, "egl"),
        (None, ["EGL", "OSMesa"], False, "osmesa"),
        (None, ["EGL"], False, "egl"),
        ("OSMesa", ["EGL", "OSMesa"], True, "osmesa"),
        ("egl", ["OSMesa"], True, None),
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


def test_portable_path(tmp_path, monkeypatch):
    """Paths below the current folder become relative, others a name; relative ones stay."""
    monkeypatch.chdir(tmp_path)
    assert portable_path(tmp_path / "logs" / "a.pt") == "logs/a.pt"
    assert portable_path("/elsewhere/a.pt") == "a.pt"
    assert portable_path(Path("../logs/a.pt")) == "../logs/a.pt"


def test_without_machine(monkeypatch, tmp_path):
    """Paths are found in nested settings and in KEY=VALUE; everything else stays."""
    monkeypatch.chdir(tmp_path)
    settings = {"file": "/tmp/a.pt", "scale": 0.5, "names": ["a/b", "runner.file=/tmp/b.pt", "x=1/2", None]}
    expected = {"file": "a.pt", "scale": 0.5, "names": ["a/b", "runner.file=b.pt", "x=1/2", None]}
    assert without_machine(settings) == expected
    assert without_machine(["/home/me/lr=1/c.pt", "file=/home/me/lr=1/c.pt"]) == ["c.pt", "file=c.pt"]


PROGRAM = """import time
from legged_torque.utils.stopwatch import stopwatch
for stage in ("a", "b", "a"):
    time.sleep(0.2)
    stopwatch.lap(stage)
print(stopwatch, *stopwatch.seconds.values(), sep=" | ")
"""


def test_every_second_counts():
    """A stage may go on later; the first has the process's start too, and all together are no more than its life."""
    began = time.perf_counter()
    output = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True).stdout
    lived = time.perf_counter() - began
    text, first, second = output.split(" | ")
    assert text == f"a {float(first):.1f} s, b {float(second):.1f} s"
    assert float(second) >= 0.2 and float(first) > 0.4 + 0.01 and float(first) + float(second) <= lived + 0.02
