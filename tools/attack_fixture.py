"""What bad input is made from: a folder with a small file of every kind, and short command lines of all scripts."""

from __future__ import annotations

import contextlib
import importlib
import os
import pkgutil
import runpy
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import yaml

import legged_torque
from legged_torque import RESOURCES_DIR, SCRIPTS_DIR
from legged_torque.envs import task_registry
from legged_torque.utils.cli import Parser
from legged_torque.utils.options import Options
from tools.attack import ACCEPTED, Case, attack

RUN = "logs/a1_position/run"
CONFIG, CHECKPOINT, EVALUATIONS = f"{RUN}/config.yaml", f"{RUN}/model_1.pt", f"{RUN}/evaluations.csv"
WORLDS = f"{RUN}/worlds_1.pt"
PRETRAINED = "logs/pretrained/a1_torque_gravity.pt"
DESCRIPTION, NETWORK = "exported/policy.yaml", "exported/policy.onnx"
ROBOT, PLAN, RESULTS = "robot.xml", "plan.yaml", "results"
METRICS, CURVE, REPORT = "metrics.json", "curve.json", "report.json"
CELL = f"{RESULTS}/a1_position-none-s1"

_SETTINGS = ("runner.num_steps_per_env=4", "actor.hidden_dims=[8]", "critic.hidden_dims=[8]")
_SMALL = ("--device=cpu", "--num_envs=2", *(f"--set={setting}" for setting in _SETTINGS))
_FEW = ("num_configurations=4", "num_steps=2", "num_rounds=1", "num_epochs=1", "batch_size=4", "held_out=0.5")
_PRETRAINING = tuple(f"--set=pretraining.{setting}" for setting in _FEW)
_LOADED = ("--device=cpu", "--task=a1_position", "--num_envs=2")
WORDS = {
    "train.py": ("--task=a1_position", *_SMALL, "--max_iterations=1", "--logger=none"),
    "pretrain_gravity.py": (*_SMALL, *_PRETRAINING),
    "play.py": (*_LOADED, "--steps=2"),
    "evaluate.py": (*_LOADED, "--steps=2"),
    "learning_curve.py": (*_LOADED, "--steps=2"),
    "physics_accuracy.py": (*_LOADED, "--steps=1"),
    "export.py": _LOADED,
    "import_robot.py": (ROBOT, "--name=robot", "--out=out"),
    "sim2sim.py": ("exported", "--steps=2", "--robots=1"),
    "experiment.py": (PLAN, "--device=cpu", "--dry-run"),
    "report.py": (RESULTS, "--out=out"),
    "plot.py": ("curves", CURVE, "--out=out.png"),
    "plot_randomization.py": (*_SMALL, "--out=out.png"),
    "plot_terrain.py": ("--out=out.png",),
    "benchmark.py": ("--task=a1_position", *_SMALL, "--rounds=1"),
    "check_capture.py": ("--task=a1_position", *_SMALL),
    "check_injections.py": ("--count=1",),
    "check_reproducible.py": ("--task=a1_position", *_SMALL, "--iterations=1", "--resumes=0"),
}
"""Command lines that are valid in the folder of :func:`make_fixture`, with as little work as possible."""
_PLAN = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1]}


class _StopError(Exception):
    """Ends a script when it reads its command line."""


def parsers() -> Iterator[tuple[str, Parser]]:
    """Yield the name of every script and its parser with all options."""
    for script in WORDS:
        found: list[Parser] = []

        def keep(parser: Parser, *_: object, found: list[Parser] = found) -> None:
            """Note the parser instead of parsing."""
            found.append(parser)
            raise _StopError

        with patch.object(Parser, "parse_args", keep), patch.dict(os.environ), patch.object(sys, "argv", [script]):
            try:
                runpy.run_path(str(SCRIPTS_DIR / script), run_name="__main__")
            except _StopError:
                yield script, found[0]


def warm_up() -> None:
    """Import what scripts import, build a task and step it, so that all is loaded before this process is forked."""
    for module in pkgutil.walk_packages(legged_torque.__path__, "legged_torque."):
        with contextlib.suppress(ImportError):  # of an extra that is not installed
            importlib.import_module(module.name)
    import torch

    task, _ = task_registry.make_env("a1_position", Options(task="a1_position", num_envs=2, device="cpu"))
    with torch.no_grad():
        task.step(torch.zeros(2, task.num_actions))


def make_fixture(folder: Path) -> None:
    """Fill a new folder with a run, its export and its metrics, a pre-trained policy, an experiment and a robot."""
    folder.mkdir()
    steps = [
        ("train.py", "--set=evaluation.interval=8", "--set=evaluation.num_samples=4"),
        ("pretrain_gravity.py", f"--json={REPORT}"),
        ("export.py", "--out=exported"),
        ("evaluate.py", f"--json={METRICS}"),
        ("learning_curve.py", f"--json={CURVE}"),
    ]
    for script, *words in steps:
        work = folder.with_name("work")
        (result,) = attack([Case(script, script, (*WORDS[script], *words))], folder, work)
        if result.outcome != ACCEPTED:
            raise RuntimeError(f"{script} {' '.join(result.case.words)}: {result.outcome}: {result.error}")
        shutil.rmtree(folder)
        shutil.move(work, folder)
        for run in (folder / "logs" / "a1_position").glob("20*"):
            run.rename(folder / RUN)
    shutil.copy(RESOURCES_DIR / "robots" / "a1" / "a1.xml", folder / ROBOT)
    (folder / PLAN).write_text(yaml.safe_dump(_PLAN), encoding="utf-8")
    (folder / CELL).mkdir(parents=True)
    shutil.copy(folder / PLAN, folder / RESULTS / "experiment.yaml")
    shutil.copytree(folder / RUN, folder / CELL / "run")
    shutil.copy(folder / METRICS, folder / CELL / "result_none.json")
