"""Shared by tests: clock."""


class Clock:
    """A clock that only moves when someone sleeps, or by hand."""

    def __init__(self):
        self.now, self.slept = 100.0, []

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.slept.append(seconds)
        self.now += seconds
