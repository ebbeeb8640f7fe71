"""Scripts in this process and in one of their own."""

import contextlib
import io
import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-u"]
PATHS = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
"""Start a process that imports what this one can."""
SMALL = ["--task=a1_position", "--device=cpu", "--num_envs=2", "--set=runner.num_steps_per_env=4", "--max_iterations=2"]


def run_here(script, *words, root):
    """Run a script in this process in ``root``; return status, output and errors without lines about kernels."""
    output, error, status = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(output), contextlib.redirect_stderr(error):
        patch.chdir(root)
        patch.setattr(sys, "argv", [script, *words])
        patch.setenv("MUJOCO_GL", "disable")  # given back afterwards: play.py chooses another one
        try:
            runpy.run_path(str(ROOT / "scripts" / script), run_name="__main__")
        except SystemExit as stop:
            status = stop.code or 0
    lines = error.getvalue().splitlines(keepends=True)
    others = [line for line in lines if not line.startswith("compiling kernels")]
    return status, output.getvalue(), "".join(others)


def contents(folder):
    """Every file and folder below a folder, with its time and size."""
    return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in folder.rglob("*")}


def assert_told_in_one_line(result, message):
    """The exit status is 2 and standard error one line that begins with ``error:`` and holds the message."""
    status, _, error = result
    assert error.startswith("error: ") and error.count("\n") == 1 and error.endswith("\n"), error
    assert message in error
    assert status == 2


_LIGHT = """import json, runpy, sys
for path, *words in json.loads(sys.argv[1]):
    sys.argv, status = [path, *words], 0
    try:
        runpy.run_path(path, run_name="__main__")
    except SystemExit as end:
        status = end.code or 0
    print()
    print("result:", json.dumps([status, *(name for name in sys.modules if "." not in name)]))"""
HEAVY = {"torch", "warp", "mujoco", "mujoco_warp", "rsl_rl", "tensordict", "matplotlib"}
"""Packages that take long to import."""


def assert_light(answers, root):
    """Scripts with words, one after the other in a process, end with the status of each and import nothing heavy."""
    commands = json.dumps([[str(ROOT / "scripts" / script), *words] for script, *words in answers])
    command, environment = [sys.executable, "-c", _LIGHT, commands], {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    results = [json.loads(line[8:]) for line in done.stdout.splitlines() if line.startswith("result: ")]
    for (words, expected), (status, *imported) in zip(answers.items(), results, strict=True):
        assert (status, HEAVY & set(imported)) == (expected, set()), words
        assert "legged_torque" in imported
