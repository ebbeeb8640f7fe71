"""What a script shows while it works: a picture on a terminal, lines elsewhere, and nothing that harms the work."""

import contextlib
import fcntl
import io
import math
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from itertools import pairwise
from pathlib import Path

import pytest

from legged_torque.learning.training_display import TrainingDisplay, blocks, read_tracking
from legged_torque.utils import display
from legged_torque.utils.display import Counter, Display, Pace, is_terminal, progress_text, read_progress, warn

ROOT = Path(__file__).resolve().parents[2]
STYLES = re.compile(r"\033\[[\d;?]*[A-Za-z]")
NUMBERS = {"kl": 0.0123, "skipped_updates": 0.0, "noise": 0.5, "learning_rate": 1e-3, "Health/diverged_worlds": 0.0}
EVALUATED = {"Evaluation/track_percentage": 0.5, "Evaluation/falls_per_minute": 1.5, "Curriculum/mixing_pd": 0.75}

A_TRAINING = """
import sys, time
from legged_torque.learning.training_display import TrainingDisplay
from legged_torque.utils.display import Pace, warn
from legged_torque.utils.interrupt import StopRequest
numbers = {"kl": 0.0123, "skipped_updates": 1.0, "noise": 0.5, "learning_rate": 1e-3, "Health/diverged_worlds": 2.0}
numbers |= {"Curriculum/weight_of_a_reward_with_a_long_name": 0.25, "Curriculum/mixing_of_a_long_name": 0.75}
with TrainingDisplay("a1_torque: 9 worlds on CPU", "/logs/" + "[b]" * 40, Pace(20), 9, False) as display:
    with StopRequest(display.tell) as stop:
        warn("something is not as it should be")
        for i in range(1, 21):
            tracked = {"Evaluation/track_percentage": i / 40, "Evaluation/falls_per_minute": 1.5} if i % 2 else {}
            display.add_iteration(i, 9 * i, numbers | {"reward": 1.25, "length": 4.5} | tracked)
            print("ready" if i == 2 else "", end="\\n" if i == 2 else "", flush=True)
            time.sleep(0.03)
            if stop.requested:
                time.sleep(0.6)
                break
print("The run is here")
sys.exit(stop.number)
"""


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    encoding = "utf-8"

    def isatty(self):
        """Return True."""
        return True


def in_a_terminal(columns, after="", **variables):
    """Run A_TRAINING in a terminal of that width, and press Ctrl-C if ``after`` that text has come.

    Returns:
        Exit status, and all that the terminal has got.
    """
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    environment = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "NO_COLOR", "LINES")}
    environment |= {"PYTHONPATH": str(ROOT), "TERM": "xterm-256color", "PYTHONUTF8": "1", **variables}
    streams = {"stdin": slave, "stdout": slave, "stderr": slave}
    process = subprocess.Popen([sys.executable, "-c", A_TRAINING], **streams, env=environment, start_new_session=True)
    os.close(slave)
    output = b""
    with contextlib.suppress(OSError):  # how the end of a terminal is told
        while data := os.read(master, 65536):
            output += data
            if after and after in output.decode(errors="replace"):
                process.send_signal(signal.SIGINT)
                after = ""
    os.close(master)
    return process.wait(20), output.decode()


def lines_of(output):
    """The lines that were shown, one picture after the other, without styles."""
    return STYLES.sub("", re.sub(r"\033\[\d*A", "\n", output)).replace("\r", "").splitlines()


@pytest.mark.parametrize(("columns", "variables"), [(120, {}), (80, {}), (60, {"NO_COLOR": "1"})])
def test_panel(columns, variables):
    """All numbers are there, nothing is wider than the terminal, and what is printed meanwhile is kept above.

    It is redrawn about once a second, however often there is something new.
    """
    start = time.monotonic()
    status, output = in_a_terminal(columns, **variables)
    assert 2 < output.count("╭") < 6 + (time.monotonic() - start) / display.REDRAW_EVERY
    lines = lines_of(output)
    assert status == 0 and lines[-1] == "The run is here" and max(map(len, lines)) <= columns - 2
    assert lines.count("Warning: something is not as it should be.") == lines.count("ready") == 1
    start = max(i for i, line in enumerate(lines) if line.startswith("╭─ a1_torque: 9 worlds on CPU ─"))
    panel = lines[start:-1]
    assert {len(line) for line in panel} == {columns - 2} and panel[-1].startswith("╰")
    text = " ".join(re.sub(r" +", " ", line.strip("│ ")) for line in panel)
    for part in ("iteration 20 of 20 ", " 100% 0:00:0", "0:00:00 left", "steps 180", "reward 1.25", "KL 0.0123"):
        assert part in text
    for part in ("episode length 4.5 s", "noise 0.50", "learning rate 1.0e-03", "falls 1.5 per minute"):
        assert part in text
    for part in ("tracking 0.475, best 0.475", "trend +0.250 ▁▂", "diverged worlds 40", "skipped updates 20"):
        assert part in text
    for part in ("weight_of_a_reward_with_a_long_name 0.25,", "mixing_of_a_long_name 0.75", "warnings 1, last: some"):
        assert part in text
    assert re.search(r"run \.\.\.[\[b\]]*\[b\] ", text) and "…" not in text
    assert output.count("\033[?25l") == output.count("\033[?25h") == 1  # the cursor is back
    assert ("33" in re.findall(r"[\d]+", "".join(re.findall(r"\033\[[\d;]*m", output)))) != ("NO_COLOR" in variables)


@pytest.mark.parametrize("variables", [{"TERM": "dumb"}, {"PYTHONUTF8": "0", "PYTHONIOENCODING": "latin-1"}])
def test_terminals_without_pictures(variables):
    """They get plain lines."""
    status, output = in_a_terminal(80, **variables)
    assert status == 0 and "\033" not in output and "╭" not in output
    assert output.replace("\r", "").splitlines()[-2].startswith("iteration 20 of 20, 0:00:0")


def test_ctrl_c():
    """It is told in the panel at once, below the bar, and printing goes on."""
    status, output = in_a_terminal(80, after="ready")
    lines = lines_of(output)
    text = "│ Stopping after this iteration and saving; once more to stop at once."
    above = [before for before, line in pairwise(lines) if line.startswith(text)]
    assert status == signal.SIGINT and above and all(line.startswith("│ iteration") for line in above)
    assert lines[-1] == "The run is here" and "iteration 20 of" not in output


def test_lines(capsys, monkeypatch):
    """After the first iteration, an evaluation or ten seconds, and at the end; experiments read them."""
    now = 100.0
    monkeypatch.setattr(display.time, "monotonic", lambda: now)
    with TrainingDisplay("title", "folder", Pace(40), 32, False) as shown:
        for i in range(1, 16):
            now += 1.0
            shown.add_iteration(i, 32 * i, NUMBERS | (EVALUATED if i == 6 else {}))
    lines = capsys.readouterr().out.splitlines()
    assert [read_progress(line)[1] for line in lines] == [1, 6, 15]
    assert lines[0] == (
        "iteration 1 of 40, 0:00:01, time left unknown; 32 steps; KL 0.0123, noise 0.50, learning rate 1.0e-03"
    )
    assert lines[1].startswith("iteration 6 of 40, 0:00:06, 0:00:34 left; 192 steps, 32 steps/s; tracking 0.500 (best")
    assert read_progress("\n".join(lines)) == ("iteration", 15, 40, "0:00:25")
    assert read_tracking(lines[0]) == "" and read_tracking("\n".join(lines)) == "0.500"


def test_nothing_is_written_twice_or_to_nobody(monkeypatch):
    """A pipe that nobody reads is told once; a quiet display and one without news are silent."""
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        with TrainingDisplay("title", "folder", Pace(2), 32, False) as shown:
            with pytest.raises(BrokenPipeError):
                shown.add_iteration(1, 32, NUMBERS)
            shown.add_iteration(2, 64, NUMBERS)
        monkeypatch.setattr(sys, "stdout", io.StringIO())
        with contextlib.suppress(BrokenPipeError):
            stream.close()
    with TrainingDisplay("title", "folder", Pace(2), 32, True) as quiet:
        quiet.add_iteration(1, 32, NUMBERS)
    with TrainingDisplay("title", "folder", Pace(2), 32, False):
        pass
    assert sys.stdout.getvalue() == ""


def test_counter(monkeypatch):
    """A bar on a terminal, gone in the end; elsewhere a line every ten seconds, not counting what comes before."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(display, "REDRAW_EVERY", 0.0)
    with Counter("rendering, frame", 4) as counter:
        for _ in range(4):
            counter.add("all is well")
        assert Display.shown is counter
        with Counter("inner", 2) as inner:  # another picture would cover the first one
            inner.add()
    assert Display.shown is None and sys.stderr is terminal
    shown = lines_of(terminal.getvalue())
    assert any(re.match(r"rendering, frame 4 of 4 ━+ 100% 0:00:00, 0:00:00 left", line) for line in shown)
    assert "all is well" in terminal.getvalue() and "inner" not in terminal.getvalue()
    assert terminal.getvalue().rstrip().endswith("\033[2K")  # erased
    now = 100.0
    monkeypatch.setattr(display.time, "monotonic", lambda: now)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with Counter("evaluating, step", 10) as counter:
        for _ in range(5):
            now += 6.0
            counter.add()
    texts = [f"evaluating, step {i} of 10, 0:00:{t}, 0:00:{left} left" for i, t, left in ((3, 12, 42), (5, 24, 30))]
    assert sys.stderr.getvalue().splitlines() == texts
    assert read_progress(texts[1]) == ("evaluating, step", 5, 10, "0:00:30")


def test_an_error_ends_the_picture(monkeypatch):
    """The streams are given back, and the cursor too."""
    monkeypatch.setenv("TERM", "xterm")
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    with pytest.raises(ValueError, match="mine"), TrainingDisplay("title", "folder", Pace(2), 32, False) as shown:
        assert sys.stdout is not terminal
        raise ValueError("mine")
    assert sys.stdout is terminal and Display.shown is None and not shown._thread.is_alive()
    assert terminal.getvalue().endswith("\033[?25h")


def test_a_picture_that_cannot_be_drawn(monkeypatch):
    """It says why, and the work goes on."""
    monkeypatch.setenv("TERM", "xterm")
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(display, "REDRAW_EVERY", 0.0)
    with TrainingDisplay("title", "folder", Pace(2), 32, False) as shown:
        shown.add_iteration(1, 32, {**NUMBERS, **EVALUATED, "Evaluation/track_percentage": math.inf})
    assert "no picture: " in terminal.getvalue() and Display.shown is None


def test_a_terminal_that_is_gone(monkeypatch):
    """Work goes on without pictures."""
    monkeypatch.setenv("TERM", "xterm")
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(display, "REDRAW_EVERY", 0.0)
    with TrainingDisplay("title", "folder", Pace(2), 32, False) as shown:
        monkeypatch.setattr(Terminal, "write", lambda *_: (_ for _ in ()).throw(OSError(5, "Input/output error")))
        shown.add_iteration(1, 32, NUMBERS)
    assert Display.shown is None and sys.stdout is terminal


def test_warnings(capsys):
    """They go to standard error, whatever is shown."""
    warn("the disk is full")
    assert capsys.readouterr() == ("", "Warning: the disk is full.\n")


def test_time_left(monkeypatch):
    """It is that of the last moments, however slow the first ones were."""
    now = 0.0
    monkeypatch.setattr(display.time, "monotonic", lambda: now)
    pace = Pace(1000)
    assert pace.left() is None and progress_text("step", pace, 0.0) == "step 0 of 1000, 0:00:00, time left unknown"
    for done in range(200):
        now += 10.0 if done < 50 else 0.5
        pace.add(done + 1)
    assert pace.per_second() == pytest.approx(2.0) and pace.left() == pytest.approx(400.0)
    text = progress_text("step", pace, 90061.0)
    assert text == "step 200 of 1000, 1 day, 1:01:01, 0:06:40 left"
    assert read_progress(f"a line\n{text}; more") == ("step", 200, 1000, "0:06:40") and read_progress("nothing") is None


def test_curve():
    """From the lowest to the highest; many values are averaged."""
    assert blocks([0.3]) == "▁" and blocks([0.0, 1.0, 0.5]) == "▁█▅"
    assert blocks([i // 10 for i in range(120)]) == "▁▂▂▃▄▄▅▅▆▇▇█"


def test_terminals(monkeypatch):
    """A file is none, whatever the environment says."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    assert is_terminal(Terminal()) and not is_terminal(io.StringIO())
