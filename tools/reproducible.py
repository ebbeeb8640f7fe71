"""Whether a training gives the same bits when it is repeated, stopped and resumed, or killed and resumed.

Trainings run as processes of their own, as a user starts them.
"""

from __future__ import annotations

import contextlib
import csv
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from legged_torque import SCRIPTS_DIR
from legged_torque.learning import checkpoint
from legged_torque.utils.files import is_whole_archive
from legged_torque.utils.runs import CONFIG_FILE, EVALUATIONS_FILE, checkpoint_number, find_checkpoint, find_run

TIMES = ("seconds",)  # what may differ, by name, in checkpoints and evaluations
MOST_ITERATIONS = 3  # of a training before it is killed
STARTING = 8.0  # seconds within which a training is killed that has not begun to learn
SAVING = 0.3  # seconds within which it is killed after an iteration
ENDLESS = 10**6  # iterations
_ITERATION = re.compile(r"Learning iteration (\d+)/")


@dataclass
class Comparison:
    """What two trainings have in common."""

    name: str  # how the second one differs from the first
    compared: int  # numbers, tensors and cells of tables
    different: list[str]  # names of those that are not equal to the bit


@dataclass
class Kills:
    """What kills have left behind."""

    count: int = 0
    most_lost: int = 0  # iterations that one kill has lost
    broken: list[str] = field(default_factory=list)  # files and folders that are not whole


class Training:
    """A training of a command line, in as many runs as it is stopped or killed, below a folder of its own."""

    def __init__(self, words: Sequence[str], folder: Path, processes: int = 1) -> None:
        """Prepare; nothing is started yet. ``words`` are those of ``train.py``."""
        self.folder, self._words, self._processes = folder, words, processes

    def run_until(self, iterations: int) -> None:
        """Train up to this many iterations, from the last checkpoint if there is one; RuntimeError if that fails."""
        process = self._start(iterations)
        output, _ = process.communicate()
        if process.returncode or "start anew" in output:
            raise RuntimeError(f"training did not go on as it should:\n{output[-3000:]}")

    def kill(self, chance: random.Random) -> int:
        """Train and kill all processes at a random moment; return how many iterations were completed by then."""
        wanted = chance.randint(0, MOST_ITERATIONS)
        process, done = self._start(ENDLESS), 0
        try:
            if wanted:
                assert process.stdout is not None
                for line in process.stdout:
                    found = _ITERATION.search(line)
                    if found:
                        done, wanted = int(found[1]) + 1, wanted - 1
                    if not wanted:
                        break
            time.sleep(chance.uniform(0.0, SAVING if done else STARTING))
        finally:
            kill_family(process.pid)
            process.communicate()
        return done

    def checkpoint(self) -> Path | None:
        """Return the file from which training goes on."""
        return find_checkpoint(find_run(self._experiment, None), None) if self._has_checkpoint() else None

    def evaluations(self) -> dict[str, list[dict[str, str]]]:
        """Return the rows of all evaluations by their file; those of a later run replace what it has repeated."""
        rows: dict[str, list[dict[str, str]]] = {}
        for file in sorted(self._experiment.glob(f"*/{Path(EVALUATIONS_FILE).stem}*.csv")):
            new = list(csv.DictReader(file.read_text().rpartition("\n")[0].splitlines()))
            before = rows.get(file.name, [])
            rows[file.name] = [row for row in before if not new or int(row["steps"]) < int(new[0]["steps"])] + new
        return rows

    def broken(self) -> list[str]:
        """Return the names of files and folders that are not whole."""
        files = [file for kind in ("model", "worlds") for file in self._experiment.glob(f"*/{kind}_*.pt")]
        folders = [path for path in self._experiment.glob("*/") if not (path / CONFIG_FILE).is_file()]
        return [str(path) for path in [*(file for file in files if not is_whole_archive(file)), *folders]]

    @property
    def _experiment(self) -> Path:
        """Folder of the runs."""
        return self.folder / "trained"

    def _has_checkpoint(self) -> bool:
        """Return whether there is anything to go on from."""
        return any(self._experiment.glob("*/model_*.pt"))

    def _start(self, iterations: int) -> subprocess.Popen[str]:
        """Start the processes of a training."""
        many = ["-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={self._processes}"]
        command = [sys.executable, *(many if self._processes > 1 else []), str(SCRIPTS_DIR / "train.py"), *self._words]
        command += [f"--log_root={self.folder}", f"--experiment_name={self._experiment.name}"]
        command += [f"--max_iterations={iterations}", "--verbose", *(["--resume"] if self._has_checkpoint() else [])]
        return subprocess.Popen(
            command,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )


def kill_family(process: int) -> None:
    """Kill a process and its children, which torchrun starts in sessions of their own."""
    children = [file.read_text().split() for file in Path(f"/proc/{process}/task").glob("*/children")]
    for each in [process, *(int(child) for part in children for child in part)]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(each, signal.SIGKILL)


def compare(name: str, first: Training, second: Training) -> Comparison:
    """Compare the last checkpoints of two trainings and all their evaluations, apart from :data:`TIMES`."""
    contents = []
    for training in (first, second):
        file = training.checkpoint()
        assert file is not None, f"'{training.folder}' has no checkpoint"
        content = {"checkpoint": checkpoint.read(file, "checkpoint", "cpu"), **training.evaluations()}
        contents.append(dict(values(content)))
    one, other = contents
    names = one.keys() | other.keys()
    return Comparison(name, len(names), sorted(key for key in names if not equal(one.get(key), other.get(key))))


def values(content: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield all that nested containers hold, by name, apart from :data:`TIMES`."""
    parts = content.items() if isinstance(content, dict) else enumerate(content)
    for key, part in parts:
        path = f"{name}.{key}" if name else str(key)
        if isinstance(part, (dict, list, tuple)):
            yield from values(part, path)
        elif key not in TIMES:
            yield path, part


def equal(one: Any, other: Any) -> bool:
    """Return whether two values are equal to the bit."""
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        return one.dtype == other.dtype and torch.equal(one, other)
    return type(one) is type(other) and one == other


def kill_often(training: Training, kills: int, save_interval: int, chance: random.Random) -> tuple[Kills, int]:
    """Kill a training again and again, each time resumed; return what is left and the iterations of its checkpoint.

    The training saves every ``save_interval`` iterations. A kill that loses more is told as a broken file is.
    """
    left, saved = Kills(kills), 0
    for _ in range(kills):
        done = training.kill(chance)
        file = training.checkpoint()
        before, saved = saved, checkpoint_number(file) if file else 0
        lost = max(done, before) - saved
        left.most_lost = max(left.most_lost, lost)
        if lost > save_interval:
            left.broken.append(f"{lost} iterations lost")
        left.broken += training.broken()
    return left, saved
