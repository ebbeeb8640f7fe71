"""The tests that need a GPU have passed with this code: the record of their last run, and its fingerprint."""

import json
from types import SimpleNamespace

import pytest
import torch
from support import last_run
from support.last_run import FILE, FOLDER, PACKAGES, TESTED, Recorder, fingerprint

ADVICE = "run 'python -m pytest -q -n 10 --dist loadfile tests/gpu' on a GPU, or give a reason in "
ADVICE += 'tests/gpu/last_run.json: "stale": "<reason>"'


def test_last_run_was_of_this_code():
    """After a change of what runs on a GPU, its tests have to run again, or the file says why they have not."""
    run = json.loads(FILE.read_text("utf-8"))
    if run.get("stale"):
        return
    assert run["failed"] == 0 and run["passed"] >= 20, ADVICE
    assert run["fingerprint"] == fingerprint(), f"the code has changed since: {ADVICE}"


SOURCE = '''"""Doubles."""

LIMIT = 3
"""Its unit."""


def double(x):
    """Return twice a number."""
    return 2 * x
'''
SAME = (
    lambda text: text.replace("Return", "Give back").replace('"""Its unit."""\n', ""),
    lambda text: text.replace("LIMIT = 3", "\n\nLIMIT = 3  # m/s").replace("2 * x", "(\n        2\n        * x\n    )"),
)
OTHER = (
    lambda text: text.replace("2 * x", "x * 2"),
    lambda text: text.replace("LIMIT = 3", "LIMIT = 3.0"),
    lambda text: text.replace("double", "twice"),
    lambda text: text + "double(LIMIT)\n",
)


def make_package(folder, text=SOURCE):
    """A package with a file in each folder that counts, and in one that does not."""
    for part in (*TESTED, "viewer"):
        (folder / part / "deep").mkdir(parents=True)
        (folder / part / "deep" / "code.py").write_text(text)
    return folder


def test_fingerprint(tmp_path):
    """It follows the statements of all files of its folders, and neither words and layout nor other folders."""
    package = make_package(tmp_path / "first")
    first = fingerprint(package)
    for number, edit in enumerate(SAME + OTHER):
        assert edit(SOURCE) != SOURCE
        assert (fingerprint(make_package(tmp_path / str(number), edit(SOURCE))) == first) == (edit in SAME), number
    (package / "viewer" / "deep" / "code.py").write_text("")
    assert fingerprint(package) == first
    for part in TESTED:
        (package / part / "new.py").write_text("")
        assert fingerprint(package) != first
        (package / part / "new.py").unlink()
    assert all(list((FOLDER.parents[1] / "legged_torque" / part).rglob("*.py")) for part in TESTED)


def report(nodeid, when, outcome):
    """A report of pytest about a part of a test."""
    return SimpleNamespace(nodeid=nodeid, when=when, outcome=outcome, passed=outcome == "passed")


@pytest.fixture
def session(tmp_path, monkeypatch):
    """A session of pytest on a GPU that ends in a moment, and the file that it would write."""
    monkeypatch.setattr(last_run, "FILE", tmp_path / "last_run.json")
    monkeypatch.delenv("GPU_TESTS_DEVICE", raising=False)
    for name, value in {"is_available": True, "device_count": 1, "get_device_name": "H100"}.items():
        monkeypatch.setattr(torch.cuda, name, lambda value=value: value)
    config = SimpleNamespace(args=["tests/gpu"], option=SimpleNamespace(keyword="", markexpr=""))
    recorder = Recorder(config)
    for file in FOLDER.glob("test_*.py"):
        recorder.pytest_runtest_logreport(report(f"tests/gpu/{file.name}::test_x", "call", "passed"))
    return recorder, config, tmp_path / "last_run.json"


def finish(recorder, **more):
    """End the session."""
    recorder.pytest_sessionfinish(**{"session": SimpleNamespace(shouldfail=False), "exitstatus": 0} | more)


def test_a_whole_run_is_kept(session):
    """With its numbers, versions and fingerprint; tests elsewhere do not count, and each counts once."""
    recorder, _, file = session
    step = "tests/gpu/test_gpu_step.py"
    for nodeid, when, outcome in (
        (f"{step}::test_y", "call", "failed"),
        (f"{step}::test_y", "teardown", "passed"),
        (f"{step}::test_z", "setup", "skipped"),
        (f"{step}::test_z", "teardown", "passed"),
        ("tests/test_house.py::test_y", "call", "failed"),
    ):
        recorder.pytest_runtest_logreport(report(nodeid, when, outcome))
    finish(recorder, exitstatus=1)
    run = json.loads(file.read_text())
    assert (run["passed"], run["failed"], run["skipped"]) == (len(list(FOLDER.glob("test_*.py"))), 1, 1)
    assert run["device"] == "1 x H100" and run["fingerprint"] == fingerprint() and run["torch"] == torch.__version__
    assert {"date", "seconds", *PACKAGES} <= run.keys()


@pytest.mark.parametrize("what", ["some tests", "a file less", "the CPU"])
def test_a_partial_run_is_not_kept(session, monkeypatch, what):
    """Nothing is written."""
    recorder, config, file = session
    if what == "some tests":
        config.args.append("tests/gpu/test_gpu_step.py::test_x")
    elif what == "a file less":
        recorder._outcomes.popitem()
    else:
        monkeypatch.setenv("GPU_TESTS_DEVICE", "cpu")
    finish(recorder)
    assert not file.exists()
