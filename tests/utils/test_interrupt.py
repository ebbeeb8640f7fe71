"""Signals ask a training to stop, whenever they come."""

import io
import os
import signal
import subprocess
import sys

import pytest
from support.scripts import ROOT
from support.terminal import in_a_terminal

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


IN_A_TERMINAL = """
import fcntl, os, signal, sys, termios, time
from legged_torque.utils.interrupt import StopRequest
fcntl.ioctl(0, termios.TIOCSCTTY, 0)  # whose end is that of the session
{before}
with StopRequest() as stop:
    print("ready", flush=True)
    end = time.monotonic() + {seconds}
    while not stop.requested and time.monotonic() < end:
        time.sleep(0.01)
    if stop.requested:
        os.kill(os.getpid(), signal.SIGHUP)  # once more
        for _ in range(3):
            print("iteration", flush=True)  # the terminal is gone: this would fail
os._exit(10 + stop.number)
"""


@pytest.mark.parametrize(
    ("before", "seconds", "number"), [("", 20, signal.SIGHUP), ("signal.signal(signal.SIGHUP, signal.SIG_IGN)", 0.5, 0)]
)
def test_a_terminal_that_closes(before, seconds, number):
    """It asks to stop, and what is printed afterwards harms nothing; under nohup it does not even ask."""
    code = IN_A_TERMINAL.format(before=before, seconds=seconds)
    assert in_a_terminal(code, after="ready", close=True)[0] == 10 + number


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
