"""Choosing a renderer before MuJoCo is imported; this module must not import it."""

from __future__ import annotations

import ctypes.util
import os
from pathlib import Path

INSTALL_HINT = "on Debian: apt-get install libosmesa6, then MUJOCO_GL=osmesa"
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}


def disable_renderer() -> None:
    """Let MuJoCo import without a renderer, on which scripts that draw nothing must not depend."""
    os.environ["MUJOCO_GL"] = "disable"


def choose_offscreen_renderer() -> str | None:
    """Set ``MUJOCO_GL`` to a renderer that needs no screen; return why there is none, or None if there is one.

    The user's choice is taken if its library is installed; otherwise EGL where there is a GPU, then Mesa's software
    renderer. If there is none, MuJoCo imports without one, so that everything else works.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    if asked in _LIBRARIES:
        candidates = [asked]
    else:
        has_gpu = any(Path(path).exists() for path in ("/dev/nvidiactl", "/dev/dri"))
        candidates = ["egl", "osmesa"] if has_gpu else ["osmesa", "egl"]
    for name in candidates:
        if ctypes.util.find_library(_LIBRARIES[name]):
            os.environ["MUJOCO_GL"] = name
            return None
    disable_renderer()
    return f"the library of {' or '.join(candidates)} is not installed ({INSTALL_HINT})"
