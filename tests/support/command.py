"""Shared by tests: command."""

import os
import subprocess
import sys

from support.scripts import ROOT

CODE = "import sys; sys.argv[0] = '/bin/legged-torque'; from legged_torque.utils.command import main; "
HEAVY = "{'torch', 'warp', 'mujoco', 'rsl_rl', 'matplotlib', 'argcomplete'} & set(sys.modules)"


def command(*words, env=None):
    """Run ``legged-torque`` in a process of its own; its status, standard output and standard error."""
    code = f"{CODE}\ntry: main()\nfinally: print({HEAVY} or '', end='')"
    variables = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])} | (env or {})
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, env=variables)
    return done.returncode, done.stdout, done.stderr
