"""Wall clock until tracking is reached, from hand-made evaluations and from a process that writes some."""

import sys

import pytest

from legged_torque.benchmark import learning_time
from legged_torque.benchmark.learning_time import first_reaching, time_training
from legged_torque.utils.errors import TrainingError

NAN = float("nan")
EVALUATIONS = [(1000, 0.4, 113.0), (2000, NAN, 114.0), (3000, 0.7, 115.5), (4000, 0.6, 117.0), (5000, 0.8, 118.0)]
TRAINING = """
import pathlib, sys, time
folder = pathlib.Path(sys.argv[1].partition("=")[2], "task", "run")
folder.mkdir(parents=True)
time.sleep(0.5)
(folder / "config.yaml").write_text("")
for i, tracking in enumerate([0.2, 0.72, 0.9]):
    time.sleep(0.3)
    with open(folder / "evaluations.csv", "a") as file:
        file.write(("" if i else "steps,track_percentage\\n") + f"{100 * (i + 1)},{tracking}\\n")
time.sleep(0.2)
"""


def test_first_at_or_above():
    """The first evaluation counts that is at or above the share, though a later one falls below it again."""
    assert first_reaching(0.70, EVALUATIONS, start=110.0, began=105.0) == {
        "share": 0.70,
        "steps": 3000,
        "training_s": 5.5,
        "command_s": 10.5,
    }
    assert first_reaching(0.75, EVALUATIONS, start=110.0, began=105.0)["steps"] == 5000
    unreached = first_reaching(0.9, EVALUATIONS, start=110.0, began=105.0)
    assert unreached == {"share": 0.9, "steps": None, "training_s": None, "command_s": None}


def test_a_process(tmp_path):
    """Each evaluation has the time at which it was written; starting, and the end after the last, count apart."""
    (tmp_path / "training.py").write_text(TRAINING)
    times = time_training([sys.executable, str(tmp_path / "training.py")])
    assert times["steps"] == 300
    at_70, at_75 = times["reached"]
    assert (at_70["share"], at_70["steps"], at_75["share"], at_75["steps"]) == (0.70, 200, 0.75, 300)
    assert times["start_s"] >= 0.5
    assert 0.55 < at_70["training_s"] < at_75["training_s"] - 0.25
    for point in times["reached"]:
        assert point["command_s"] == pytest.approx(times["start_s"] + point["training_s"])
        assert point["command_s"] < times["total_s"]


def test_a_process_that_fails(tmp_path):
    """Its status is told."""
    with pytest.raises(TrainingError, match="the training of --learn has ended with status 3"):
        time_training([sys.executable, "-c", "raise SystemExit(3)"])


def test_interrupt_ends_the_training(monkeypatch):
    """No training goes on behind a benchmark that has ended."""
    processes = []

    def interrupted(process, folder):
        processes.append(process)
        raise KeyboardInterrupt

    monkeypatch.setattr(learning_time, "watch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        time_training([sys.executable, "-c", "import time; time.sleep(60)"])
    assert processes[0].poll() is not None
