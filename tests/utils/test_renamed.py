"""Settings with new names: old runs have the same values."""

from support.settings import error_of

from legged_torque.utils.config import BaseConfig, to_dict
from legged_torque.utils.options import Options, apply_options


class Cfg(BaseConfig):
    """Settings of a later version."""

    class env:
        num_envs: int = 4

    def upgraded(self, values):
        """The number of worlds was on top."""
        worlds = values.pop("worlds", None)
        return values if worlds is None else values | {"env": {"num_envs": worlds}}


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
        assert to_dict(cfg) == {"env": {"num_envs": 7}}
    run = {"env": {"world": 7}, "train": {}}
    assert error_of(apply_options, Cfg(), TrainCfg(), Options(), run).startswith("unknown config key 'world'")
