"""Fixtures of all tests: tasks on the CPU, small and seeded."""

import contextlib
import functools
import gc
import importlib.metadata
import os
import sys
import tempfile
from pathlib import Path

os.environ["MUJOCO_GL"] = "disable"  # before anything imports mujoco: no test renders
os.environ["OMP_NUM_THREADS"] = "1"  # of scripts as well: a training in one process
if sys.dont_write_bytecode:  # the processes that tests start, many, would all compile the same modules for seconds
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = os.path.join(tempfile.gettempdir(), "legged_torque_pycache")

gc.set_threshold(50_000, 20, 100)  # a million objects of imports: looking through them took a tenth of the time
importlib.metadata.version = functools.cache(importlib.metadata.version)  # MuJoCo Warp asks at each simulation, slowly

import pytest
import torch
import warp
import yaml

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # before anything imports triton: kernels of the update run on the CPU
with contextlib.suppress(ImportError):
    import triton  # noqa: F401  # before a script in this process loads OSMesa: after that it crashes

from support.last_run import Recorder

from legged_torque.envs import task_registry
from legged_torque.utils.config import set_by_path
from legged_torque.utils.options import Options

for part in ("derivative", "forward", "passive", "sensor", "smooth"):  # large ones, for few and short simulations
    warp.get_module(f"mujoco_warp._src.{part}").options["optimization_level"] = 0  # half of the time to compile them

LONGEST = Path(__file__).with_name("longest.txt").read_text("utf-8").split()
"""Files that start first, so that no worker is left alone with one; the first two compile different kernels."""


def pytest_configure(config):
    """Keep a record of the tests that need a GPU; with pytest-xdist, only its controller does."""
    config.option.loadscopereorder = False  # of pytest-xdist: it would start files with many tests first
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Recorder(config))


def pytest_collection_modifyitems(items):
    """Put the longest files first."""
    order = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.nodeid.removeprefix("tests/").partition(".py")[0], len(order)))


@pytest.fixture(scope="session", autouse=True)
def current_dir(tmp_path_factory):
    """Where tests run: a temporary folder, so that logs and MuJoCo's MUJOCO_LOG.TXT do not land in the repository."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("current_dir"))
        yield


@pytest.fixture(scope="session")
def make_task():
    """Factory of tasks: ``make_task("a1_torque", num_envs=2, **{"control.decimation": 2})``."""

    def make(name, num_envs=4, seed=1, **overrides):
        """Build a registered task on the CPU, all random numbers seeded; ``overrides`` go by dotted path."""
        env_cfg, _ = task_registry.get_cfgs(name)
        for path, value in {"env.num_envs": num_envs, **overrides}.items():
            set_by_path(env_cfg, path, value)
        torch.manual_seed(seed)
        return task_registry.make_env(name, Options(device="cpu"), env_cfg)[0]

    return make


@pytest.fixture(scope="session")
def exported(make_task, tmp_path_factory):
    """Folder of an export of ``a1_torque_multihead``."""
    from support.exports import export_random

    folder = tmp_path_factory.mktemp("export") / "out"
    export_random(make_task, "a1_torque_multihead", folder)
    return folder


@pytest.fixture(scope="session")
def exported_go2(make_task, tmp_path_factory):
    """The same of ``go2_torque_multihead``."""
    from support.exports import export_random

    export_random(make_task, "go2_torque_multihead", folder := tmp_path_factory.mktemp("export") / "out")
    return folder


@pytest.fixture(scope="session")
def description(exported):
    """The contents of its ``policy.yaml``."""
    return yaml.safe_load((exported / "policy.yaml").read_text())


@pytest.fixture(scope="session")
def policy(exported):
    """The policy; tests reset it before they use it."""
    from legged_torque.deploy.policy import Policy

    return Policy(exported)
