"""The fixture that runs a page's Python."""

import importlib
import sys

import pytest
from support.documents import python_files

from legged_torque.envs import task_registry


@pytest.fixture
def run_page(monkeypatch, tmp_path):
    """Import a page's blocks of Python, each a file of its own; tasks and modules are forgotten afterwards."""
    monkeypatch.setattr(task_registry, "_tasks", dict(task_registry._tasks))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def run(page):
        names = {}
        for name, text in python_files(page):
            (tmp_path / f"{name}.py").write_text(text)
            monkeypatch.delitem(sys.modules, name, raising=False)
            names |= vars(importlib.import_module(name))
            monkeypatch.setitem(sys.modules, name, sys.modules.pop(name))  # taken out again afterwards
        return names

    return run
