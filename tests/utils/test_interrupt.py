"""Signals ask a training to stop, whenever they come."""

import io
import os
import signal
import subprocess
import sys

import pytest
from support.scripts import ROOT

from legged_torque.utils.interrupt import SIGNALS, StopRequest


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stop_request(number):
    """The first signal asks, the second one raises, and afterwards the signals do what they did before."""
    before = [signal.getsignal(each) for each in SIGNALS]
    with pytest.raises(KeyboardInterrupt), StopRequest() as stop:
        assert not stop.requested
        assert signal.getsignal(number) not in before  # or raising it would end the tests
        signal.raise_signal(number)
        assert stop.requested and stop.number == number
        signal.raise_signal(number)
        pytest.fail("the second signal did not raise")
    assert [signal.getsignal(each) for each in SIGNALS] == before


def test_signal_while_printing(monkeypatch):
    """A signal that arrives while a line is being written asks to stop like any other."""

    class Terminal(io.RawIOBase):
        """Takes Ctrl-C while it writes the first time."""

        def writable(self):
            return True

        def write(self, data):
            if not stop.requested:
                signal.raise_signal(signal.SIGINT)
            return len(data)

    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BufferedWriter(Terminal())))
    with StopRequest() as stop:
        print("Learning iteration 1", flush=True)
    assert stop.requested


def test_broken_pipe():
    """Ctrl-C also ends what reads the output, as ``tee`` does: it is still a request."""
    code = "import os; from legged_torque.utils.interrupt import *; r, w = os.pipe(); os.dup2(w, 2); os.close(w); "
    code += "os.close(r)\nwith StopRequest() as stop: signal.raise_signal(signal.SIGINT)\nprint(stop.requested)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True).stdout == "True\n"


def test_under_nohup():
    """A terminal that closes does not ask to stop."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not stop.requested


def test_mujoco_leaves_no_file(tmp_path):
    """Its warnings go to standard error."""
    code = """
import numpy
from legged_torque.utils.cli import slow_imports, run_script
def main():
    with slow_imports():
        import mujoco
    ball = "<body><freejoint/><geom size='1'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{ball}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    data.qvel[:] = numpy.nan
    mujoco.mj_step(model, data)
run_script(main)
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert "MuJoCo: Nan, Inf or huge value in QVEL" in result.stderr and not list(tmp_path.iterdir())
