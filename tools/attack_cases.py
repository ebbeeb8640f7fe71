"""Bad input, generated from the code itself: every setting and every option with bad values, every file damaged."""

from __future__ import annotations

import argparse
import io
import itertools
import json
import random
import struct
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from legged_torque.envs import task_registry
from legged_torque.utils.cli import Parser, finite
from legged_torque.utils.config import Section, section_keys
from legged_torque.utils.errors import UserError
from legged_torque.utils.limits import check_value, types_of
from tools import attack_fixture as fixtures
from tools.attack import Case
from tools.attack_fixture import WORDS

NOT_FINITE = (".nan", ".inf", "-.inf")
LONG = "x" * 300
READERS = {
    fixtures.CONFIG: ("evaluate.py", "export.py", "play.py", "learning_curve.py", "physics_accuracy.py", "train.py"),
    fixtures.CHECKPOINT: ("evaluate.py", "export.py", "play.py", "learning_curve.py", "train.py"),
    fixtures.WORLDS: ("train.py",),
    fixtures.PRETRAINED: ("train.py",),
    fixtures.DESCRIPTION: ("sim2sim.py",),
    fixtures.NETWORK: ("sim2sim.py",),
    fixtures.ROBOT: ("import_robot.py", "sim2sim.py", "train.py"),
    fixtures.PLAN: ("experiment.py",),
    fixtures.CURVE: ("plot.py",),
    fixtures.EVALUATIONS: ("plot.py",),
    f"{fixtures.RESULTS}/experiment.yaml": ("report.py",),
    f"{fixtures.CELL}/result_none.json": ("report.py",),
    f"{fixtures.CELL}/run/config.yaml": ("report.py",),
    f"{fixtures.CELL}/run/evaluations.csv": ("report.py",),
}
"""Every kind of file, and the scripts that read it."""
SEALED = (fixtures.CHECKPOINT, fixtures.PRETRAINED, fixtures.NETWORK)
"""Files with checksums: data that has changed must be refused."""
DAMAGES = 12  # truncations, and as many flipped bits, of a file for each of its readers
_MORE_WORDS = {
    (fixtures.CONFIG, "train.py"): ("--resume", "--max_iterations=2"),
    (fixtures.CHECKPOINT, "train.py"): ("--resume", "--max_iterations=2"),
    (fixtures.WORLDS, "train.py"): ("--resume", "--max_iterations=2"),
    (fixtures.PRETRAINED, "train.py"): ("--task=a1_torque_gravity",),
    (fixtures.ROBOT, "train.py"): (f"--set=asset.file={fixtures.ROBOT}",),
    (fixtures.ROBOT, "sim2sim.py"): (f"--xml={fixtures.ROBOT}",),
}


def all_cases(fixture: Path, parsers: Mapping[str, Parser], seed: int) -> list[Case]:
    """Return all cases in the folder of ``make_fixture``; files are damaged at random places that ``seed`` decides."""
    drawn = random.Random(seed)
    cases = [*setting_cases(), *config_cases(fixture), *plan_cases(), *option_cases(parsers)]
    return [*cases, *entry_cases(fixture, drawn), *robot_cases(fixture, drawn), *damage_cases(fixture, drawn)]


# ---- settings --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Setting:
    """A setting of a task or of its training."""

    task: str  # the first one that has it
    value: Any
    hint: Any  # what it may be, see utils/limits.py

    def allows(self, text: str) -> bool:
        """Return whether a text stands for a value that is within the limits."""
        try:
            check_value("", text if isinstance(self.value, str) else yaml.safe_load(text), self.hint)
        except UserError:
            return False
        return True


def settings() -> dict[str, Setting]:
    """Return every setting of every task and its training by dotted path."""
    result: dict[str, Setting] = {}
    for task in task_registry.names():
        for cfg in task_registry.get_cfgs(task):
            for path, value, hint in each(cfg):
                result.setdefault(path, Setting(task, value, hint))
    return result


def each(section: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield dotted path, value and type of every setting of a section and of those below."""
    owner: Any = type(section)
    hints = types_of(owner)
    for key in section_keys(section):
        value = getattr(section, key)
        if isinstance(value, Section):
            yield from each(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value, hints.get(key, object)


def bad_values(setting: Setting) -> Iterator[tuple[str, bool]]:
    """Yield texts for a setting, and whether it is wrong to accept each: beyond its limits it always is."""
    value = setting.value
    if isinstance(value, bool):
        sure, others = ["2", "maybe", ".nan", "null", "[]", "{}", "yes", "on"], []
    elif isinstance(value, (int, float)):
        sure = [*NOT_FINITE, "text", "null", "[1.0]", "true", "1.0e+30", "-1.0e+30", "1:30", "9" * 30]
        others = ["{a: 1}", "0", "-1", "0.5", "1000000000"]
    elif "ordered=True" in repr(setting.hint):
        sure = ["[.nan, 1.0]", "[0.0, .inf]", "[-.inf, 0.0]", "[2.0, 1.0]", "[1.0]", "[0.0, 1.0, 2.0]", "text"]
        sure += ["[a, b]", "1.0", "[]", "[[0.0, 1.0]]", "[-1.0e+30, 1.0e+30]"]
        others = ["[-2.0, -1.0]", "null"]
    elif isinstance(value, list) and value and all(type(entry) in (int, float) for entry in value):
        sure = ["[.nan]", "[a]", "text", "1.0", "[]", "null", "[[1]]", "[.inf]", "[1.0e+30]"]
        others = ["[-1]", "[0]", "[0.5]"]
    elif isinstance(value, list):
        sure, others = ["text", "5", "null", "{a: 1}", "[5]", "[.nan]"], ["[nothing]", "[[a]]", "['']"]
    elif isinstance(value, dict):
        sure, others = ["5", "text", "[]", "null", "{a: .nan}", "{a: text}", "{a: [1]}"], ["{a: 1.0}", "{}"]
    else:
        sure, others = [], ["nothing", "''", LONG, "../up", "5", "a:b"]
    yield from ((text, True) for text in sure)
    yield from ((text, not setting.allows(text)) for text in others)


def setting_cases() -> Iterator[Case]:
    """Yield every setting with bad values on the command line of a training."""
    for path, setting in settings().items():
        for text, must_refuse in bad_values(setting):
            words = (*WORDS["train.py"], f"--task={setting.task}", f"--set={path}={text}")
            yield Case(f"set {path}={text[:40]}", "train.py", words, must_refuse)


def config_cases(fixture: Path) -> Iterator[Case]:
    """Yield every setting of a run's config.yaml with something that it cannot be, for one of the scripts that read it.

    Beside the settings, the file has what else a run remembers.
    """
    config, scripts = yaml.safe_load((fixture / fixtures.CONFIG).read_text()), itertools.cycle(READERS[fixtures.CONFIG])
    paths = [path for path, _ in leaves(config) if path.startswith(("env.", "train.", "task", "max_iterations"))]
    for path, value in itertools.product(paths, (float("nan"), {"a": [1]})):
        is_text = isinstance(_entry(config, path), str)
        yield file_case(fixtures.CONFIG, next(scripts), path, value, _changed(config, path, value), not is_text)


def plan_cases() -> Iterator[Case]:
    """Yield every setting with bad values in the description of an experiment."""
    for path, setting in settings().items():
        texts = [text for text, must_refuse in bad_values(setting) if must_refuse][:3]
        for bad in map(yaml.safe_load, texts):
            plan = {"tasks": [setting.task], "environments": {"none": ["none"]}, "seeds": [1], "train": {path: bad}}
            yield file_case(fixtures.PLAN, "experiment.py", f"train.{path}", bad, _to_yaml(plan))
    for path, bad in {"sim.engine": "nope", "env.num_actions": 5, "asset.file": "missing.xml"}.items():
        plan = {"tasks": ["a1_position"], "environments": {"none": ["none"]}, "seeds": [1], "train": {path: bad}}
        yield file_case(fixtures.PLAN, "experiment.py", f"train.{path}", bad, _to_yaml(plan))


# ---- options ---------------------------------------------------------------------------------------------------------


def option_cases(parsers: Mapping[str, Parser]) -> Iterator[Case]:
    """Yield every option and argument of every script with bad values."""
    for script, parser in parsers.items():
        actions = [action for action in parser._actions if action.nargs != 0 and action.dest != "help"]
        for action in actions:
            for text, must_refuse in bad_words(action):
                if action.option_strings:
                    count = action.nargs if isinstance(action.nargs, int) else 1
                    words = [*WORDS[script], *([f"{action.option_strings[0]}={text}"] if count == 1 else ())]
                    words += [] if count == 1 else [action.option_strings[0], text, *["0"] * (count - 1)]
                else:
                    words = [text, *WORDS[script][1:]]
                yield Case(f"{script} {action.dest}={text[:40]!r}", script, tuple(words), must_refuse)


def bad_words(action: argparse.Action) -> Iterator[tuple[str, bool]]:
    """Yield texts for an option, and whether it is wrong to accept each."""
    if action.type is int:
        yield from ((text, True) for text in ("", "x", "1.5", "nan", "1e3", "9" * 30))
        yield "-1", action.dest != "checkpoint"
        yield "0", False
        if action.dest == "num_envs":
            yield "3000000000", True
    elif action.type in (float, finite):
        yield from ((text, True) for text in ("", "x", "nan", "inf", "-inf"))
        yield from ((text, False) for text in ("-1", "1e300"))
    elif action.dest == "host":
        yield from ((text, False) for text in ("", "nowhere.invalid", LONG))
    elif action.dest == "set":
        texts = (
            "",
            "=",
            "x",
            "=1",
            "seed",
            "a.b=1",
            "seed=",
            ".=1",
            "env=1",
            "env.=1",
            "env.num_envs.x=1",
            f"{LONG}=1",
        )
        yield from ((text, True) for text in (*texts, "env.num_envs=1:30", "env.num_envs=[[", "seed=!!python/name:os"))
    elif action.dest in ("run_name", "out") and action.option_strings:
        yield from ((text, True) for text in ("", LONG, "/dev/null/x", "/proc/x"))
        yield from ((text, False) for text in ("a\nb", "logs"))
    else:  # names, and files to read or to write
        yield from ((text, True) for text in ("", LONG, "/dev/null/x", "/proc/x/y"))
        yield from ((text, False) for text in ("logs", "nothing", "..", "/dev/null", "metrics.json", "no\nthing"))


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted path and the value of every entry of nested dictionaries that is none itself, or empty."""
    if not isinstance(value, dict) or not value:
        yield path, value
        return
    for key, entry in value.items():
        yield from leaves(entry, f"{path}.{key}" if path else str(key))


# ---- files -----------------------------------------------------------------------------------------------------------


def file_case(file: str, script: str, what: str, value: Any, content: str | bytes, must_refuse: bool = True) -> Case:
    """Return the case of a script that reads a file of this content."""
    words = (*WORDS[script], *_MORE_WORDS.get((file, script), ()))
    if file in (fixtures.DESCRIPTION, fixtures.NETWORK):
        words = (file, *words[1:])
    if script == "plot.py":
        words = ("curves", file, *words[2:])
    data = content if isinstance(content, bytes) else content.encode()
    return Case(
        f"{script} {Path(file).name} {what} {str(value)[:30]}".strip(), script, words, must_refuse, {file: data}
    )


def entry_cases(fixture: Path, drawn: random.Random) -> Iterator[Case]:
    """Yield files of YAML and JSON of which one entry is something else, or missing."""
    values: tuple = (float("nan"), 1e30, -1, "text", [], None, {"a": [1]})
    for file, scripts in READERS.items():
        if not file.endswith((".yaml", ".json")):
            continue
        content = yaml.safe_load((fixture / file).read_text())
        paths = [path for path, _ in leaves(content)] + list(content)
        chosen = drawn.sample(list(itertools.product(paths, values)), min(60, len(paths) * len(values)))
        for path, value in chosen:
            yield file_case(
                file, drawn.choice(scripts), path, value, _changed(content, path, value, Path(file).suffix), False
            )
        for name, text in {"deep": "[" * 3000, "empty": "", "list": "[1, 2]", "number": "5", "tabs": "\t:"}.items():
            is_note = file.startswith(fixtures.CELL)  # a report says what it cannot read
            yield file_case(file, scripts[0], name, "", text, not is_note)


def robot_cases(fixture: Path, drawn: random.Random) -> Iterator[Case]:
    """Yield robots of which an element is missing, or a number is another one."""
    text = (fixture / fixtures.ROBOT).read_text()
    for script in READERS[fixtures.ROBOT]:
        tree = ElementTree.fromstring(text)
        links = [(parent, child) for parent in tree.iter() for child in parent if "sensor" not in child.tag]
        for parent, child in drawn.sample(links, min(60, len(links))):
            at = list(parent).index(child)
            parent.remove(child)
            what = f"without {child.tag} {child.get('name') or child.get('class') or at}"
            yield file_case(fixtures.ROBOT, script, what, "", ElementTree.tostring(tree), False)
            parent.insert(at, child)
        entries = [(element, key) for element in tree.iter() for key in element.attrib]
        for element, key in drawn.sample(entries, 60):
            old, bad = element.attrib[key], drawn.choice(["nan", "-1", "0", "1e30", "text", ""])
            element.set(key, bad)
            what = f"{element.tag} {element.get('name') or element.get('class')} {key}={bad}"
            is_number = old.strip("-0123456789. e") == ""
            data = ElementTree.tostring(tree)
            yield file_case(fixtures.ROBOT, script, what, "", data, bad == "nan" and is_number)
            element.set(key, old)


def damage_cases(fixture: Path, drawn: random.Random) -> Iterator[Case]:
    """Yield files that were cut off, and files of which one bit is another."""
    for file, scripts in READERS.items():
        content = (fixture / file).read_bytes()
        for script, _ in itertools.product(scripts, range(DAMAGES)):
            end = drawn.randrange(len(content.rstrip()))
            is_sealed = file in SEALED or file == fixtures.CONFIG
            yield file_case(file, script, "cut at", end, content[:end], is_sealed)
            place, bit = drawn.randrange(len(content)), drawn.randrange(8)
            flipped = bytearray(content)
            flipped[place] ^= 1 << bit
            is_sealed = file in SEALED and is_data(content, place)
            yield file_case(file, script, "bit", f"{place}.{bit}", bytes(flipped), is_sealed)


def is_data(content: bytes, place: int) -> bool:
    """Return whether a place of a file is data of it, and not the filling between the parts of an archive."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        return True
    for info in zipfile.ZipFile(io.BytesIO(content)).infolist():
        start = info.header_offset  # of 30 bytes, of which the last four tell how much stands before the data
        begin = start + 30 + sum(struct.unpack("<HH", content[start + 26 : start + 30]))
        if begin <= place < begin + info.file_size:
            return True
    return False


def _entry(content: Any, path: str) -> Any:
    """Return an entry by its dotted path."""
    for key in path.split("."):
        content = content[key]
    return content


def _to_yaml(content: Any) -> str:
    """Return entries as YAML, written by LibYAML if PyYAML has it, which is ten times as fast."""
    return yaml.dump(content, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper))


def _changed(content: Any, path: str, value: Any, suffix: str = ".yaml") -> str:
    """Return the YAML or JSON of nested entries of which that at a dotted path has another value."""
    content = json.loads(json.dumps(content))
    *parents, last = path.split(".")
    section = content
    for key in parents:
        section = section[key]
    section[last] = value
    return json.dumps(content) if suffix == ".json" else _to_yaml(content)
