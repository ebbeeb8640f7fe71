"""Bad input is refused: a part of what scripts/attack.py tries, and how it is judged."""

import json
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from legged_torque.utils.limits import Count, Interval
from tools.attack import ACCEPTED, ENDED, REFUSED, Case, Result, classify, table
from tools.attack_cases import Setting, all_cases, bad_values, settings
from tools.attack_fixture import make_fixture, parsers

ROOT = Path(__file__).resolve().parents[2]


def test_a_part_of_the_attack(tmp_path):
    """Cases drawn at random: what must be refused is, and none leaves files or a traceback."""
    file = tmp_path / "results.json"
    command = [sys.executable, str(ROOT / "scripts" / "attack.py"), "--limit=24", "--seed=3", f"--json={file}"]
    done = subprocess.run(command, cwd=tmp_path, text=True, capture_output=True, timeout=600)
    cases = json.loads(file.read_text())["cases"]
    assert [case for case in cases if not case["is_good"]] == []
    assert (done.returncode, done.stderr) == (0, "") and len(cases) == 24
    assert sum(case["outcome"] == REFUSED for case in cases) > 12
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    ("status", "error", "is_changed", "outcome"),
    [
        (2, "error: no\n", False, REFUSED),
        (2, "compiling kernels, once per machine: 1 modules, 3 s\nerror: no\n", False, REFUSED),
        (2, "error: no\n", True, "files"),
        (2, "error: no\nand more\n", False, "lines"),
        (2, "", False, "lines"),
        (0, "", True, ACCEPTED),
        (1, "beyond the tolerance\n", False, ENDED),
        (1, "Traceback (most recent call last):\n  File\nKeyError: 1\n", False, "traceback"),
        (-signal.SIGSEGV, "", False, "crash"),
        (-signal.SIGALRM, "", False, "timeout"),
    ],
)
def test_outcomes(status, error, is_changed, outcome):
    """Exit status 2 with one line and nothing written is a refusal; everything else has a name of its own."""
    assert classify(status, error, is_changed) == outcome


def test_what_is_good():
    """A refusal always is; what may be accepted is good as well, but no traceback."""
    must, may = (Case("name", "train.py", (), must_refuse) for must_refuse in (True, False))
    good = [(case, outcome) for case in (must, may) for outcome in (REFUSED, ACCEPTED, "traceback", "files")]
    assert [Result(*pair, "").is_good for pair in good] == [True, False, False, False, True, True, False, False]
    lines = table([Result(must, ACCEPTED, ""), Result(may, REFUSED, "")]).splitlines()
    assert lines[-1].split() == ["all", "1", "1", "0", "0", "0", "0", "0", "0", "1"]


def test_values_that_must_be_refused():
    """NaN and infinity always; a number below its lowest one; a range with its ends swapped or of another length."""
    count = dict(bad_values(Setting("a1_position", 4, Count)))
    assert count[".nan"] and count[".inf"] and count["-1"] and count["0"] and count["0.5"] and not count["1000000000"]
    interval = dict(bad_values(Setting("a1_position", [0.0, 1.0], Interval)))
    assert interval["[2.0, 1.0]"] and interval["[1.0]"] and interval["[0.0, .inf]"] and not interval["[-2.0, -1.0]"]


def test_everything_is_attacked(tmp_path):
    """Every script that trains, measures or draws, every setting of every task, every kind of file; twice the same."""
    make_fixture(tmp_path / "fixture")
    known = dict(parsers())
    cases = all_cases(tmp_path / "fixture", known, seed=1)
    helpers = {"__init__", "attack", "info"}  # info takes nothing
    names = {file.name for file in (ROOT / "scripts").glob("*.py") if file.stem not in helpers}
    assert {case.script for case in cases} == names == set(known)
    assert len(cases) > 2000 and len({case.name for case in cases}) > 0.9 * len(cases)
    tried = {case.name.removeprefix("set ").partition("=")[0] for case in cases if case.name.startswith("set ")}
    assert tried == set(settings())
    assert {Path(name).suffix for case in cases for name in case.files} == {
        *(".yaml", ".json", ".csv", ".pt", ".onnx", ".xml"),
    }
    again = all_cases(tmp_path / "fixture", known, seed=1)
    assert again == cases and random.Random(1).sample(cases, 5) == random.Random(1).sample(again, 5)
