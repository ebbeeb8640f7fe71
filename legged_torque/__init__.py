"""legged_torque: massively parallel training of torque-controlled legged robots on MuJoCo Warp and rsl_rl."""

from pathlib import Path

__version__ = "0.1.0"

_CHECKOUT = Path(__file__).resolve().parents[1]
if (_CHECKOUT / "paper" / "__init__.py").is_file():
    __path__.append(str(_CHECKOUT))  # legged_torque.paper is next to the package; a wheel holds it inside


def _find_dir(name: str, installed_name: str = "") -> Path:
    """Return a folder that a wheel holds inside the package, maybe by another name, and a checkout next to it."""
    package = Path(__file__).resolve().parent
    installed = package / (installed_name or name)
    return installed if installed.is_dir() else package.parent / name


RESOURCES_DIR = _find_dir("resources")  # folder of the robot models

SCRIPTS_DIR = _find_dir("scripts")  # folder of the scripts

EXPERIMENTS_DIR = _find_dir("experiments", "descriptions")  # folder of the descriptions of experiments


def resource_path(file: str | Path) -> Path:
    """Return where a file is that settings name, for instance ``asset.file``; whether it exists is not checked.

    Args:
        file: An absolute path, one below ``resources/``, which means :data:`RESOURCES_DIR`, or one that is relative to
            the current directory.
    """
    path = Path(file)
    return RESOURCES_DIR.parent / path if path.parts[:1] == ("resources",) else path


def experiment_path(file: str | Path) -> Path:
    """Return where the description of an experiment is: ``experiments/<name>`` comes with the package.

    Args:
        file: A path. One below ``experiments/`` that is not in the current directory may be in :data:`EXPERIMENTS_DIR`.
    """
    path = Path(file)
    installed = EXPERIMENTS_DIR / path.name
    return installed if path.parts[:1] == ("experiments",) and not path.exists() and installed.is_file() else path
