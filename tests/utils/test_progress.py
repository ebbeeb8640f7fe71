"""The lines about kernels that are being compiled: shown while this process compiles, and only then."""

import io
import os

import pytest
import warp as wp
from support.clock import wait_for

from legged_torque.utils.progress import COMPILING, CompileProgress, torch_compiles

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


def test_lines(cache):
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
