"""The script that shows what is installed."""

import importlib.metadata
import runpy

import numpy as np
import pytest
import torch
from support.scripts import ROOT, run_here


@pytest.fixture(scope="module")
def info():
    """The functions of the script."""
    return runpy.run_path(str(ROOT / "scripts" / "info.py"))


def test_info(tmp_path):
    """Versions, device, the folder of kernels, and renderers; nothing is written."""
    status, output, _ = run_here("info.py", root=tmp_path)
    assert status == 0 and f"  torch          {torch.__version__}\n" in output and "compiled kernels: " in output
    for title in ("versions", "machine", "GPU", "caches", "extras", "rendering"):
        assert f"\n{title}\n  " in output
    assert not list(tmp_path.iterdir())


def test_missing_extras(info, monkeypatch):
    """What is missing, or too old, is named with the command that installs it."""
    of_extras = {"video": "no-such-package>=2", "export": "numpy>=99", "viewer": "numpy"}
    texts = ["numpy", *(f"{need}; extra == '{extra}'" for extra, need in of_extras.items())]
    monkeypatch.setattr(importlib.metadata, "requires", lambda package: texts)
    lines = {line.split()[0]: line for line in info["extras"]()}
    assert "missing no-such-package: pip install 'legged_torque[video]'" in lines["video"]
    assert "missing numpy>=99" in lines["export"] and f"(here {np.__version__})" in lines["export"]
    assert lines["viewer"].split()[1] == lines["plots"].split()[1] == "ok"
