"""The note about other processes that use the cores."""

import os
import subprocess
import sys

import pytest

from legged_torque.utils import devices

CORES = os.cpu_count() or 1


@pytest.mark.parametrize(
    ("others", "threads", "is_noted"),
    [(CORES, 2, True), (CORES, 1, False), (0.1, CORES + 2, False)],
)
def test_note(others, threads, is_noted, monkeypatch):
    """It is given if threads must share cores with others; a single thread waits for no other."""
    monkeypatch.setattr(devices, "busy_cores", lambda: others)
    note = devices.busy_cores_note(threads)
    assert bool(note) == is_noted
    if is_noted:
        assert f"other processes use {CORES:.1f} of {CORES} cores, and torch has {threads} threads" in note


@pytest.mark.skipif(sys.platform != "linux", reason="the counts are Linux's")
def test_another_process(monkeypatch):
    """A process that computes without end is seen."""
    monkeypatch.setattr(devices, "SECONDS", 1.0)
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as other:
        others = devices.busy_cores()
        other.kill()
    assert others > 0.4
