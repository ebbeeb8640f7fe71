"""The lines about kernels that are being compiled: shown while this process compiles, and only then."""

import io
import os
import time

import pytest
import warp as wp

from legged_torque.utils.progress import COMPILING, TORCH_COMPILES, CompileProgress, torch_compiles

OURS, OTHERS = f"_p{os.getpid()}_t7", "_p1_t7"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Warp's cache of kernels, with one old module."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    (tmp_path / "wp_old").mkdir()
    return tmp_path


def look(progress, seconds, builds=()):
    """Let seconds pass while modules are built, each in a folder of its own that gets its final name."""
    for build in builds:
        build.mkdir(parents=True)
    for _ in range(4 * seconds):
        progress.look(0.25)
    for build in builds:
        build.rename(build.with_name(build.name.partition("_p")[0]))


@pytest.fixture
def progress(cache):
    """What watches the cache; the time is that of the tests."""
    return CompileProgress(io.StringIO())


def lines(progress):
    """The lines so far."""
    return progress._stream.getvalue().splitlines()


def test_lines(progress, cache):
    """After two seconds, then every ten; modules of the linker's folder count too, those of other processes do not."""
    look(progress, 60)
    look(progress, 1, [cache / f"wp_a{OURS}"])
    assert lines(progress) == []
    look(progress, 3, [cache / f"wp_b{OURS}", cache / f"wp_others{OTHERS}"])
    look(progress, 9, [cache / "lto" / f"wp_c{OURS}"])
    assert lines(progress) == [f"{COMPILING}: 2 modules, 2 s", f"{COMPILING}: 3 modules, 12 s"]
    assert progress.modules == {"wp_a", "wp_b", "wp_c"}
    look(progress, 60, [cache / f"wp_d{OTHERS}"])
    assert len(lines(progress)) == 2


def test_short_compilations_are_not_reported(progress, cache):
    """Nor is a cache that has all kernels, or none yet."""
    look(progress, 1, [cache / f"wp_a{OURS}"])
    look(progress, 60)
    wp.config.kernel_cache_dir = None
    look(progress, 1)
    wp.config.kernel_cache_dir = str(cache / "missing")
    look(progress, 1)
    assert lines(progress) == []


def test_torch_compiles_as_well(progress):
    """Which no folder shows."""
    with torch_compiles():
        look(progress, 3)
    assert lines(progress) == [f"{COMPILING}: 0 modules, 2 s"] and not TORCH_COMPILES.is_set()


def test_the_thread(cache):
    """It looks by itself while the context is open."""
    with CompileProgress(io.StringIO()) as progress:
        (cache / f"wp_a{OURS}").mkdir()
        deadline = time.monotonic() + 20.0
        while not progress.modules and time.monotonic() < deadline:
            time.sleep(0.05)
    assert progress.modules == {"wp_a"}
