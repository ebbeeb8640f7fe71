"""The display of long work, and of kernels being compiled: a view on a terminal, lines elsewhere, and no harm done."""

import io
import os
import re
import signal
import time
from itertools import pairwise

import pytest
import warp as wp
from support.clock import Clock, wait_for
from support.scripts import in_a_terminal

from legged_torque.learning.training_display import TrainingDisplay, read_tracking
from legged_torque.utils.display import REDRAW_EVERY, Counter, read_progress
from legged_torque.utils.progress import COMPILING, CompileProgress, torch_compiles

STYLES = re.compile(r"\033\[[\d;?]*[A-Za-z]")
NUMBERS = {"kl": 0.0123, "action_std": 0.5, "learning_rate": 1e-3, "Health/diverged_worlds": 0.0}
EVALUATED = {"Evaluation/track_percentage": 0.5, "Evaluation/falls_per_minute": 1.5, "Curriculum/mixing_pd": 0.75}

TRAINING = """
import sys, time
from legged_torque.learning.training_display import TrainingDisplay
from legged_torque.utils.display import warn
from legged_torque.utils.interrupt import StopRequest
numbers = {"kl": 0.0123, "skipped_updates": 1.0, "action_std": 0.5, "learning_rate": 1e-3}
numbers |= {"Health/diverged_worlds": 2.0, "Train/mean_reward": 1.25, "Train/mean_episode_length": 4.5}
numbers |= {"Curriculum/weight_of_a_reward_with_a_long_name": 0.25, "Curriculum/mixing_of_a_long_name": 0.75}
with TrainingDisplay("a1_torque: 9 worlds on CPU", "/logs/" + "[b]" * 40, 20, 0, 9) as display:
    with StopRequest(display.notify) as stop:
        warn("something is not as it should be")
        for i in range(1, 21):
            tracked = {"Evaluation/track_percentage": i / 40, "Evaluation/falls_per_minute": 1.5} if i % 2 else {}
            display.add_iteration(i, 9 * i, numbers | tracked)
            print("ready" if i == 2 else "", end="\\n" if i == 2 else "", flush=True)
            time.sleep(0.03)
            if stop.requested:
                time.sleep(1.2)
                break
print("The run is here")
sys.exit(stop.number)
"""
ENDLESS = TRAINING.replace("20, 0, 9", "9999, 0, 9").replace("range(1, 21)", "range(1, 9999)")
"""The same, until it is asked to stop."""
LARGE, SMALL = "a_term_with_a_very_long_name", "small_term"
TERMS = {f"Episode_Reward/{SMALL}": 1e-4} | {f"Episode_Reward/{LARGE}_{i}": -0.0311 - i for i in range(20)}
"""Numbers of rewards; the last is the largest."""
BROKEN = """
import sys
from legged_torque.utils.display import Counter
class Broken(Counter):
    def view(self):
        raise ValueError("a name that cannot be drawn")
try:
    with Broken("step", 2) as counter:
        counter.add()
        raise KeyError("of the work")
except KeyError as error:
    print("caught", error)
"""


def lines_of(output):
    """The lines that were shown, one view after the other, without styles."""
    return STYLES.sub("", re.sub(r"\033\[\d*A", "\n", output)).replace("\r", "").splitlines()


@pytest.mark.parametrize(("columns", "variables"), [(120, {}), (60, {"NO_COLOR": "1"})])
def test_panel(columns, variables):
    """All numbers are there, nothing is too wide, other output is kept above; it is redrawn about once a second."""
    start = time.monotonic()
    status, output = in_a_terminal(TRAINING, columns, **variables)
    assert 2 < output.count("╭") < 6 + (time.monotonic() - start) / REDRAW_EVERY
    lines = lines_of(output)
    assert status == 0 and lines[-1] == "The run is here" and max(map(len, lines)) <= columns - 2
    assert lines.count("Warning: something is not as it should be.") == lines.count("ready") == 1
    start = max(i for i, line in enumerate(lines) if line.startswith("╭─ a1_torque: 9 worlds on CPU ─"))
    panel = lines[start:-1]
    assert {len(line) for line in panel} == {columns - 2} and panel[-1].startswith("╰")
    text = " ".join(re.sub(r" +", " ", line.strip("│ ")) for line in panel)
    assert re.search(r" 100% \d:\d\d:\d\d", text)
    for part in ("iteration 20 of 20 ", "0:00:00 left", "steps 180", "reward 1.25", "KL 0.0123"):
        assert part in text
    for part in ("tracking 0.475 (best 0.475)", "trend +0.250 ▁▂", "diverged worlds 40", "skipped updates 20"):
        assert part in text
    for part in ("weight_of_a_reward_with_a_long_name 0.25,", "mixing_of_a_long_name 0.75", "warnings: 1, last: some"):
        assert part in text
    assert "[b]" * 40 in text.replace(" ", "") and "…" not in text
    assert output.count("\033[?25l") == output.count("\033[?25h") == 1  # the cursor is back
    assert ("33" in re.findall(r"[\d]+", "".join(re.findall(r"\033\[[\d;]*m", output)))) != ("NO_COLOR" in variables)


@pytest.mark.parametrize(("rows", "shown", "has_small"), [(24, 8, False), (60, 20, True)])
def test_reward_terms_in_the_panel(rows, shown, has_small):
    """The largest come first, as many as there is room for; 80 x 24 characters fit the whole panel."""
    code = TRAINING.replace("numbers |= {", f"numbers |= {TERMS} | {{", 1)
    status, output = in_a_terminal(code, 80, rows)
    lines = lines_of(output)
    panel = lines[max(i for i, line in enumerate(lines) if line.startswith("╭─ a1_torque")) : -1]
    text = " ".join(re.sub(r" +", " ", line.strip("│ ")) for line in panel)
    assert status == 0 and text.count(LARGE) >= shown and (SMALL in text) == has_small
    assert len(panel) < max(rows, 20)
    if shown:
        assert text.index(f"{LARGE}_19 -19") < text.index(f"{LARGE}_18 -18")


@pytest.mark.parametrize("variables", [{"TERM": "dumb"}, {"PYTHONUTF8": "0", "PYTHONIOENCODING": "latin-1"}])
def test_terminals_without_views(variables):
    """They get plain lines."""
    status, output = in_a_terminal(TRAINING, **variables)
    assert status == 0 and "\033" not in output and "╭" not in output
    assert output.replace("\r", "").splitlines()[-2].startswith("iteration 20 of 20, 0:")


def test_ctrl_c():
    """The panel says so within a second, below the bar, and printing goes on."""
    status, output = in_a_terminal(ENDLESS, after="ready")
    lines = lines_of(output)
    text = "│ Stopping after this iteration and saving; once more to stop at once."
    above = [before for before, line in pairwise(lines) if line.startswith(text)]
    assert status == signal.SIGINT and above and all(line.startswith("│ iteration") for line in above)
    assert lines[-1] == "The run is here"


def test_a_terminal_that_closes():
    """It asks to stop, and what is drawn and printed afterwards harms nothing."""
    code = ENDLESS.replace("sys.exit(stop.number)", "sys.exit(100 + stop.number)")
    assert in_a_terminal(code, after="ready", close=True)[0] == 100 + signal.SIGHUP


def test_errors():
    """A view that cannot be drawn says why, and an error of the work ends the display in order."""
    status, output = in_a_terminal(BROKEN)
    assert status == 0 and "nothing to see: ValueError: a name that cannot be drawn" in output
    assert lines_of(output)[-1] == "caught 'of the work'" and output.count("\033[?25l") == output.count("\033[?25h")


def test_lines(capsys):
    """After the first iteration, an evaluation or ten seconds, and at the end; experiments read them."""
    clock = Clock()
    with TrainingDisplay("title", "folder", 40, 0, 32, clock=clock) as shown:
        for i in range(1, 16):
            clock.sleep(1.0)
            shown.add_iteration(i, 32 * i, NUMBERS | (EVALUATED if i == 6 else {}))
    lines = capsys.readouterr().out.splitlines()
    assert [read_progress(line)[1] for line in lines] == [1, 6, 15]
    assert lines[0] == (
        "iteration 1 of 40, 0:00:01, time left unknown; steps 32; KL 0.0123; noise 0.50; learning rate 1.0e-03"
    )
    assert lines[1].startswith("iteration 6 of 40, 0:00:06, 0:00:34 left; steps 192; steps/s 32; KL 0.0123; ")
    assert lines[1].endswith("; tracking 0.500 (best 0.500); falls 1.5 per minute")
    assert read_progress("\n".join(lines)) == ("iteration", 15, 40, "0:00:25")
    own = TrainingDisplay("title", "folder", 40, 0, 32, is_quiet=True)
    own.add_iteration(1, 32, {"Evaluation/track_percentage": 0.5})  # without falls, of an evaluation of a user's own
    assert own.line().endswith("; steps 32; tracking 0.500 (best 0.500)")
    assert read_tracking(lines[0]) == "" and read_tracking("\n".join(lines)) == "0.500"
    days = "iteration 2 of 400, 1 day, 0:13:20, 1 day, 20:13:20 left"
    assert read_progress(days) == ("iteration", 2, 400, "1 day, 20:13:20") and read_progress("nothing") is None


def test_lines_of_a_counter(capsys):
    """Every ten seconds; the first count, which may compile kernels, does not belong to the time."""
    clock = Clock()
    with Counter("evaluating, step", 10, clock=clock) as counter:
        for _ in range(5):
            clock.sleep(6.0)
            counter.add()
    texts = [f"evaluating, step {i} of 10, 0:00:{t}, 0:00:{left} left" for i, t, left in ((3, 12, 42), (5, 24, 30))]
    assert capsys.readouterr().err.splitlines() == texts
    assert read_progress(f"a line\n{texts[1]}; more") == ("evaluating, step", 5, 10, "0:00:30")


def test_quiet(capsys):
    """A quiet display and one without news are silent."""
    with TrainingDisplay("title", "folder", 2, 0, 32, is_quiet=True) as quiet:
        quiet.add_iteration(1, 32, NUMBERS)
    with TrainingDisplay("title", "folder", 2, 0, 32):
        pass
    assert capsys.readouterr().out == ""


OURS, OTHERS = f"_p{os.getpid()}_t7", "_p1_t7"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Warp's cache of kernels, with one old module."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    (tmp_path / "wp_old").mkdir()
    return tmp_path


def look(progress, seconds, *builds):
    """Let seconds pass while modules are built, each in a folder of its own that gets its final name."""
    for build in builds:
        build.mkdir(parents=True)
    for _ in range(4 * seconds):
        progress.look(0.25)
    for build in builds:
        build.rename(build.with_name(build.name.partition("_p")[0]))


def test_lines_of_kernels(cache):
    """After two seconds, then every ten; modules of the linker's folder count too, those of other processes do not."""
    progress = CompileProgress(stream := io.StringIO())
    look(progress, 60)
    look(progress, 1, cache / f"wp_a{OURS}")
    assert stream.getvalue() == ""
    look(progress, 3, cache / f"wp_b{OURS}", cache / f"wp_others{OTHERS}")
    look(progress, 9, cache / "lto" / f"wp_c{OURS}")
    look(progress, 60, cache / f"wp_d{OTHERS}")
    assert stream.getvalue().splitlines() == [f"{COMPILING}: 2 modules, 2 s", f"{COMPILING}: 3 modules, 12 s"]
    assert progress.modules == {"wp_a", "wp_b", "wp_c"}


def test_torch_compiles_without_a_cache(monkeypatch):
    """It is reported although no folder shows it."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", None)
    progress = CompileProgress(stream := io.StringIO())
    with torch_compiles():
        look(progress, 3)
    look(progress, 60)
    assert stream.getvalue() == f"{COMPILING}: 2 s\n"


def test_the_thread(cache):
    """It looks by itself while the context is open."""
    with CompileProgress(io.StringIO()) as progress:
        (cache / f"wp_a{OURS}").mkdir()
        assert wait_for(lambda: progress.modules) == {"wp_a"}
