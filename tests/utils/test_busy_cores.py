"""What is said of other processes that use the cores."""

import os
import runpy
import subprocess
import sys
import time

import pytest

from legged_torque.utils import busy_cores
from legged_torque.utils.busy_cores import LEAST, BusyCores

CORES, TICKS = os.cpu_count() or 1, os.sysconf("SC_CLK_TCK")


@pytest.fixture
def passed(tmp_path):
    """Observe a machine on which all cores together were busy for some seconds while some seconds have passed."""

    def make(busy, seconds):
        idle = seconds * CORES - busy
        file = tmp_path / "stat"
        file.write_text("cpu 100 0 0 100 0 0 0 0 0 0\ncpu0 1 1\n")
        cores = BusyCores(file)
        file.write_text(f"cpu {100 + busy * TICKS:.0f} 0 0 {100 + idle * TICKS:.0f} 0 0 0 0 0 0\n")
        return cores

    return make


def test_note(passed):
    """It is told if threads must share cores with others, and only then."""
    cores = passed(busy=10.0 * CORES, seconds=10.0)
    assert cores.of_others() == pytest.approx(CORES, abs=0.05)
    assert f"other processes use {CORES:.1f} of {CORES} cores, and torch has 2 threads" in cores.note(2)
    assert cores.note(1) is None  # a single thread waits for no other
    assert passed(busy=0.1, seconds=10.0).note(CORES) is None
    assert passed(busy=10.0 * CORES, seconds=0.5 * LEAST).note(2) is None


def test_no_counts(tmp_path, monkeypatch):
    """Where the system does not say, nothing is said, though it may not know what a count is either."""
    monkeypatch.delattr(os, "sysconf")  # as on Windows
    imported = runpy.run_path(busy_cores.__file__)
    assert imported["BusyCores"](tmp_path / "missing").of_others() is None


def test_own_work(passed):
    """What this process computes is not that of others."""
    cores = passed(busy=5.0, seconds=10.0)
    end = time.process_time() + 0.3
    while time.process_time() < end:
        pass
    assert cores.of_others() == pytest.approx(0.47, abs=0.01)


@pytest.mark.skipif(sys.platform != "linux", reason="the counts are Linux's")
def test_another_process():
    """A process that computes without end is seen."""
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as other:
        cores = BusyCores()
        time.sleep(LEAST + 0.1)
        others = cores.of_others()
        other.kill()
    assert others > 0.4
