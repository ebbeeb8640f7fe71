"""The browser of the tests of pages."""

import pytest


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A browser without a window."""
    from support.browser import start

    driver = start(tmp_path_factory.mktemp("browser"))
    yield driver
    driver.quit()
