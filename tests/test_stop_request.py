"""Signals ask a training to stop, whenever they come."""

import io
import signal
import sys
import threading

import pytest

from legged_torque.utils.interrupt import StopRequest


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stop_request(number):
    """The first signal asks, the second one raises, and afterwards the signals do what they did before."""
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt), StopRequest() as stop:
        assert not stop.requested
        assert signal.getsignal(number) not in before  # or raising it would end the tests
        signal.raise_signal(number)
        assert stop.requested
        signal.raise_signal(number)
        pytest.fail("the second signal did not raise")
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == before


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
