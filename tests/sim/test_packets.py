"""Packets that are late, jitter and get lost: as a queue in numpy."""

import numpy as np
import pytest
import torch
import warp as wp

from legged_torque.sim.packets import PacketQueue, Queue, received_packet

WORLDS = 400

wp.init()


@wp.kernel(module="unique")
def fate(seeds: wp.array(dtype=int), loss: float, jitter: int, lost: wp.array(dtype=int), late: wp.array(dtype=int)):
    """Draw whether a packet is lost, and by how much it is later."""
    world = wp.tid()
    state = wp.rand_init(seeds[world], 0)
    if wp.randf(state) < loss:
        lost[world] = 1
    late[world] = wp.randi(state, 0, jitter + 1)


@wp.kernel(module="unique")
def receive(queue: Queue, elapsed: int, received: wp.array2d(dtype=float)):
    """Copy what each world has received."""
    world, column = wp.tid()
    received[world, column] = received_packet(queue, world, elapsed)[column]


def received(queue, elapsed=0):
    """What each world has received, by torch and by a kernel alike."""
    in_torch, in_kernel = queue.received(elapsed), torch.zeros(WORLDS, 2)
    wp.launch(receive, in_kernel.shape, [queue.reads(), elapsed, wp.from_torch(in_kernel)])
    assert torch.equal(in_torch, in_kernel)
    return in_torch.numpy()


@pytest.mark.parametrize(
    ("interval", "times", "unit", "jitter", "loss"),
    [
        (4, (0, 6), 1, 0, 0.0),
        (4, (1, 6), 1, 5, 0.3),
        (3, (0, 2), 3, 2, 0.3),
        (1, (0, 3), 1, 4, 0.2),
        (4, (0, 0), 1, 0, 0.4),
    ],
)
def test_queue(interval, times, unit, jitter, loss):
    """At each physics step: the newest packet that has arrived by then, or the start's."""
    torch.manual_seed(0)
    queue = PacketQueue(torch.zeros(WORLDS, 2), interval, times, unit, jitter, loss)
    delays = np.random.default_rng(0).integers(times[0], times[1] + 1, WORLDS)
    queue.drawn[:, 0] = torch.tensor(delays)
    held, newest = np.zeros((WORLDS, 2)), np.full(WORLDS, -1)
    sent, all_lost, all_late, overtaken = [], [], [], 0
    for number in range(30):
        queue.draw()
        packet = np.random.default_rng(number).normal(size=(WORLDS, 2)).astype(np.float32)
        queue.send(torch.tensor(packet[:, :1]), torch.tensor(packet[:, 1:]))
        lost, late = wp.zeros(WORLDS, dtype=int), wp.zeros(WORLDS, dtype=int)
        if jitter or loss:
            wp.launch(fate, WORLDS, [wp.from_torch(queue.seeds), loss, jitter, lost, late])
        arrival = number * interval + unit * (delays + late.numpy())
        sent.append((packet, np.where(lost.numpy(), 10**9, arrival)))
        all_lost.append(lost.numpy())
        all_late.append(late.numpy())
        for elapsed in range(interval):
            for i, (values, at) in enumerate(sent):
                arrives = at == number * interval + elapsed
                overtaken += (arrives & (i < newest)).sum()
                held[arrives & (i > newest)] = values[arrives & (i > newest)]
                newest[arrives & (i > newest)] = i
            assert np.array_equal(received(queue, elapsed), held.astype(np.float32))
    assert abs(np.mean(all_lost) - loss) < 0.02 and (overtaken > 100) == (jitter * unit > interval)
    assert np.ptp(np.bincount(np.ravel(all_late), minlength=jitter + 1)) < 0.1 * 30 * WORLDS
    queue.restart(torch.arange(WORLDS) < 5, torch.full((WORLDS, 2), 7.0))
    assert (received(queue)[:5] == 7.0).all() and not (received(queue)[5:] == 7.0).any()
