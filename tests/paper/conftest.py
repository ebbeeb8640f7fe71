"""Fixtures of the tests of reports."""

import pytest


@pytest.fixture(scope="module")
def coarse():
    """Figures of few pixels, which are drawn fast."""
    from legged_torque.paper.report import figures

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(figures.SETTINGS, "savefig.dpi", 20)
        yield
