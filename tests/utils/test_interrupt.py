"""Signals ask a training to stop, whenever they come."""

import fcntl
import io
import os
import pty
import signal
import subprocess
import sys
import termios
import threading
from pathlib import Path

import pytest

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


def test_stop_request_without_a_signal():
    """Nothing is asked, and the signals are given back."""
    before = signal.getsignal(signal.SIGINT)
    with StopRequest() as stop:
        assert signal.getsignal(signal.SIGINT) != before
    assert not stop.requested and signal.getsignal(signal.SIGINT) == before


def test_stop_request_outside_the_main_thread():
    """Another thread cannot take over signals, and works without."""
    results = []

    def work():
        with StopRequest() as stop:
            results.append((stop.requested, signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert results == [(False, signal.getsignal(signal.SIGINT))]


def test_signal_while_printing(monkeypatch):
    """A signal that arrives while a line is being written asks to stop like any other."""

    class Terminal(io.RawIOBase):
        """Takes Ctrl-C while it writes the first time."""

        written = b""

        def writable(self):
            return True

        def write(self, data):
            if not self.written:
                self.written = bytes(data)
                signal.raise_signal(signal.SIGINT)
            return len(data)

    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BufferedWriter(Terminal())))
    with StopRequest() as stop:
        print("Learning iteration 1", flush=True)
    assert stop.requested


IN_A_TERMINAL = """
import os, sys, time
from legged_torque.utils.interrupt import StopRequest
with StopRequest() as stop:
    print("ready", flush=True)
    while not stop.requested:
        time.sleep(0.01)
    for _ in range(3):
        print("iteration", flush=True)  # the terminal is gone: this would fail
    time.sleep(0.1)  # time for a second signal
    open(sys.argv[1], "w").write(str(stop.number))
"""


@pytest.mark.parametrize("before", ["", "signal.signal(signal.SIGHUP, signal.SIG_IGN)"])
def test_a_terminal_that_closes(tmp_path, before):
    """It asks to stop, and what is printed afterwards harms nothing; under nohup it does not even ask."""
    code = f"import signal; {before}{IN_A_TERMINAL}"
    master, slave = pty.openpty()
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    command = [sys.executable, "-c", code, str(tmp_path / "number")]
    streams = {"stdin": slave, "stdout": slave, "stderr": slave}
    process = subprocess.Popen(command, **streams, env=environment, preexec_fn=take_terminal)
    os.close(slave)
    line = b""
    while not line.endswith(b"\n"):  # or the terminal would close while the line is being written
        line += os.read(master, 100)
    assert line.strip() == b"ready"
    os.close(master)
    if before:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.5)
        process.terminate()
    process.send_signal(signal.SIGHUP)
    assert process.wait(20) == (1 if before else 0)
    assert (tmp_path / "number").exists() != bool(before)
    if not before:
        assert (tmp_path / "number").read_text() == str(int(signal.SIGHUP))


def take_terminal():
    """Make standard input the terminal of a new session, which ends with it."""
    os.setsid()
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


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
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert "MuJoCo: Nan, Inf or huge value in QVEL" in result.stderr and not list(tmp_path.iterdir())
