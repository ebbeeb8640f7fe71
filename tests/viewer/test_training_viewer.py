"""The page and the videos of a running training: real processes, of a script that stands in for play.py."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.clock import wait_for

from legged_torque.utils.errors import UserError
from legged_torque.viewer import training_viewer
from legged_torque.viewer.training_viewer import TrainingViewer

PLAY = """
import json, os, sys, time
from pathlib import Path
words = dict(word[2:].split("=", 1) for word in sys.argv[1:])
run = Path(words["load_run"])
print(json.dumps([words, {name: os.environ.get(name) for name in ("RANK", "CUDA_VISIBLE_DEVICES")}]), flush=True)
if "port" in words:
    (run / "page").write_text(str(os.getpid()))
    time.sleep(600)
while not (run / "go").exists():
    time.sleep(0.01)
if (run / "go").read_text() == "well":
    (run / "videos" / f"model_{words['checkpoint']}.mp4").touch()
"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A folder of a run, and the script that is started in place of play.py."""
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "play.py").write_text(PLAY)
    monkeypatch.setattr(training_viewer, "SCRIPTS_DIR", tmp_path / "scripts")
    monkeypatch.setattr(training_viewer, "EXTRAS", {"viewer": (), "video": ()})
    monkeypatch.setenv("RANK", "0")
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


def text_of(file):
    """Wait until something has been written to a file, and return it."""
    return wait_for(lambda: file.exists() and file.read_text())


def show(viewer, run, *numbers):
    """Show checkpoints of a run."""
    for number in numbers:
        viewer.show(["--task=a1_torque"], run / f"model_{number}.pt")


def test_page(run, capsys):
    """It is served from the first checkpoint on, once, without the GPU and torchrun's variables, until the end."""
    shown = TrainingViewer(has_page=True, video_interval=0)
    show(shown, run, 0, 50)
    process = int(text_of(run / "page"))
    text = (run / "page.log").read_text()
    assert text.count("load_run") == 1 and f'"port": "{shown.page.rpartition(":")[2]}"' in text
    assert '"RANK": null' in text and '"CUDA_VISIBLE_DEVICES": ""' in text and '"device": "cpu"' in text
    assert os.getpriority(os.PRIO_PROCESS, process) == 19
    shown.close(is_waiting=True)
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)
    assert not capsys.readouterr().out and not (run / "videos").exists()


KILLED = """
import os, signal, sys, time
from pathlib import Path
from legged_torque.viewer import training_viewer
run = Path(sys.argv[1])
training_viewer.SCRIPTS_DIR = run.parent / "scripts"
training_viewer.start([f"--load_run={run}", "--port=1"], run / "page.log")
while not ((run / "page").exists() and (run / "page").read_text()):
    time.sleep(0.02)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux signals the end of a parent")
def test_killed_training(run):
    """Nothing stays of a training that is killed and cannot end its page."""
    training = subprocess.run([sys.executable, "-c", KILLED, str(run)], check=False)
    assert training.returncode == -signal.SIGKILL
    status = Path("/proc", text_of(run / "page"), "stat")
    wait_for(lambda: not status.exists() or status.read_text().split()[2] == "Z")


@pytest.mark.parametrize(("outcome", "warnings"), [("well", 0), ("badly", 1)])
def test_videos(run, capsys, outcome, warnings):
    """They are those of the next checkpoints after each interval, one at a time; a missing one is reported."""
    shown = TrainingViewer(has_page=False, video_interval=100)
    show(shown, run, 0, 50, 100, 150)  # the video of the first one is not done yet
    (run / "go").write_text("well")
    shown._video.wait(120.0)
    (run / "go").write_text(outcome)
    show(shown, run, 200, 250)
    shown.close(is_waiting=True)
    made = {path.name for path in (run / "videos").iterdir()}
    assert made == {"model_0.log", "model_0.mp4", "model_200.log"} | ({"model_200.mp4"} if outcome == "well" else set())
    assert capsys.readouterr().err.count("Warning: there is no video of model_200") == warnings


def test_a_page_that_cannot_start_or_ends(run, capsys):
    """Each gives one warning, and the training goes on."""
    shown = TrainingViewer(has_page=True, video_interval=0)
    (run / "page.log").mkdir()  # where a file should be
    show(shown, run, 0)
    (run / "page.log").rmdir()
    show(shown, run, 50)
    os.kill(int(text_of(run / "page")), signal.SIGKILL)
    shown._page.wait()
    show(shown, run, 100, 150)
    shown.close(is_waiting=True)
    error = capsys.readouterr().err
    assert error.count("Warning: nothing is shown of model_0: ") == error.count("Warning: the page has ended; ") == 1


def test_pages_of_two_trainings():
    """They are at different addresses, also before there is anything to show."""
    first, second = (TrainingViewer(has_page=True, video_interval=0) for _ in range(2))
    assert first.page != second.page
    for viewer in (first, second):
        viewer.close(is_waiting=False)


def test_interrupted_training_does_not_wait(run):
    """The video that is being made is given up."""
    shown = TrainingViewer(has_page=False, video_interval=1)
    show(shown, run, 0)
    shown.close(is_waiting=False)
    assert shown._video.poll() is not None


@pytest.mark.parametrize(("words", "extra"), [((True, 0), "viewer"), ((False, 5), "video")])
def test_missing_extra(monkeypatch, words, extra):
    """It is named before anything is trained."""
    monkeypatch.setattr(training_viewer, "EXTRAS", {"viewer": ("no_such_package",), "video": ("no_such_package",)})
    with pytest.raises(UserError, match=rf"no_such_package is not installed.*'legged_torque\[{extra}\]'"):
        TrainingViewer(*words)
    assert TrainingViewer(False, 0).page == ""
