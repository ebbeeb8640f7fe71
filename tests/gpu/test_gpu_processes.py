"""Two processes that train one policy.

Started with a folder and how to exchange tensors, this file is one of them, see :func:`main`.
"""

import gc
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from support.on_device import make_runner
from support.reproducible import differences, finish
from support.rollouts import state_of

from legged_torque.utils import distributed

SMALL = ["--task=a1_torque_multihead", "--num_envs=256", "--perturbation=low", "--logger=none"]
SMALL += ["--set=runner.num_steps_per_env=8", "--set=algorithm.num_mini_batches=2", "--set=evaluation.interval=0"]
SMALL += ["--set=algorithm.annealing_start=1"]  # trainings of other lengths are compared
ALL_STEPS = 2 * 256 * 8
"""Environment steps of an iteration of both processes."""


def main(folder, exchange):
    """Train in one of two processes, go on from a checkpoint, and note what came of it."""
    if exchange == "gloo":  # NCCL refuses two processes on one GPU
        torch.distributed.init_process_group("gloo")
    device = os.environ.get("GPU_TESTS_DEVICE", "auto")
    words = [*SMALL, f"--set=runner.capture={exchange == 'nccl'}"]  # gloo's work is no part of a graph
    notes = train(folder, device, words)
    gc.collect()  # no graph is left with NCCL's work in it, for which the end would wait
    resumed = make_runner(device, *words)
    resumed.resume(str(folder / "kept" / "model_2.pt"))
    resumed.learn(1)
    torch.save(notes | {"resumed": state_of(resumed.alg)}, folder / f"{distributed.rank()}.pt")
    resumed.close()


def train(folder, device, words):
    """Train for three iterations, and keep the run as it was after two."""
    runner = make_runner(device, *words, log_root=folder / "logs")
    if distributed.rank() == 0:
        runner.claim_log_dir({})
    notes = {"start": state_of(runner.alg)}
    runner.learn(2, init_at_random_ep_len=True)
    notes |= {"trained": state_of(runner.alg), "worlds": runner.env.sim.qpos.clone()}
    if distributed.rank() == 0:
        shutil.copytree(runner.log_dir, folder / "kept")
    distributed.any_process(False, runner.env.device)  # waits for the copy
    runner.learn(1)
    return notes | {"third": state_of(runner.alg), "steps": runner.env.total_steps.clone()}


@pytest.mark.parametrize("exchange", ["gloo", "nccl"])
def test_two_processes(device, tmp_path, exchange):
    """They have the same networks in other worlds, count the steps of both, and resume to the bit.

    With gloo they share a GPU, as if each were alone on a machine; with NCCL each has its own, and all is captured.
    """
    if exchange == "nccl" and torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1]), "WORLD_SIZE": "2"}
    processes = []
    for rank in range(2):
        place = (rank, 2) if exchange == "nccl" else (0, 1)
        ranks = dict(zip(("RANK", "LOCAL_RANK", "LOCAL_WORLD_SIZE"), map(str, (rank, *place)), strict=True))
        paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
        processes.append(
            subprocess.Popen(
                [sys.executable, __file__, str(tmp_path), exchange],
                env=os.environ | address | ranks | {"PYTHONPATH": paths},
                text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            )
        )  # fmt: skip
    finish(*processes)
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True, map_location="cpu") for rank in range(2))
    assert differences(first["start"], second["start"])
    for moment in ("trained", "third", "resumed"):
        assert differences(first[moment], second[moment]) == []
    assert differences(first["third"], first["trained"])
    assert differences(first["third"], first["resumed"]) == []
    assert not torch.equal(first["worlds"], second["worlds"])
    assert int(first["steps"]) == int(second["steps"]) == 3 * ALL_STEPS


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
