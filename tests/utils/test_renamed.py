"""Settings with new names: old runs have the same values, and old names on a command line are answered."""

import pytest
from support.settings import error_of

from legged_torque.utils.config import BaseConfig, to_dict
from legged_torque.utils.options import Options, apply_options


class Cfg(BaseConfig):
    """Settings of a later version."""

    class env:
        num_envs: int = 4

    class motors:
        strength: float = 1.0

        class delay:
            steps: list[int] = [0, 0]

    def upgraded(self, values):
        """The number of worlds was on top."""
        worlds = values.pop("worlds", None)
        return values if worlds is None else values | {"env": {"num_envs": worlds}}

    def renamed(self):
        """The settings that were in other places."""
        return {"worlds": "env.num_envs", "domain_rand.delay": "motors.delay"}


class TrainCfg(BaseConfig):
    """Settings of a training."""

    seed: int = 1

    def presets(self):
        """Those that every training has."""
        return {"parallel": {}}


def test_runs():
    """Settings of an earlier run are upgraded, those of today stay; what is unknown then is refused."""
    for run in ({"worlds": 7}, {"env": {"num_envs": 7}}):
        cfg = Cfg()
        apply_options(cfg, TrainCfg(), Options(), {"env": run, "train": {"seed": 3}})
        assert to_dict(cfg) == to_dict(Cfg()) | {"env": {"num_envs": 7}}
    run = {"env": {"world": 7}, "train": {}}
    assert error_of(apply_options, Cfg(), TrainCfg(), Options(), run).startswith("unknown config key 'world'")


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ("worlds=3", "'worlds' is now 'env.num_envs'"),
        ("domain_rand.delay.steps=[1, 2]", "'domain_rand.delay.steps' is now 'motors.delay.steps'"),
        ("domain_rand.delayed=1", "unknown config section 'domain_rand'"),
    ],
)
def test_command_line(item, message):
    """One line has the new name."""
    assert error_of(apply_options, Cfg(), TrainCfg(), Options(set=[item])).startswith(message)
