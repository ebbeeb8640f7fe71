"""Scripts in this process, in one of their own and in a terminal; the console command; runs of strangers."""

import contextlib
import fcntl
import io
import json
import os
import pty
import runpy
import signal
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest
import yaml

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


CODE = "import sys; sys.argv[0] = '/bin/legged-torque'; from legged_torque.utils.command import main; "


def command(*words, env=None):
    """Run ``legged-torque`` in a process of its own; its status, standard output and standard error."""
    code = f"{CODE}\ntry: main()\nfinally: print({HEAVY | {'argcomplete'}} & set(sys.modules) or '', end='')"
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


def in_a_terminal(code, columns=80, rows=40, after="", close=False, **variables):
    """Run code in a terminal; once ``after`` has come, press Ctrl-C or close it. Return exit status and output."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "NO_COLOR", "LINES")}
    environment |= {"PYTHONPATH": str(ROOT), "TERM": "xterm-256color", "PYTHONUTF8": "1", **variables}
    streams = {"stdin": slave, "stdout": slave, "stderr": slave}

    def take_terminal():
        """Make it the controlling one, and notice when it closes, also in tests that run under nohup."""
        fcntl.ioctl(slave, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

    how = {"env": environment, "start_new_session": True, "preexec_fn": take_terminal}
    process = subprocess.Popen([sys.executable, "-c", code], **streams, **how)
    os.close(slave)
    output = b""
    with contextlib.suppress(OSError):  # at the end of a terminal
        while data := os.read(master, 65536):
            output += data
            if after and after in output.decode(errors="replace"):
                if close:
                    break
                process.send_signal(signal.SIGINT)
                after = ""
    os.close(master)
    return process.wait(120), output.decode()


LOADING = {
    "train.py": ["--resume", "--num_envs=2", "--max_iterations=2", "--logger=none"],
    "play.py": ["--steps=1", "--num_envs=2"],
    "evaluate.py": ["--steps=1", "--num_envs=2"],
    "export.py": [],
}
"""Scripts that load a run, and words that make it short."""


class Payload:
    """An object whose pickle creates a file when it is loaded."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return open, (str(self.file), "w")


def load_run(script, run, *words):
    """Load a run with a script, in the folder of its logs."""
    all_words = ["--task=a1_position", "--device=cpu", *LOADING[script], *words]
    return run_here(script, *all_words, root=run.parents[2])


def edit_config(run, **changes):
    """Change settings of a run's training, given with ``__`` in place of dots."""
    config = yaml.safe_load((run / "config.yaml").read_text())
    for path, value in changes.items():
        *sections, key = path.split("__")
        part = config["train"]
        for section in sections:
            part = part[section]
        part[key] = value
    (run / "config.yaml").write_text(yaml.safe_dump(config))
