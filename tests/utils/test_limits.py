"""Every setting says what it may be, and other values are refused by its name."""

import math
from pathlib import Path
from typing import Annotated, Literal

import pytest
import yaml
from support.settings import COMBINATIONS, TASKS, error_of, get, get_cfgs

from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.utils.config import Section, flat, set_by_path, to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import Count, Interval, Limits, Positive


def with_bad_number(value, bad):
    """A setting's value with a bad number in place of its numbers; None if it has none."""
    if isinstance(value, dict):
        return dict.fromkeys(value, bad) or None
    if isinstance(value, list):
        return [bad] * len(value) if value and isinstance(value[0], (int, float)) else None
    return bad if isinstance(value, (int, float)) and not isinstance(value, bool) else None


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30, True, "text", [], {}])
def test_no_number_may_be_anything(bad):
    """A number that is not finite or absurdly large, or something else in its place, is refused by its name."""
    checked = set()  # settings of all tasks, each in the first task that has it
    for task in TASKS + COMBINATIONS:
        for i, cfg in enumerate(get_cfgs(task=task)):
            for path, value in flat(to_dict(cfg)).items():
                wrong = with_bad_number(value, bad)
                by_name = bad == {} and path.startswith(("control.", "motors."))  # joints, which the task refuses
                others = path.startswith("init_state.default_joint_angles.") or (i, path) in checked
                if wrong is None or by_name or others:
                    continue
                with pytest.raises(UserError, match=path.split(".")[-1]):
                    set_by_path(cfg, path, wrong)
                assert get(cfg, path) == value
                checked.add((i, path))
    assert len(checked) > 120


@pytest.mark.parametrize(
    "change", yaml.safe_load(Path(__file__).with_name("limits.yaml").read_text("utf-8"))["refused"]
)
def test_values_without_sense(change):
    """They are refused by the name of the setting, with what is allowed."""
    message = error_of(lambda: check_env_cfg(get_cfgs(f"--set={change}")[0]))
    assert change.partition("=")[0].rpartition(".")[2] in message
    assert any(word in message for word in ("must be", "takes", "did you mean", "nothing starts from it"))


def test_a_variants_own_settings():
    """A type that a variant declares holds for its subclasses too; null is allowed where the type says so."""

    class Variant(Section):
        rate: Positive = 1.0
        number: Count | None = None
        kind: Literal["a", "b"] = "a"
        sizes: Annotated[dict[str, float], Limits(0, 2)] = {"x": 1.0}
        limits: Interval = [0, 1]

    class Other(Variant):
        rate = -1.0

    Variant().check()
    assert error_of(Other().check, "variant") == "variant.rate must be greater than 0, not -1.0"
    for name, value in {"number": 0, "kind": "c", "sizes": {"x": 3.0}, "limits": [1, 0], "rate": None}.items():
        changed = Variant()
        setattr(changed, name, value)
        assert error_of(changed.check).startswith((f"{name} must be ", f"unknown {name} "))


def test_a_type_that_is_not_known():
    """It is named with its class."""

    class Variant(Section):
        length: "Length" = 1.0  # noqa: F821

    assert error_of(Variant().check).endswith("Variant is not known: name 'Length' is not defined")
