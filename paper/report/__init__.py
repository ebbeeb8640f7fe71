"""Reports of experiments and runs: tables, figures and one HTML page."""

import importlib

from legged_torque.utils.errors import UserError


def check_extra() -> None:
    """Raise a UserError if a package that reports and their figures need is missing."""
    for package in ("jinja2", "markdown_it", "matplotlib", "pandas", "scipy.stats"):
        try:
            importlib.import_module(package)
        except ImportError:
            raise UserError("reports need the extra: pip install 'legged_torque[plots]'") from None
