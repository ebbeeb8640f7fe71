"""Settings of runs of commit d8439d6, in today's layout."""

from pathlib import Path

import yaml
from support.settings import get_cfgs

from legged_torque.envs.base.older_runs import converted, is_older
from legged_torque.utils.config import to_dict

RANGES = yaml.safe_load(Path(__file__).with_name("older_run.yaml").read_text("utf-8"))
"""``domain_rand`` of such a run, and what it is today."""


def test_ranges():
    """Each parameter has the ranges that were drawn: shares where there was no number, none that were kept fixed."""
    values = {"domain_rand": RANGES["before"], "motors": {"model": "ideal"}, "env": {"num_envs": 3}}
    assert is_older(values)
    new = converted(values)
    assert new["env"] == {"num_envs": 3}
    assert new["motors"] == {"delay": {"range": [0, 6], "unit": "physics_steps"}}
    assert new["domain_rand"] == RANGES["after"]


def test_a_run_is_loaded():
    """A task takes the settings of such a run, and those of today's runs as they are."""
    today = to_dict(get_cfgs("--perturbation=low")[0])
    assert not is_older(today)
    old = today | {
        "domain_rand": {k: v for k, v in RANGES["before"].items() if k != "thigh_mass_scale"},
        "motors": {"model": "ideal"},
    }
    cfg = get_cfgs(run_config={"env": old, "train": {}})[0]
    assert cfg.domain_rand.dof_damping == {"set": [0.0, 0.2]} and cfg.motors.delay.range == [0, 6]
    assert to_dict(get_cfgs(run_config={"env": today, "train": {}})[0]) == today
