"""Shared by tests: the console command, and what a shell offers to complete it."""

import os
import subprocess
import sys

import pytest
from support.scripts import ROOT

CODE = "import sys; sys.argv[0] = '/bin/legged-torque'; from legged_torque.utils.command import main; "
HEAVY = "{'torch', 'warp', 'mujoco', 'rsl_rl', 'matplotlib', 'argcomplete'} & set(sys.modules)"


def command(*words, env=None):
    """Run ``legged-torque`` in a process of its own; its status, standard output and standard error."""
    code = f"{CODE}\ntry: main()\nfinally: print({HEAVY} or '', end='')"
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])} | (env or {})
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, env=variables)
    return done.returncode, done.stdout, done.stderr


def complete(line, file):
    """Words that a shell offers after a line; the command writes them to a file."""
    pytest.importorskip("argcomplete")
    variables = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
    variables |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(file), "_ARGCOMPLETE_SHELL": "bash"}
    status, _, error = command(env=variables)
    assert status == 0, error
    return file.read_text().split()
