"""Tests that need a GPU: several threads per world, CUDA graphs, compiled kernels, several processes."""

import gc
import os

import pytest
import torch

from legged_torque.sim.graph import prepare_device


@pytest.fixture(scope="session", autouse=True)
def device():
    """The GPU; ``GPU_TESTS_DEVICE=cpu`` tries tests on a CPU while they are being written."""
    chosen = os.environ.get("GPU_TESTS_DEVICE", "cuda:0")
    if chosen != "cpu" and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    prepare_device(chosen)
    return chosen


@pytest.fixture(autouse=True)
def _no_garbage():
    """Free the memory of a test before the next one captures a graph."""
    yield
    gc.collect()
