"""Steps in real time."""

import pytest
from support.clock import Clock

from legged_torque.viewer.pacing import MAX_LAG, Pacer


def test_pacer_real_time():
    """Steps come in time, however long they take, as long as that is shorter than a step."""
    clock = Clock()
    pacer = Pacer(0.02, clock, clock.sleep)
    begun = []
    for work in [0.005, 0.015, 0.0, 0.019] * 10:
        pacer.wait()
        begun.append(clock.now)
        clock.now += work
    assert begun == pytest.approx([100.0 + 0.02 * i for i in range(40)])
    assert pacer.rate == pytest.approx(1.0)


def test_pacer_behind():
    """A short delay is caught up, a long one forgotten; a machine that is too slow never sleeps and says how slow."""
    clock = Clock()
    pacer = Pacer(0.02, clock, clock.sleep)
    pacer.wait()
    clock.now += 0.05
    for _ in range(3):
        pacer.wait()
    assert clock.now == pytest.approx(100.06)
    clock.now += 2 * MAX_LAG
    begun = len(clock.slept)
    pacer.wait()
    pacer.wait()
    assert len(clock.slept) == begun + 1  # no rush of steps
    pacer.restart()
    clock.slept.clear()
    for _ in range(60):
        pacer.wait()
        clock.now += 0.04
    assert not clock.slept and pacer.rate == pytest.approx(0.5)
