"""The tests that need a GPU have passed with this code: the record of their last run, and its fingerprint."""

import json

from support.last_run import FILE, fingerprint

ADVICE = "run 'python -m pytest -q -n 10 --dist loadfile tests/gpu' on a GPU, or give a reason in "
ADVICE += 'tests/gpu/last_run.json: "stale": "<reason>"'


def test_last_run_was_of_this_code():
    """After a change of what runs on a GPU, its tests have to run again, or the file says why they have not."""
    run = json.loads(FILE.read_text("utf-8"))
    if run.get("stale"):
        return
    assert run["failed"] == 0 and run["passed"] >= 20, ADVICE
    assert run["fingerprint"] == fingerprint(), f"the code has changed since: {ADVICE}"
