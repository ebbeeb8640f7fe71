"""Bad numbers in single worlds, a few of those of ``tools/injections.py``."""

import pytest
import torch
from support.fused import compiled, make_a1
from support.scripts import run_here

from legged_torque.sim.registry import ENGINES, make_engine
from legged_torque.sim.warp_engine import WarpEngine
from tools import injections


@pytest.mark.parametrize("engine", ENGINES)
def test_bad_numbers_stay_in_their_world(engine):
    """No other world differs by a bit, and the world is as good as new after a reset."""
    counts = injections.run(compiled(make_a1()), engine, 12, "cpu")
    assert counts == {"injections": 12, "leaked": 0, "not recovered": 0}


def test_what_is_counted(monkeypatch):
    """Without resets nothing recovers: the counts are no constants."""
    monkeypatch.setattr(WarpEngine, "reset", lambda self, mask: None)
    counts = injections.run(compiled(make_a1()), "fused", 6, "cpu")
    assert counts["not recovered"] > 0


def test_stale_constraint_rows_are_cleared():
    """A bad joint angle spoils rows of MuJoCo Warp's Jacobian, of which none is left after a reset."""
    sim = make_engine("mujoco_warp", compiled(make_a1()), 2, "cpu")
    sim.qpos[:, 2] = 0.1
    sim.qpos[1, -1] = float("nan")
    sim.step()
    jacobian = sim.state_dict()["efc.J"].numpy
    assert torch.isnan(torch.tensor(jacobian()[1])).any()
    sim.reset(torch.tensor([False, True]))
    assert (jacobian()[1] == 0.0).all() and (jacobian()[0] != 0.0).any()


def test_script(tmp_path):
    """It prints the counts of both engines, and mistakes in a line."""
    found, output, _ = run_here("../tools/injections.py", "--count=2", root=tmp_path)
    assert (found, output) == (0, "".join(f"{name}: 2 injections, 0 leaked, 0 not recovered\n" for name in ENGINES))
    assert run_here("../tools/injections.py", "--count=0", root=tmp_path)[0] == 2
