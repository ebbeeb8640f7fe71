"""Faults over DDS in real time end in damping; how soon depends on the machine, and is not tested."""

import json
import sys

from tools import faults


def test_each_fault_ends_in_damping(exported_go2, tmp_path, monkeypatch, capsys):
    """One of each kind; no torque beyond limits, unless a joint is set to another speed or place."""
    words = ["faults", str(exported_go2), "--trials", str(len(faults.KINDS))]
    monkeypatch.setattr(sys, "argv", [*words, "--json", str(tmp_path / "faults.json")])
    faults.main()
    rows = json.loads((tmp_path / "faults.json").read_text())["rows"]
    assert [row["fault"] for row in rows] == [*faults.KINDS]
    assert all(0.0 < row["ms"] < 1e3 * faults.LIMIT for row in rows)
    beyond = [row["excess"] for row in rows if not row["fault"].startswith("joint")]
    assert max(beyond) < 1.0  # N m: a busy machine may hold a command for some milliseconds
    assert f"{len(rows)} faults" in capsys.readouterr().out
