"""The comparison with mjlab: what judges both, and our side of it; the other one needs an environment of its own."""

import json
import sys

import mujoco
import numpy as np
import pytest
import yaml

from legged_torque.utils.policies import CARD, POLICIES_DIR
from tools.compare import __main__ as command
from tools.compare import measure, ours

BOX = """<mujoco><option gravity="0 0 0" timestep="0.02"/>
<worldbody><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""


class Box:
    """A box in space that is turned left by 90 degrees, moves at a share of its command, and may turn over."""

    def __init__(self, share, falls_after):
        self.model = mujoco.MjModel.from_xml_string(BOX)
        self.data, self.control_step = mujoco.MjData(self.model), 0.02
        self.share, self.falls_after = share, falls_after

    def reset(self):
        mujoco.mj_resetData(self.model, self.data)

    def step(self, command):
        has_fallen = self.data.time > self.falls_after
        self.data.qpos[3:7] = (0.0, 1.0, 0.0, 0.0) if has_fallen else (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
        forward, left, yaw = self.share * command
        self.data.qvel[:] = -left, forward, 0.0, 0.0, 0.0, yaw
        self.data.time += self.control_step


@pytest.mark.parametrize(("share", "falls_after", "expected"), [(1.0, 9.0, 1.0), (0.7, 9.0, 0.7), (0.7, 4.5, 0.35)])
def test_tracking(share, falls_after, expected):
    """1 - |v - c| / |c| is the share of a command that is reached; of 7 s that count, a fall at 4.5 s leaves half."""
    assert measure.tracking(Box(share, falls_after)) == pytest.approx(expected, abs=0.003)


def test_our_robot_walks(monkeypatch):
    """A bundled policy tracks in plain MuJoCo as its card says of training's worlds, though yaw rates are halved."""
    folder = POLICIES_DIR / "go1" / "position"
    monkeypatch.setattr(measure, "NUM_COMMANDS", 12)
    options = ours.Go1(folder, measure.EQUAL["iterations"]).model.opt
    assert options.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL and options.impratio == measure.EQUAL["impratio"]
    assert options.iterations == measure.EQUAL["iterations"]
    mean, _ = yaml.safe_load((folder / CARD).read_text("utf-8"))["metrics"]["none"]["track_percentage"]
    assert measure.tracking(ours.Go1(folder)) == pytest.approx(mean, abs=0.06)


def test_our_side(tmp_path, monkeypatch):
    """A short training is timed and its checkpoint judged; iterations and steps per second are of the same time."""
    words = {"settings": "equal", "engine": "fused", "num_envs": 2, "iterations": 2, "seed": 1, "device": "cpu"}
    words |= {"started": 0.0, "out": tmp_path / "row.json"}
    monkeypatch.setattr(measure, "INTERVAL", 2)
    monkeypatch.setattr(measure, "NUM_COMMANDS", 2)
    monkeypatch.setattr(sys, "argv", ["ours", *(f"--{name}={value}" for name, value in words.items())])
    ours.main()
    row = json.loads((tmp_path / "row.json").read_text())
    assert row["training_steps_per_s"] * row["iteration_ms"] == pytest.approx(1e3 * 2 * 24)
    assert row["update_ms"] < row["iteration_ms"] < 1e3 * row["start_up_s"] and "seconds_to_70" not in row
    assert [iterations for iterations, _, _ in row["tracking"]] == [2] and row["tracking"][0][2] < 0.3
    assert command.table([row | {"trainer": "a", "compared": "b", "engine": None}])[2].count("not reached") == 2


def test_a_row_that_fails(tmp_path, monkeypatch, capsys):
    """The others go on, and the table says which one failed; here Python is started as if it were mjlab's."""
    monkeypatch.setattr(command, "ROWS", [("mjlab", "equal", None), ("mjlab", "default", None)])
    words = ["--mjlab", sys.executable, "--device=cpu", "--iterations=10", f"--json={tmp_path / 'rows.json'}"]
    monkeypatch.setattr(sys, "argv", ["compare", *words])
    with pytest.raises(SystemExit, match="True"):
        command.main()
    assert capsys.readouterr().out.count("No module named 'mjlab'") == 2
    assert ["error" in row for row in json.loads((tmp_path / "rows.json").read_text())["rows"]] == [True, True]
