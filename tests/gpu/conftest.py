"""Tests of what a CPU cannot show: several threads per world, CUDA graphs, compiled kernels, several processes."""

import gc
import os

import pytest
import torch

from legged_torque.sim.graph import prepare_device


@pytest.fixture(scope="session", autouse=True)
def device():
    """The GPU; ``GPU_TESTS_DEVICE=cpu`` runs what can run without one, to try a test while it is being written."""
    chosen = os.environ.get("GPU_TESTS_DEVICE", "cuda:0")
    if chosen != "cpu" and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    prepare_device(chosen)
    return chosen


@pytest.fixture(autouse=True)
def _no_garbage():
    """Free what a test has left before the next one captures a graph."""
    yield
    gc.collect()
