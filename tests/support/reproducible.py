"""Trainings in processes of their own, and comparisons of their files."""

import csv
import os
import subprocess

import torch
from support.scripts import COMMAND, PATHS, ROOT

from legged_torque.utils.runs import find_checkpoint

TIMES = ("seconds",)
"""Names of values that may differ between equal trainings."""


def start(folder, *words):
    """Start ``train.py``; its runs lie below a folder of its own."""
    command = [*COMMAND, ROOT / "scripts" / "train.py", *words, f"--log_root={folder}", "--logger=none"]
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "env": os.environ | PATHS}
    return subprocess.Popen(list(map(str, command)), text=True, cwd=folder.parent, **output)


def finish(*processes):
    """Wait for trainings, which must succeed, and whose worlds must not start anew."""
    try:
        for process in processes:
            output, _ = process.communicate(timeout=300)
            assert process.returncode == 0 and "start anew" not in output, output[-3000:]
    finally:
        for process in processes:
            process.kill()  # of those that would wait for one that has failed


def content(folder):
    """The contents of the last checkpoint below a folder and the rows of all evaluations, by name."""
    runs = sorted(folder.glob("*/*/"))
    checkpoint = torch.load(find_checkpoint(runs[-1], None), map_location="cpu", weights_only=True)
    rows = {}
    for file in sorted(folder.glob("*/*/evaluations*.csv")):
        rows.setdefault(file.name, []).extend(csv.DictReader(file.read_text().splitlines()))
    return dict(values({"checkpoint": checkpoint, **rows}))


def values(content, name=""):
    """All values of nested containers with their names, without :data:`TIMES`."""
    for key, part in content.items() if isinstance(content, dict) else enumerate(content):
        path = f"{name}.{key}" if name else str(key)
        if isinstance(part, (dict, list, tuple)):
            yield from values(part, path)
        elif key not in TIMES:
            yield path, part


def differences(one, other):
    """Names of values that are not equal to the bit."""

    def equal(value, twin):
        if isinstance(value, torch.Tensor) and isinstance(twin, torch.Tensor):
            return value.dtype == twin.dtype and torch.equal(value, twin)
        return type(value) is type(twin) and value == twin

    return sorted(name for name in one.keys() | other.keys() if not equal(one.get(name), other.get(name)))
