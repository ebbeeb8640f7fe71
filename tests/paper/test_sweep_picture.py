"""The figure of sweeps: which lines it has, and files that are none."""

import json

import pytest
from support.scripts import assert_told_in_one_line, run_here


def sweep(task, parameter, unit, part):
    """What evaluate.py --sweep writes, with two parts."""
    parts = [{"from": low, "to": low + 1.0} | part for low in (0.0, 1.0)]
    return {"task": task, "sweep": {"parameter": parameter, "unit": unit, "parts": parts}}


@pytest.fixture
def files(tmp_path):
    """Two robots, two approaches, and a sweep of pushes."""
    tracking = {"metrics": {"track_percentage": {"mean": 0.8, "standard_error": 0.01}}}
    fell = {"fell": {"mean": None, "standard_error": None}}  # no push of this size has counted
    contents = {
        "one": sweep("go2_position", "motor_strength", "", tracking),
        "two": sweep("anymal_c_rough_torque_multihead", "motor_strength", "", tracking),
        "three": sweep("go2_position", "push_velocity", "m/s", fell),
        "wider": sweep("go2_position", "motor_strength", "", tracking),
        "broken": sweep("go2_position", "motor_strength", "", {}),
    }
    contents["wider"]["sweep"]["parts"][1]["to"] = 3.0
    for name, content in contents.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    return tmp_path


def test_figure(files):
    """A row per robot, a column per parameter, a name per approach."""
    words = ["sweeps", "one.json", "two.json", "three.json", "--out=figure.svg"]
    status, _, error = run_here("plot.py", *words, root=files)
    assert (status, error) == (0, "")
    text = (files / "figure.svg").read_text()
    for words in ("go2", "anymal_c", "motor_strength", "push_velocity [m/s]", "share that falls", "tracking"):
        assert f"<!-- {words} -->" in text, words
    assert text.count("<!-- motor_strength -->") == 2


def test_mistakes(files):
    """A sweep without numbers is named, and so is a file that is none."""
    told = {"broken": "a sweep of motor_strength for go2_position is not whole", "wider": "different ranges"}
    parts = [{"from": 0.0, "to": 1.0, "fell": 1}]
    whole = {"parameter": "x", "unit": "", "parts": parts}
    for number, (task, content) in enumerate([(5, whole), ("a", [1]), ("a", whole | {"parameter": []}), ("a", whole)]):
        (files / f"{number}.json").write_text(json.dumps({"task": task, "sweep": content}))
        told[str(number)] = f"'{number}.json' is not a file that evaluate.py --sweep has written"
    told["3"] = "a sweep of x for a_a is not whole"
    for name, message in told.items():
        result = run_here("plot.py", "sweeps", "one.json", f"{name}.json", "--out=figure.svg", root=files)
        assert_told_in_one_line(result, message)
    assert not (files / "figure.svg").exists()
