"""Any input is accepted, or refused by a UserError of one line; never another exception, and nothing is written.

``EXAMPLES=5000 python -m pytest tests/scripts/test_properties.py`` draws more and other inputs.
"""

import os
import runpy
import sys
import tempfile
from functools import cache
from pathlib import Path

import pytest
import torch
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.configuration import set_hypothesis_home_dir
from support.experiments import SMALL
from support.scripts import ROOT, contents

from legged_torque.envs import task_registry
from legged_torque.envs.base.validation import check_env_cfg
from legged_torque.experiments.matrix import read_plan
from legged_torque.learning import checkpoint
from legged_torque.utils.cli import Parser, options_of
from legged_torque.utils.config import Section, flat, section_keys, to_dict
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import types_of
from legged_torque.utils.options import Options
from legged_torque.utils.plain_yaml import dump_yaml, parse_yaml
from legged_torque.utils.runs import load_config, save_config

set_hypothesis_home_dir(Path(tempfile.gettempdir(), "hypothesis"))  # not in the repository
settings.register_profile("tests", database=None, deadline=None, derandomize="EXAMPLES" not in os.environ)
settings.load_profile("tests")
EXAMPLES = int(os.environ.get("EXAMPLES", 60))
TASKS = ["a1_torque_curriculum_multihead", "a1_rough_torque_multihead_scan", "a1_torque_gravity", "g1_position"]
SCRIPTS = ["train", "play", "evaluate", "export", "sim2sim", "experiment", "import_robot", "benchmark"]
NUMBERS = st.sampled_from([0, -1, 0.5, 2, 1e30, -1e30, float("nan"), float("inf"), 10**30, 2**63]) | st.integers()
LEAVES = st.none() | st.booleans() | NUMBERS | st.floats() | st.text(max_size=8)
VALUES = st.recursive(LEAVES, lambda part: st.lists(part, max_size=4) | st.dictionaries(st.text(max_size=4), part))
YAML = st.text("[]{}:,-&*!<>|'\"#%@?~=. \n\tab01eE_", max_size=40)
TEXTS = YAML | st.text(max_size=20) | VALUES.map(lambda value: yaml.safe_dump(value, allow_unicode=True))
PLACES = st.floats(0.0, 1.0, exclude_max=True) | st.floats(0.95, 1.0, exclude_max=True)


def like(value):
    """Values of the form of another one."""
    if isinstance(value, bool) or value is None:
        return st.none() | st.booleans()
    if isinstance(value, (int, float)):
        return NUMBERS | st.floats(-2.0, 2.0) | st.integers(0, 9)
    if isinstance(value, list):
        return st.tuples(*map(like, value)).map(list)
    return (
        st.fixed_dictionaries({key: like(part) for key, part in value.items()}) if isinstance(value, dict) else LEAVES
    )


def tried(function, *arguments):
    """What a function returns, or None if it refuses its input."""
    try:
        return function(*arguments)
    except UserError as error:
        assert str(error) and str(error).isprintable()
        return None


def try_inputs(*strategies):
    """Run a test with examples; fixtures may stay as they are between them."""
    fixtures = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    return lambda test: settings(max_examples=EXAMPLES, suppress_health_check=fixtures)(given(*strategies)(test))


def types_below(section, path=""):
    """(dotted path, type, value) of all settings of a section."""
    for key in section_keys(section):
        value = getattr(section, key)
        below = types_below(value, f"{path}{key}.") if isinstance(value, Section) else []
        yield from below or [(path + key, types_of(type(section)).get(key, object), value)]


@cache
def entries():
    """(path, task that has it, type, value) of all settings of some tasks and of their trainings."""
    cfgs = [(task, cfg) for task in TASKS for cfg in task_registry.get_cfgs(task)]
    found = {path: (task, hint, value) for task, cfg in cfgs for path, hint, value in types_below(cfg)}
    return [(path, *rest) for path, rest in found.items()]


@cache
def parser_of(script):
    """The parser of a script."""
    found = []

    def keep(parser, *_):
        found.append(parser)
        raise UserError("this is enough")

    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(Parser, "parse_args", keep)
        patch.setattr(sys, "argv", [script])
        patch.setenv("MUJOCO_GL", "disable")
        runpy.run_path(str(ROOT / "scripts" / f"{script}.py"), run_name="__main__")
    return found[0]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A folder with the settings of a run and a checkpoint."""
    folder = tmp_path_factory.mktemp("run")
    env_cfg, train_cfg = task_registry.get_cfgs(TASKS[0])
    save_config(folder, {"task": TASKS[0], "env": to_dict(env_cfg), "train": to_dict(train_cfg), "max_iterations": 3})
    checkpoint.write(folder / "model_1.pt", {"iter": 1, "weights": {"a": torch.randn(9)}, "infos": {"seconds": 1.0}})
    return folder


@try_inputs(TEXTS)
def test_yaml(text):
    """Whatever is read is written in a way that reads the same."""
    value = tried(parse_yaml, text, "it")
    again = parse_yaml(dump_yaml(value), "it")
    assert repr(again) == repr(value)


@try_inputs(st.data())
def test_settings(data):
    """Settings that are accepted are so again when a run is loaded."""
    path, task, _, value = data.draw(st.sampled_from(entries()))
    text = data.draw(TEXTS | like(value).map(yaml.safe_dump))
    cfgs = tried(task_registry.get_cfgs, task, Options(set=[f"{path}={text}"]))
    if cfgs:
        tried(check_env_cfg, cfgs[0])
        env, train = map(to_dict, cfgs)
        again = task_registry.get_cfgs(task, Options(), {"task": task, "env": env, "train": train})
        assert list(map(to_dict, again)) == [env, train]


@try_inputs(st.sampled_from(SCRIPTS), st.data())
def test_command_lines(script, data):
    """Options with any values, and other words, are parsed, and the settings that they ask for are made."""
    parser = parser_of(script)
    names = [
        name for action in parser._actions for name in action.option_strings if "help" not in name and name != "-h"
    ]
    words = st.builds("{}={}".format, st.sampled_from(names), TEXTS) | st.sampled_from(names) | st.text(max_size=6)
    line = data.draw(st.lists(words.filter(lambda word: not word.startswith("-h")), max_size=4))
    args = tried(parser.parse_args, line)
    has_number = isinstance(getattr(args, "num_envs", None), int | None)  # and not a list of benchmark.py
    if args and getattr(args, "set", None) is not None and not args.task_file and has_number:
        options = tried(options_of, args)
        tried(task_registry.get_cfgs, options.task or TASKS[0], options) if options else None


@try_inputs(st.data(), VALUES)
def test_entries_of_a_run(run, data, value):
    """A config.yaml of which an entry is anything is read, or not."""
    config = load_config(run)
    *parents, last = data.draw(st.sampled_from([*flat(config), "env", "train", "env.rewards", "versions"])).split(".")
    section = config
    for key in parents:
        section = section[key]
    section[last] = value
    tried(task_registry.get_cfgs, TASKS[0], Options(), config)


@pytest.mark.parametrize("name", ["config.yaml", "model_1.pt"])
@try_inputs(PLACES, st.integers(0, 7), st.booleans())
def test_damaged_files(name, run, place, bit, is_cut):
    """A file that is cut off, or of which a bit is another, is refused, or holds what it did."""
    content = (run / name).read_bytes()
    index = int(place * len(content))
    damaged = content[:index] if is_cut else content[:index] + bytes([content[index] ^ 1 << bit]) + content[index + 1 :]
    other = run / "other"
    other.mkdir(exist_ok=True)
    (other / name).write_bytes(damaged)
    before = contents(run)
    if name == "config.yaml":
        config = tried(load_config, other)
        assert config is None or not is_cut or damaged.rstrip() == content.rstrip()
    else:
        state = tried(checkpoint.read, other / name, "checkpoint", "cpu")
        whole = checkpoint.read(run / name, "checkpoint", "cpu")
        assert state is None or torch.equal(state["weights"]["a"], whole["weights"]["a"])
    assert contents(run) == before


@try_inputs(st.sampled_from([*SMALL, "ranges", "evaluation", "grounds", "other"]), VALUES)
def test_experiments(tmp_path, key, value):
    """A description of which an entry is anything is read, or not."""
    file = tmp_path / "matrix.yaml"
    file.write_text(yaml.safe_dump(SMALL | {key: value}), "utf-8", "surrogatepass")
    tried(read_plan, file)
    assert list(tmp_path.iterdir()) == [file]
