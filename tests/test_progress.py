"""The line that tells of kernels being compiled: shown while this process compiles, and only then."""

import io
import os
import time

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


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A kernel cache with one old module; all times are a tenth of the real ones."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    for name in ("SHOW_AFTER", "QUIET_AFTER", "END_AFTER", "_POLL"):
        monkeypatch.setattr(progress, name, getattr(progress, name) / 10)
    (tmp_path / "wp_old").mkdir()
    return tmp_path


def build(cache, names, mark=OURS, seconds=0.15):
    """Do with the cache what Warp does when it compiles modules."""
    for name in names:
        folder = cache / f"{name}{mark}"
        folder.mkdir(parents=True)
        time.sleep(seconds)
        folder.rename(cache / name)


def test_line_in_a_file(cache):
    """Elsewhere than in a terminal a line is written now and then, and a last one with all modules."""
    stream = io.StringIO()
    with CompileProgress(stream) as compilation:
        build(cache, ["wp_a", "wp_b", "wp_c", "wp_d"])
    lines = stream.getvalue().splitlines()
    assert len(lines) == 2 and "\r" not in stream.getvalue()
    assert lines[0].startswith("compiling physics kernels, once per machine: ") and " modules, " in lines[0]
    assert lines[1].startswith("compiled physics kernels: 4 modules, ")
    assert compilation.modules == 4


def test_line_in_a_terminal(cache):
    """In a terminal the line is rewritten, and what is printed next covers it."""
    stream = Terminal()
    progress_line = CompileProgress(stream)
    progress_line._interval = 0.1
    with progress_line:
        build(cache, ["wp_a", "wp_b", "wp_c", "wp_d"])
    *rewritten, last = stream.getvalue().split("\r")
    assert len(rewritten) >= 2 and all(line.startswith("compiling") and "\n" not in line for line in rewritten)
    assert last.startswith("compiled physics kernels: 4 modules") and last.endswith(" \n")


def test_nothing_to_tell(cache):
    """Nothing is shown if all is in the cache, if little is compiled, or if another process compiles."""
    stream = io.StringIO()
    with CompileProgress(stream) as compilation:
        build(cache, ["wp_other"], mark=OTHERS, seconds=0.4)
    with CompileProgress(stream):
        time.sleep(0.4)
    with CompileProgress(stream) as short:
        build(cache, ["wp_short"], seconds=0.1)
    assert stream.getvalue() == ""
    assert (compilation.modules, short.modules) == (1, 1)


def test_work_that_counts(cache):
    """The first GPU kernels of an old module, and code that is linked into modules, count as compilation too."""
    stream = io.StringIO()
    with CompileProgress(stream) as compilation:
        build(cache / "lto", ["part"], seconds=0.4)
        (cache / "wp_old" / "module.sm90.cubin").touch()
    assert compilation.modules == 1
    assert stream.getvalue().splitlines()[-1].startswith("compiled physics kernels: 1 modules")


def test_the_end_of_watching(cache, monkeypatch):
    """When compilation is over the line is finished, and soon after nobody looks any more."""
    monkeypatch.setattr(progress, "END_AFTER", 1.0)
    stream = io.StringIO()
    with CompileProgress(stream) as compilation:
        build(cache, ["wp_a"], seconds=0.4)
        time.sleep(0.7)
        assert stream.getvalue().splitlines()[-1].startswith("compiled physics kernels: 1 modules")
        compilation._thread.join(timeout=2.0)
        assert not compilation._thread.is_alive()
    assert stream.getvalue().count("compiled") == 1


def test_without_warp(monkeypatch, tmp_path):
    """Before Warp is initialized there is no cache; the one that it then makes counts as it is found."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", None)
    with CompileProgress(io.StringIO()) as compilation:
        wp.config.kernel_cache_dir = str(tmp_path / "not there")
    assert compilation.modules == 0


def test_error_inside(cache):
    """An error goes through, and the thread ends."""
    with pytest.raises(ValueError, match="mine"), CompileProgress(io.StringIO()) as compilation:
        raise ValueError("mine")
    assert not compilation._thread.is_alive()
