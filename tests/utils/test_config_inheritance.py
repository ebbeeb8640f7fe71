"""Nested settings inherit by themselves, and misspelt ones are refused before anything is built."""

import pytest
from support.settings import error_of

from legged_torque.envs import task_registry
from legged_torque.utils.config import BaseConfig, Section, to_dict


class Base(BaseConfig):
    """What all others inherit."""

    class control:
        stiffness = 1.0
        damping = 2.0

        class mixing:
            start = 3.0
            end = 4.0

    class rewards:
        scale = 5.0


class Robot(Base):
    """A robot's settings."""

    class control:
        stiffness = 20.0

        class mixing:
            end = 40.0

    class rewards:
        scale = 6.0


class Approach(Base):
    """An approach's settings, with a section and a setting of its own."""

    class control:
        damping = 9.0

        class ramp(Section):
            time = 0.5

        class mixing:
            start = 30.0

    class rewards:
        scale = 8.0
        temperature: float = 7.0


class Both(Approach, Robot):
    """An approach on a robot."""


class Reverse(Robot, Approach):
    """The same with the robot's settings first."""


def test_sections_of_several_bases_combine():
    """Each base contributes what it says, at every depth; the first base wins, and gives the order of entries."""
    assert to_dict(Both()) == {
        "control": {"stiffness": 20.0, "damping": 9.0, "mixing": {"start": 30.0, "end": 40.0}, "ramp": {"time": 0.5}},
        "rewards": {"scale": 8.0, "temperature": 7.0},
    }
    assert list(to_dict(Both())["control"]) == ["stiffness", "damping", "mixing", "ramp"]
    assert to_dict(Reverse()) == to_dict(Both()) | {"rewards": {"scale": 6.0, "temperature": 7.0}}
    assert to_dict(Approach())["control"]["stiffness"] == to_dict(Base())["control"]["stiffness"] == 1.0


def test_named_bases_change_nothing():
    """legged_gym's explicit way gives the same, also where it names only one of the bases."""

    class Explicit(Approach, Robot):
        class control(Robot.control):
            class mixing(Robot.control.mixing):
                end = 41.0

    class Short(Approach, Robot):
        class control:
            class mixing:
                end = 41.0

    assert to_dict(Explicit()) == to_dict(Short())
    assert Explicit.control.damping == 9.0 and Explicit.control.mixing.start == 30.0


MISTAKES = {
    "class control: stifness = 1.0": "setting or section of V.control 'stifness'; did you mean 'stiffness'?",
    "class contrl: stiffness = 1.0": "setting or section of V 'contrl'; did you mean 'control'?",
    "class control:\n  class mixing: stat = 1.0": "of V.control.mixing 'stat'; did you mean 'start'?",
    "control = 3": "V.control is a setting, but in Both it is a section",
    "class rewards:\n  class scale: a = 1": "V.rewards.scale is a section, but in Both.rewards it is a setting",
}


@pytest.mark.parametrize("text", MISTAKES)
def test_misspelt_names_are_refused(text):
    """A name that no base has is reported with the nearest one, before anything is built."""
    lines = "\n".join(f" {line}" for line in text.splitlines())
    exec(f"class V(Both):\n{lines}", globals())  # the only way to write a class from a table
    message = error_of(V().check)  # noqa: F821
    assert MISTAKES[text] in message and "\n" not in message


class Port(Both):
    """Settings with many mistakes, in sections of both kinds and in a section of a section."""

    class control(Both.control):
        control_type = "P"
        dampin = 1.0

        class mixing(Both.control.mixing):
            strt = 2.0

    class viewer:
        ref_env = 0

    rewards = 3


class PortAgain(Port):
    """A variant of it with one more."""

    class rewards:
        scle = 1.0


def test_all_mistakes_are_told_at_once():
    """Those of bases, of nested classes with and without a base, and legged_gym's names with their successors."""
    message = error_of(task_registry.register, "port", "no:Task", PortAgain(), PortAgain())
    for part in ("control_type", "strt", "viewers", "TorqueRobot", "Port.rewards is a setting", "scle"):
        assert part in message
    assert "did you mean 'damping'?" in message and "'P'" not in message
    assert "port" not in task_registry._tasks
