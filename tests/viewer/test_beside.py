"""What is seen beside a training: real processes, of a script that stands in for play.py."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from legged_torque.utils.errors import UserError
from legged_torque.viewer import beside

PLAY = """
import json, os, sys, time
from pathlib import Path
words = dict(word[2:].split("=", 1) for word in sys.argv[1:])
run = Path(words["load_run"])
print(json.dumps([words, {name: os.environ.get(name) for name in ("RANK", "CUDA_VISIBLE_DEVICES")}]), flush=True)
if "port" in words:
    (run / "page").write_text(str(os.getpid()))
    time.sleep(60)
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
    monkeypatch.setattr(beside, "SCRIPTS_DIR", tmp_path / "scripts")
    monkeypatch.setattr(beside, "EXTRAS", {"viewer": (), "video": ()})
    monkeypatch.setenv("RANK", "0")
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


def wait_for(file):
    """Wait until there is a file, and return its text."""
    end = time.monotonic() + 30.0
    while not (file.exists() and file.read_text()):
        assert time.monotonic() < end, f"there is no {file}"
        time.sleep(0.02)
    return file.read_text()


def test_page(run, capsys):
    """It is served from the first checkpoint on, once, without the GPU and torchrun's variables, until the end."""
    shown = beside.Beside(has_page=True, video_interval=0)
    for number in (0, 50):
        shown.show(["--task=a1_torque"], run / f"model_{number}.pt")
    process = int(wait_for(run / "page"))
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
from legged_torque.viewer import beside
run = Path(sys.argv[1])
beside.SCRIPTS_DIR = run.parent / "scripts"
beside.start([f"--load_run={run}", "--port=1"], run / "page.log")
while not ((run / "page").exists() and (run / "page").read_text()):
    time.sleep(0.02)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process that its parent is gone")
def test_killed_training(run):
    """Nothing stays of a training that is killed and cannot end its page."""
    training = subprocess.run([sys.executable, "-c", KILLED, str(run)], check=False)
    assert training.returncode == -signal.SIGKILL
    status, end = Path("/proc", wait_for(run / "page"), "stat"), time.monotonic() + 10.0
    while status.exists() and status.read_text().split()[2] != "Z":
        assert time.monotonic() < end, "the page is still there"
        time.sleep(0.02)


@pytest.mark.parametrize(("outcome", "warnings"), [("well", 0), ("badly", 1)])
def test_videos(run, capsys, outcome, warnings):
    """They are those of the next checkpoints after each interval, one at a time; what is missing is told."""
    shown = beside.Beside(has_page=False, video_interval=100)
    for number in (0, 50, 100, 150):  # the video of the first one is not done yet
        shown.show(["--task=a1_torque"], run / f"model_{number}.pt")
    (run / "go").write_text("well")
    shown._video.wait(30.0)
    (run / "go").write_text(outcome)
    for number in (200, 250):
        shown.show(["--task=a1_torque"], run / f"model_{number}.pt")
    shown.close(is_waiting=True)
    made = {path.name for path in (run / "videos").iterdir()}
    assert made == {"model_0.log", "model_0.mp4", "model_200.log"} | ({"model_200.mp4"} if outcome == "well" else set())
    assert capsys.readouterr().err.count("Warning: there is no video of model_200") == warnings


def test_what_cannot_be_started(run, capsys):
    """It is told, and the training goes on."""
    shown = beside.Beside(has_page=True, video_interval=0)
    (run / "page.log").mkdir()  # where a file should be
    shown.show(["--task=a1_torque"], run / "model_0.pt")
    shown.close(is_waiting=True)
    assert "Warning: nothing is shown of model_0: " in capsys.readouterr().err


def test_a_page_that_ends(run, capsys):
    """It is told once."""
    shown = beside.Beside(has_page=True, video_interval=0)
    shown.show(["--task=a1_torque"], run / "model_0.pt")
    os.kill(int(wait_for(run / "page")), signal.SIGKILL)
    shown._page.wait()
    for number in (50, 100):
        shown.show(["--task=a1_torque"], run / f"model_{number}.pt")
    shown.close(is_waiting=True)
    assert capsys.readouterr().err.count("Warning: the page has ended; ") == 1


def test_interrupted_training_does_not_wait(run):
    """The video that is being made is given up."""
    shown = beside.Beside(has_page=False, video_interval=1)
    shown.show(["--task=a1_torque"], run / "model_0.pt")
    shown.close(is_waiting=False)
    assert shown._video.poll() is not None


@pytest.mark.parametrize(("words", "extra"), [((True, 0), "viewer"), ((False, 5), "video")])
def test_missing_extra(monkeypatch, words, extra):
    """It is named before anything is trained."""
    monkeypatch.setattr(beside, "EXTRAS", {"viewer": ("no_such_package",), "video": ("no_such_package",)})
    with pytest.raises(UserError, match=rf"pip install 'legged_torque\[{extra}\]' \(no_such_package is missing\)"):
        beside.Beside(*words)
    beside.Beside(False, 0)


def test_nothing_is_started_without_a_wish(run):
    """Neither page nor videos."""
    shown = beside.Beside(False, 0)
    shown.show(["--task=a1_torque"], run / "model_0.pt")
    shown.close(is_waiting=True)
    assert not list(run.iterdir()) and shown.page == ""
