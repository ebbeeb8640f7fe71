"""Reports of experiments and runs: tables, figures and one HTML page."""

from legged_torque.utils.errors import require


def check_extra() -> None:
    """Raise a UserError if a package that reports and their figures need is missing."""
    require("jinja2", "markdown_it", "matplotlib", "pandas", "scipy", extra="plots")
