"""Processes that torchrun has started, or should have, without the others, and means over such processes."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from support.settings import error_of, parse

from legged_torque.envs import task_registry
from legged_torque.utils import distributed, shared_mean
from legged_torque.utils.devices import resolve_device
from legged_torque.utils.errors import UserError
from legged_torque.utils.task_registry import num_iterations, set_seed


@pytest.fixture
def second_of_two(monkeypatch):
    """The environment in which torchrun starts the second of two processes."""
    for key, value in {"WORLD_SIZE": 2, "RANK": 1, "LOCAL_RANK": 1, "LOCAL_WORLD_SIZE": 2}.items():
        monkeypatch.setenv(key, str(value))
    return monkeypatch


def test_every_process_has_its_gpu(second_of_two):
    """It is the one with the process's number; too few GPUs, or one for all, are refused."""
    second_of_two.setattr(torch.cuda, "device_count", lambda: 2)
    assert [resolve_device(name) for name in (None, "auto", "cuda", "cpu")] == ["cuda:1", "cuda:1", "cuda:1", "cpu"]
    assert error_of(resolve_device, "cuda:0").startswith("with torchrun each process takes a GPU of its own: leave out")
    second_of_two.setattr(torch.cuda, "device_count", lambda: 1)
    line = error_of(resolve_device, "auto")
    assert line == "torchrun has started 2 processes on a machine with 1 GPU(s)"
    second_of_two.setattr(torch.cuda, "device_count", lambda: 0)
    assert resolve_device("auto") == "cpu"


def test_length_of_a_training(second_of_two):
    """The steps of a whole training are those of all processes; each has its own random numbers, no other seed's."""
    args = parse("--task=a1_position", "--num_envs=100", "--set=runner.total_steps=9601")
    _, train_cfg = task_registry.get_cfgs("a1_position", args)
    env = type("Task", (), {"num_envs": 100})
    assert num_iterations(env, train_cfg) == 3  # 9601 / (2 * 100 * 24)
    set_seed(5)
    drawn = torch.rand(3)
    for seed in range(5, 105):
        torch.manual_seed(seed)
        assert not torch.equal(torch.rand(3), drawn)


def test_processes_without_the_others(second_of_two):
    """A stray WORLD_SIZE, and a first process that does not answer, are reported in one line."""
    second_of_two.delenv("MASTER_ADDR", raising=False)
    assert error_of(distributed.join, "cpu").startswith("WORLD_SIZE is 2, but torchrun has not started this process")
    second_of_two.setenv("MASTER_ADDR", "127.0.0.1")
    second_of_two.setenv("MASTER_PORT", "1")
    late = Mock(side_effect=torch.distributed.DistNetworkError("The client has timed out\nwith a trace"))
    second_of_two.setattr(torch.distributed, "init_process_group", late)
    assert error_of(distributed.join, "cpu") == "the 2 processes do not find each other: The client has timed out"


def test_processes_with_other_settings(second_of_two):
    """The first setting that differs is told."""
    second_of_two.setattr(distributed, "gather", lambda mine: [mine, {**mine, "env.env.num_envs": 3}])
    line = error_of(distributed.check_same, {"task": "t", "env.env.num_envs": 2})
    assert line.endswith("must have the same settings: env.env.num_envs is 3 in process 1, but 2 in the first one")
    second_of_two.setattr(distributed, "gather", lambda mine: [mine, dict(mine)])
    distributed.check_same({"task": "t", "weight": float("nan")})


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends processes with their parent")
def test_a_parent_that_is_killed_at_once():
    """What it was about to start is not started, although it could not yet ask to end with it."""
    program = "import os, subprocess; from legged_torque.utils.distributed import ending_with_parent\n"
    program += "subprocess.Popen(ending_with_parent(['sh', '-c', 'echo started; sleep 9'])); os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, timeout=60).stdout == b""


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
    results, lost, listens = {}, [], [Path(os.environ[shared_mean.ADDRESS]).exists()]

    def run(rank):
        mean = shared_mean.SharedMean(rank, RANKS)
        if rank == 0:  # all are there
            listens.append(Path(mean._address).exists())
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
    assert listens == [True, False]  # is there a file of the socket?
    for number in range(ROUNDS):
        expected = np.mean([numbers(rank, number) for rank in range(RANKS)], axis=0)
        for rank in range(RANKS):
            np.testing.assert_allclose(results[rank, number], expected, rtol=1e-5, atol=1e-6)
            assert np.array_equal(results[rank, number], results[0, number])
    assert len(lost) == 2 and "has ended" in lost[0]
