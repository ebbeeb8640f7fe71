"""Fixtures of the tests of exports: one export of a task with two kinds of actions."""

import pytest
import yaml


@pytest.fixture(scope="session")
def exported(make_task, tmp_path_factory):
    """Folder of an export of ``a1_torque_multihead``."""
    from support.exports import export_random

    folder = tmp_path_factory.mktemp("export") / "out"
    export_random(make_task, "a1_torque_multihead", folder)
    return folder


@pytest.fixture(scope="session")
def description(exported):
    """The contents of its ``policy.yaml``."""
    return yaml.safe_load((exported / "policy.yaml").read_text())


@pytest.fixture(scope="session")
def policy(exported):
    """The policy; tests reset it before they use it."""
    from legged_torque.deploy.policy import Policy

    return Policy(exported)
