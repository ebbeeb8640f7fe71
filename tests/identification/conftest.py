"""The robot that is identified."""

import pytest
from support.one_leg import one_leg


@pytest.fixture(scope="session")
def leg(tmp_path_factory):
    """Settings of a task whose robot has one leg."""
    return one_leg(tmp_path_factory.mktemp("leg"))
