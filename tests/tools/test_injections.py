"""Bad numbers in single worlds, a few of those of ``tools/injections.py``."""

from support.fused import compiled, make_a1
from support.scripts import run_here

from legged_torque.sim.registry import ENGINES
from legged_torque.sim.warp_engine import WarpEngine
from tools import injections


def test_what_is_counted(monkeypatch):
    """Without resets nothing recovers: the counts are no constants."""
    monkeypatch.setattr(WarpEngine, "reset", lambda self, mask: None)
    counts = injections.run(compiled(make_a1()), "fused", 6, "cpu")
    assert counts["not recovered"] > 0


def test_script(tmp_path):
    """No other world differs by a bit, and the world is as good as new after a reset, on both engines."""
    found, output, _ = run_here("../tools/injections.py", "--count=12", root=tmp_path)
    assert (found, output) == (0, "".join(f"{name}: 12 injections, 0 leaked, 0 not recovered\n" for name in ENGINES))
    assert run_here("../tools/injections.py", "--count=0", root=tmp_path)[0] == 2
