"""The record of the last run of the tests that need a GPU, and a fingerprint of the code that they have tested."""

import ast
import datetime
import hashlib
import json
import os
import time
from collections import Counter
from importlib.metadata import version

import torch
from support.scripts import ROOT

FOLDER = ROOT / "tests" / "gpu"
FILE = FOLDER / "last_run.json"
TESTED = ("sim", "motors", "sensors", "learning", "envs", "identification")
"""Folders of the package of which a change asks for another run."""
PACKAGES = ("torch", "triton", "warp-lang", "mujoco", "mujoco-warp", "rsl-rl-lib")
_PARTIAL = ("keyword", "markexpr", "deselect", "lf", "stepwise")  # options of pytest that leave tests out


def fingerprint(package=ROOT / "legged_torque"):
    """A digest of all statements in :data:`TESTED`: comments, docstrings and layout do not matter.

    Empty parts of a syntax tree are left out: they differ between versions of Python.
    """
    digest = hashlib.sha256()
    for file in sorted(file for folder in TESTED for file in (package / folder).rglob("*.py")):
        digest.update(f"{file.relative_to(package).as_posix()}: {_statements(ast.parse(file.read_bytes()))}\n".encode())
    return digest.hexdigest()


def _statements(node):
    """A syntax tree as nested tuples, without the strings that stand alone as statements."""
    if isinstance(node, list):
        return [_statements(part) for part in node if not _is_text(part)]
    if not isinstance(node, ast.AST):
        return repr(node)
    if isinstance(node, ast.JoinedStr):  # Python 3.12 can end it with an empty string
        node.values = [part for part in node.values if not (isinstance(part, ast.Constant) and part.value == "")]
    parts = ((name, value) for name, value in ast.iter_fields(node) if value is not None and value != [])
    return type(node).__name__, [(name, _statements(value)) for name, value in parts]


def _is_text(node):
    """Whether a statement is a docstring, or a string that stands alone as those of constants do."""
    value = node.value if isinstance(node, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


class Recorder:
    """A plugin of pytest that writes :data:`FILE` after a session that has run all tests of :data:`FOLDER` on a GPU."""

    def __init__(self, config):
        """Begin with a session."""
        self._config, self._start = config, time.time()
        self._outcomes = {}  # by name of the test

    def pytest_runtest_logreport(self, report):
        """Note how a test has ended; with pytest-xdist, reports come from all workers."""
        file = report.nodeid.partition("::")[0]
        if (ROOT / file).parent == FOLDER and (report.when == "call" or not report.passed):
            self._outcomes[report.nodeid] = report.outcome

    def pytest_sessionfinish(self, session, exitstatus):
        """Write the file if this was a whole run."""
        files = {ROOT / name.partition("::")[0] for name in self._outcomes}
        is_whole = files == set(FOLDER.glob("test_*.py")) and exitstatus in (0, 1) and not session.shouldfail
        is_whole = is_whole and not any("::" in str(word) for word in self._config.args)
        is_whole = is_whole and not any(getattr(self._config.option, name, None) for name in _PARTIAL)
        if is_whole and torch.cuda.is_available() and "GPU_TESTS_DEVICE" not in os.environ:
            FILE.write_text(json.dumps(self._record(), indent=2) + "\n")

    def _record(self):
        """The contents of the file."""
        counts = Counter(self._outcomes.values())
        return {
            "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
            "device": f"{torch.cuda.device_count()} x {torch.cuda.get_device_name()}",
            **{name: version(name) for name in PACKAGES},
            **{outcome: counts[outcome] for outcome in ("passed", "failed", "skipped")},
            "seconds": round(time.time() - self._start),
            "fingerprint": fingerprint(),
        }
