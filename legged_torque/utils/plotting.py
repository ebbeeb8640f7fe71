"""Drawing without a screen."""

from __future__ import annotations

from types import ModuleType

from legged_torque.utils.errors import UserError


def load_pyplot() -> ModuleType:
    """Return ``matplotlib.pyplot``, which then writes files and opens no windows.

    Raises:
        UserError: If matplotlib is missing.
    """
    try:
        import matplotlib

        matplotlib.use("agg")
        from matplotlib import pyplot
    except ImportError:
        raise UserError("plots need the extra: pip install -e .[plots]") from None
    return pyplot
