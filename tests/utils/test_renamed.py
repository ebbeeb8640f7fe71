"""Settings with new names: old runs have the same values, and old names on a command line are answered."""

import pytest
from support.settings import error_of

from legged_torque.utils.config import BaseConfig, to_dict
from legged_torque.utils.options import Options, apply_options
from legged_torque.utils.renamed import with_new_names


class Cfg(BaseConfig):
    """Settings of a later version."""

    class env:
        num_envs: int = 4

    class motors:
        strength: float = 1.0

        class delay:
            steps: list[int] = [0, 0]  # noqa: RUF012
            unit: str = "physics"

    def renamed(self):
        """The settings that were in other places."""
        return {
            "domain_rand.delay": "motors.delay",
            "domain_rand.strength_share": lambda share: {} if share is None else {"motors.strength": 1.0 + share},
            "domain_rand.strength": lambda strength: {} if strength is None else {"motors.strength": strength},
            "worlds": "env.num_envs",
        }


class TrainCfg(BaseConfig):
    """Settings of a training."""

    seed: int = 1

    def presets(self):
        """Those that every training has."""
        return {"parallel": {}}


def load(run):
    """The settings that a run gives."""
    cfg = Cfg()
    apply_options(cfg, TrainCfg(), Options(), {"env": run, "train": {}})
    return to_dict(cfg)


@pytest.mark.parametrize(
    ("run", "values"),
    [
        ({"worlds": 7}, {"env": {"num_envs": 7}}),
        ({"domain_rand": {"delay": {"steps": [1, 2]}}}, {"motors": {"delay": {"steps": [1, 2]}}}),
        ({"domain_rand": {"strength_share": 0.5, "strength": None}}, {"motors": {"strength": 1.5}}),
        ({"domain_rand": {"strength_share": 0.5, "strength": 3.0}}, {"motors": {"strength": 3.0}}),
        ({"motors": {"delay": {"unit": "control"}}, "domain_rand": {"delay": {"steps": [3, 3]}}},
         {"motors": {"delay": {"steps": [3, 3], "unit": "control"}}}),
        ({"env": {"num_envs": 9}}, {"env": {"num_envs": 9}}),
    ],
)  # fmt: skip
def test_runs(run, values):
    """Values move, sections keep their other entries, functions translate, and current names stay."""
    expected = to_dict(Cfg())
    for section, entries in values.items():
        for name, value in entries.items():
            expected[section][name] = expected[section][name] | value if isinstance(value, dict) else value
    assert load(run) == expected


def test_other_names_are_still_refused():
    """An entry that was never a setting does not vanish, and the run's own dictionaries stay as they are."""
    run = {"domain_rand": {"delay": {"steps": [1, 2]}, "other": 1}}
    assert "unknown config key 'domain_rand'" in error_of(load, run)
    assert run == {"domain_rand": {"delay": {"steps": [1, 2]}, "other": 1}}
    assert with_new_names({"domain_rand": 3}, Cfg().renamed()) == {"domain_rand": 3}


@pytest.mark.parametrize(
    ("item", "message"),
    [
        ("worlds=3", "'worlds' is now 'env.num_envs'"),
        ("domain_rand.delay.steps=[1, 2]", "'domain_rand.delay.steps' is now 'motors.delay.steps'"),
        ("domain_rand.strength=2.0", "'domain_rand.strength=2.0' is now 'motors.strength=2.0'"),
        ("domain_rand.strength=null", "'domain_rand.strength' is not a setting any more"),
        ("domain_rand.strength_share=much", "'domain_rand.strength_share' is not a setting any more"),
        ("domain_rand.strengths=1", "unknown config section 'domain_rand'"),
    ],
)
def test_command_line(item, message):
    """One line has the new name, and where the value changes as well, what to write instead."""
    assert error_of(apply_options, Cfg(), TrainCfg(), Options(set=[item])).startswith(message)
