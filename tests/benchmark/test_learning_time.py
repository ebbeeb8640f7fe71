"""Wall clock until tracking is reached, from hand-made evaluations and from a process that writes some."""

import sys

import pytest

from legged_torque.benchmark.measure import first_reaching, time_training
from legged_torque.utils.errors import TrainingError

TRACKING = [0.4, float("nan"), 0.7, 0.6, 0.8]
EVALUATIONS = [{"steps": 1e3 * (i + 1), "track_percentage": now, "seconds": i + 1.5} for i, now in enumerate(TRACKING)]
TRAINING = """
import pathlib, sys, time
folder = pathlib.Path(sys.argv[1].partition("=")[2], "task", "run")
folder.mkdir(parents=True)
time.sleep(0.5)
with open(folder / "evaluations.csv", "w") as file:
    file.write("steps,seconds,track_percentage\\n100,0.1,0.2\\n200,0.2,0.72\\n300,0.3,0.9\\n")
time.sleep(0.2)
"""


def test_first_at_or_above():
    """The first evaluation at or above the share counts, although a later one falls below it again."""
    found = first_reaching(0.70, EVALUATIONS, start=5.0)
    assert found == {"share": 0.70, "steps": 3000, "training_s": 3.5, "command_s": 8.5}
    assert first_reaching(0.75, EVALUATIONS, start=5.0)["steps"] == 5000
    unreached = first_reaching(0.9, EVALUATIONS, start=5.0)
    assert unreached == {"share": 0.9, "steps": None, "training_s": None, "command_s": None}


def test_a_process(tmp_path):
    """The start takes the time until the last evaluation less its seconds of training; the total has all."""
    (tmp_path / "training.py").write_text(TRAINING)
    times = time_training([sys.executable, str(tmp_path / "training.py")])
    assert times["steps"] == 300 and times["start_s"] > 0.5 - 0.3 and times["total_s"] > times["start_s"] + 0.3 + 0.2
    at_70, at_75 = times["reached"]
    assert (at_70["share"], at_70["steps"], at_75["share"], at_75["steps"]) == (0.70, 200, 0.75, 300)
    assert (at_70["training_s"], at_75["training_s"]) == (0.2, 0.3)
    assert at_75["command_s"] == pytest.approx(times["start_s"] + 0.3)


def test_a_process_that_fails(tmp_path):
    """Its status is the error."""
    with pytest.raises(TrainingError, match="the training of --learn has ended with status 3"):
        time_training([sys.executable, "-c", "raise SystemExit(3)"])
