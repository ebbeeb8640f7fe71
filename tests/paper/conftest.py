"""Fixtures of the tests of reports and of gravity pre-training."""

import json

import pytest
from support.gravity import CONFIGURATIONS, FEW, SMALL, STEPS, TASK, words_of
from support.scripts import run_here


@pytest.fixture(scope="module")
def coarse():
    """Figures of few pixels, which are drawn fast."""
    from legged_torque.paper.report import figures

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(figures.SETTINGS, "savefig.dpi", 20)
        yield


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A folder in which pretrain_gravity.py has made a small policy: the folder, its file, the report, the output."""
    root = tmp_path_factory.mktemp("pretrained")
    few = [f"--num_configurations={CONFIGURATIONS}", f"--num_steps={STEPS}", *words_of(**FEW)]
    status, output, error = run_here("pretrain_gravity.py", *SMALL, *few, f"--json={root / 'report.json'}", root=root)
    assert (status, error) == (0, ""), output + error
    file = root / "logs" / "pretrained" / f"{TASK}.pt"
    return root, file, json.loads((root / "report.json").read_text()), output
