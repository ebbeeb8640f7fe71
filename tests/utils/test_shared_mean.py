"""Means over processes by shared memory; threads stand in for the processes."""

import threading
import time

import numpy as np
import torch

from legged_torque.utils import shared_mean
from legged_torque.utils.errors import UserError

RANKS, ROUNDS = 3, 30


def numbers(rank, number):
    """What a process brings to a meeting; sizes take turns."""
    return np.random.default_rng([rank, number]).normal(size=(7, 1000)[number % 3 == 0]).astype(np.float32)


def test_means(monkeypatch):
    """Each process gets the mean of all, however slow the others are; those that are left hear of one that ends."""
    monkeypatch.setattr(shared_mean, "_listeners", [])
    for name in (shared_mean.ADDRESS, shared_mean._KEY):
        monkeypatch.setenv(name, "")  # put back afterwards
    shared_mean.listen()
    results, lost = {}, []

    def run(rank):
        mean = shared_mean.SharedMean(rank, RANKS)
        for number in range(ROUNDS):
            time.sleep(0.003 * np.random.default_rng([rank, number, 1]).random())
            results[rank, number] = mean.average(torch.tensor(numbers(rank, number))).numpy()
        if rank == 1:
            mean._others[0].close()  # as when a process ends
            return
        try:
            mean.average(torch.zeros(7))
        except UserError as error:
            lost.append(str(error))
            for other in mean._others:
                other.close()

    threads = [threading.Thread(target=run, args=(rank,), daemon=True) for rank in range(RANKS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    for number in range(ROUNDS):
        expected = np.mean([numbers(rank, number) for rank in range(RANKS)], axis=0)
        for rank in range(RANKS):
            np.testing.assert_allclose(results[rank, number], expected, rtol=1e-5, atol=1e-6)
            assert np.array_equal(results[rank, number], results[0, number])
    assert len(lost) == 2 and "has ended" in lost[0]
