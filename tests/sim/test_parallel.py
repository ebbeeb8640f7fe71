"""Worlds on several cores of a CPU are the same worlds, to the bit."""

import threading

import pytest
import torch

from legged_torque.sim.parallel import MIN_WORLDS

NUM_ENVS = 4 * MIN_WORLDS + 3  # no number of parts divides it
STEPS = 12


@pytest.fixture
def set_threads():
    """Return a function that sets torch's number of threads until the test ends."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def walk(make_task):
    """States and contact forces of worlds that differ in all that can be drawn, after each of some random actions."""
    task = make_task("a1_torque_multihead", NUM_ENVS, **{"domain_rand.randomize_parameters": True})
    found = []
    for _ in range(STEPS):
        task.step(torch.randn(NUM_ENVS, task.num_actions))
        found.append(torch.cat([task.sim.qpos, task.sim.qvel, task.sim.ctrl, task.sim.contact_force.flatten(1)], dim=1))
    return torch.stack(found)


@pytest.mark.parametrize("threads", [2, 3, 64])
def test_number_of_threads_changes_no_bit(make_task, set_threads, threads):
    """Each world is simulated once, as by one thread, and with parameters of its own."""
    set_threads(1)
    expected = walk(make_task)
    set_threads(threads)
    assert torch.equal(walk(make_task), expected)
    assert (expected[1:] != expected[:-1]).any(dim=2).all() and len(expected[-1].unique(dim=0)) == NUM_ENVS
    waiting = [thread for thread in threading.enumerate() if thread.name.startswith("worlds")]
    assert len(waiting) >= min(threads, NUM_ENVS // MIN_WORLDS) - 1
