"""A clock that stands still, and waiting by the real one."""

import time


class Clock:
    """A clock that only moves when someone sleeps, or by hand."""

    def __init__(self):
        self.now, self.slept = 100.0, []

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds


def wait_for(condition, timeout=150.0):
    """Wait until a condition holds [s], and return its value."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError(f"no end of waiting for {condition.__name__}")
