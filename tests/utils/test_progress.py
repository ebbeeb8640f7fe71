"""The line that tells of kernels being compiled: shown while this process compiles, and only then."""

import io
import os
from types import SimpleNamespace

import pytest
import warp as wp

from legged_torque.utils import progress
from legged_torque.utils.progress import CompileProgress

OURS, OTHERS = f"_p{os.getpid()}_t7", "_p1_t7"


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self):
        """Return True."""
        return True


class Play:
    """Time that passes only while the watching thread waits, and what happens to a cache meanwhile."""

    def __init__(self, cache):
        self.cache, self.now, self.end, self.events = cache, 100.0, 100.0, []

    def after(self, seconds, action=lambda: None):
        """Plan what happens some seconds after all that is planned."""
        self.end += seconds
        self.events.append((self.end, action))

    def build(self, names, mark=OURS, seconds=1.5, folder="."):
        """Plan what Warp does when it compiles modules, one after the other."""
        for name in names:
            part = self.cache / folder / f"{name}{mark}"
            self.after(0.0, lambda part=part: part.mkdir(parents=True))
            self.after(seconds, lambda part=part, name=name: part.rename(part.with_name(name)))

    def wait(self, seconds):
        """Let time pass; stands in for the wait of an event, and returns whether the play is over."""
        self.now += seconds
        while self.events and self.events[0][0] <= self.now:
            self.events.pop(0)[1]()
        return self.now > self.end

    def set(self):
        """Nobody ends the play."""


@pytest.fixture
def play(tmp_path, monkeypatch):
    """A kernel cache with one old module, and the time in which things happen to it."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    (tmp_path / "wp_old").mkdir()
    play = Play(tmp_path)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: play.now))
    return play


def watch(play, stream):
    """Watch the whole play."""
    compilation = CompileProgress(stream)
    compilation._stop = play
    with compilation:
        compilation._thread.join()
    return compilation


def test_line_in_a_file(play):
    """Elsewhere than in a terminal a line is written now and then, and a last one with all modules."""
    play.build(["wp_a", "wp_b", "wp_c", "wp_d"])
    stream = io.StringIO()
    compilation = watch(play, stream)
    assert stream.getvalue().splitlines() == [
        "compiling kernels, once per machine: 1 modules, 2 s",
        "compiled kernels: 4 modules, 6 s",
    ]
    assert compilation.modules == 4


def test_line_in_a_terminal(play):
    """In a terminal the line is rewritten every second, and what is printed next covers it."""
    stream = Terminal()
    play.build(["wp_a", "wp_b", "wp_c", "wp_d"])
    watch(play, stream)
    *rewritten, last = stream.getvalue().split("\r")
    assert len(rewritten) == 4 and all(line.startswith("compiling") and "\n" not in line for line in rewritten)
    assert last.startswith("compiled kernels: 4 modules, 6 s") and last.endswith(" \n")


def test_nothing_to_tell(play):
    """Nothing is shown if all is in the cache, if little is compiled, or if another process compiles."""
    stream = io.StringIO()
    play.build(["wp_other"], mark=OTHERS, seconds=4.0)
    assert watch(play, stream).modules == 1
    play.after(4.0)
    assert watch(play, stream).modules == 0
    play.build(["wp_short"], seconds=1.5)
    assert watch(play, stream).modules == 1
    assert stream.getvalue() == ""


def test_work_that_counts(play):
    """The first GPU kernels of an old module, and code that is linked into modules, count as compilation too."""
    stream = io.StringIO()
    play.build(["part"], seconds=4.0, folder="lto")
    play.after(0.0, (play.cache / "wp_old" / "module.sm90.cubin").touch)
    assert watch(play, stream).modules == 1
    assert stream.getvalue().splitlines()[-1].startswith("compiled kernels: 1 modules")


def test_what_torch_compiles_counts(play):
    """The line is shown while torch compiles, which has no modules, and its folder is none."""
    stream = io.StringIO()
    play.after(1.0, progress.TORCH_COMPILES.set)
    play.after(1.0, (play.cache / progress.TORCH_FOLDER).mkdir)
    play.after(3.0, progress.TORCH_COMPILES.clear)
    assert watch(play, stream).modules == 0
    assert stream.getvalue().splitlines()[-1] == "compiled kernels: 0 modules, 4 s"


def test_the_end_of_watching(play):
    """When compilation is over the line is finished, and later nobody looks any more."""
    stream, finished = io.StringIO(), []
    play.build(["wp_a"], seconds=4.0)
    play.after(4.0, lambda: finished.append("compiled" in stream.getvalue()))
    play.after(2.0, lambda: finished.append("compiled" in stream.getvalue()))
    play.after(200.0)
    watch(play, stream)
    assert finished == [False, True] and stream.getvalue().count("compiled") == 1
    assert play.now == pytest.approx(104.0 + progress.END_AFTER, abs=1.0)


def test_without_warp(monkeypatch, tmp_path):
    """Before Warp is initialized there is no cache; the one that it then makes counts as it is found."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", None)
    with CompileProgress(io.StringIO()) as compilation:
        wp.config.kernel_cache_dir = str(tmp_path / "not there")
    assert compilation.modules == 0


def test_error_inside(play):
    """An error goes through, and the thread ends."""
    with pytest.raises(ValueError, match="mine"), CompileProgress(io.StringIO()) as compilation:
        raise ValueError("mine")
    assert not compilation._thread.is_alive()
