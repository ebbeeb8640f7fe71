"""legged_torque: massively parallel training of torque-controlled legged robots on MuJoCo Warp and rsl_rl."""

from pathlib import Path

__version__ = "0.1.0"

ROOT_DIR = Path(__file__).resolve().parent.parent
"""Folder that holds the package, ``resources/``, ``scripts/`` and, by default, ``logs/``."""

RESOURCES_DIR = ROOT_DIR / "resources"
"""Folder of the robot models."""


def resource_path(file: str) -> Path:
    """Return where a file of the settings is: absolute paths as they are, others below the repository."""
    return Path(file) if Path(file).is_absolute() else ROOT_DIR / file
