"""The tests that need a GPU have passed with this code: the record of their last run, and its fingerprint."""

import json

from support.last_run import FILE, FOLDER, TESTED, fingerprint

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
