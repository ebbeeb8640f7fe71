"""Reading robots from MJCF files: what MuJoCo does not like is told in one line, which names the file."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from pathlib import Path

import mujoco

from legged_torque.utils.errors import UserError


@contextlib.contextmanager
def loading(file: str | Path) -> Iterator[None]:
    """Turn MuJoCo's errors and warnings inside into a UserError that names the MJCF file."""
    if not Path(file).is_file():
        raise UserError(f"cannot load the robot '{file}': there is no such file")
    with kept_warnings() as told, warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            yield
        except (ValueError, mujoco.FatalError, UserWarning) as error:
            told.append(str(error))
    if told:
        raise UserError(f"cannot load the robot '{file}': {' '.join(told[0].split())}")


@contextlib.contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings inside, which it would print, and write to a file in the current folder."""
    told: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(told.append)
    try:
        yield told
    finally:
        mujoco.set_mju_user_warning(before)
