"""Reading, checking and writing ``policy.yaml``, the description of how to run a policy on a robot."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.limits import LARGEST
from legged_torque.utils.plain_yaml import Dumper, parse_yaml

DESCRIPTION_FILE = "policy.yaml"
NETWORK_FILE = "policy.onnx"
SCHEMA_FILE = Path(__file__).with_name("policy.schema.json")
FORMAT_VERSION = 1


def read(path: str | Path) -> tuple[dict[str, Any], Path]:
    """Read and check the description of a policy; return it and the file of the network.

    ``path`` is ``policy.yaml``, a network in its folder, or that folder. A UserError names what is missing or wrong.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"there is no file or folder '{path}'")
    folder = path if path.is_dir() else path.parent
    is_network = path.suffix == ".onnx"
    file = folder / DESCRIPTION_FILE if path.is_dir() or is_network else path
    if not file.is_file():
        raise UserError(f"there is no {DESCRIPTION_FILE} in '{folder}'")
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise UserError(f"'{file}' is not valid YAML: {error}") from None
    description = parse_yaml(text, f"'{file}'")
    check(description, f"'{file}'")
    name = description["network"]["file"]
    if Path(name).name != name:
        raise UserError(f"'{file}': network.file must be the name of a file beside it, not '{name}'")
    network = path if is_network else folder / name
    if not network.is_file():
        raise UserError(f"there is no network '{network}'")
    return description, network


def to_yaml(description: dict[str, Any]) -> str:
    """Return the text of a description, section by section with the schema's comment above each."""
    parts, sections = [], _schema()["properties"]
    for key, value in description.items():
        comment = "".join(f"# {line}\n" for line in sections[key].get("description", "").splitlines())
        flow = None if isinstance(value, (dict, list)) else False  # plain values on one line
        parts.append(
            comment + yaml.dump({key: value}, Dumper=Dumper, sort_keys=False, width=100, default_flow_style=flow)
        )
    return "\n".join(parts)


def check(description: Any, where: str = DESCRIPTION_FILE) -> None:
    """Check structure, values and their consistency; a UserError names the first wrong entry, and ``where`` it is."""
    _check_schema(description, where)
    for path, value in _numbers(description):
        if not abs(value) <= LARGEST and not path.startswith("training."):
            raise UserError(f"{where}: {path} is not a finite number, at most {LARGEST:g} either way")
    _check_joints(description, where)
    _check_terms(description, where)
    _check_ranges(description, where)
    timing = description["timing"]
    if not math.isclose(timing["physics_frequency"], timing["control_frequency"] * timing["decimation"], rel_tol=1e-6):
        raise UserError(f"{where}: timing.physics_frequency is not control_frequency times decimation")


def interface(description: dict[str, Any]) -> dict[str, str]:
    """Return the meaning of a network's inputs and outputs as strings by key, which are stored in the network."""
    return {key: json.dumps(description[key]) for key in ("joint_order", "nominal_pose", "observations", "actions")}


def _schema() -> dict[str, Any]:
    """Return the schema of descriptions."""
    return json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))


def _check_schema(description: Any, where: str) -> None:
    """Check structure, types and single values."""
    try:
        import jsonschema
    except ImportError:
        raise missing_extra("jsonschema") from None
    draft = jsonschema.Draft202012Validator  # which would take 4.0 as an integer
    types = draft.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
    validator = jsonschema.validators.extend(draft, type_checker=types)(_schema())
    error = jsonschema.exceptions.best_match(validator.iter_errors(description))
    if error is not None:
        path = ".".join(str(key) for key in error.absolute_path) or "the file"
        message = " ".join(error.message.split())
        raise UserError(f"{where}: {path}: {message if len(message) < 160 else '... ' + message[-150:]}")


def _check_joints(description: dict[str, Any], where: str) -> None:
    """Check that values by joint cover all joints and no others."""
    joints = description["joint_order"]
    by_joint = {key: description[key] for key in ("nominal_pose", "torque_limits", "joints")}
    by_joint |= {f"gains.{key}": values for key, values in description["gains"].items()}
    for path, values in by_joint.items():
        for name in values:
            if name not in joints:
                raise unknown_name(f"joint in {path} of {where}", name, joints)
        for name in joints:
            if name not in values:
                raise UserError(f"{where}: {path} lacks the joint '{name}'")


def _check_terms(description: dict[str, Any], where: str) -> None:
    """Check the sizes of the terms of observations and actions; terms of a user's task may have any size."""
    observations, actions, network = (description[key] for key in ("observations", "actions", "network"))
    num_joints, num_actions = len(description["joint_order"]), sum(term["size"] for term in actions["terms"])
    sizes = dict.fromkeys(("projected_gravity", "angular_velocity", "command"), 3)
    sizes |= dict.fromkeys(("joint_position", "joint_velocity", "position_residual", "torque"), num_joints)
    sizes |= {"last_action": num_actions, "position_phase": 1}
    for terms in (observations["terms"], actions["terms"]):
        names = [term["name"] for term in terms]
        for term in terms:
            name, scan = term["name"], term.get("scan")
            if (name == "height_scan") != (scan is not None):
                raise UserError(f"{where}: the term 'height_scan' must have an entry scan, and no other term")
            size = len(scan["points_x"]) * len(scan["points_y"]) if scan else sizes.get(name, term["size"])
            if names.count(name) > 1:
                raise UserError(f"{where}: the term '{name}' occurs more than once")
            if term["size"] != size:
                raise UserError(f"{where}: the term '{name}' must have size {size}, not {term['size']}")
            if isinstance(term["scale"], list) and len(term["scale"]) != size:
                raise UserError(f"{where}: the term '{name}' must have one scale or {size}, not {len(term['scale'])}")
    num_observations = sum(term["size"] for term in observations["terms"]) * observations["history_length"]
    for key, value in {"num_observations": num_observations, "num_actions": num_actions}.items():
        if network[key] != value:
            raise UserError(f"{where}: network.{key} is {network[key]}, but the terms have {value} numbers")


def _check_ranges(description: dict[str, Any], where: str) -> None:
    """Check that no range has its ends swapped."""
    sections = ("torque_limits", "commands", "initial_state")
    ranges = {f"{section}.{key}": limits for section in sections for key, limits in description[section].items()}
    ranges |= {f"clip of {term['name']}": term["clip"] for term in description["observations"]["terms"]}
    ranges["actions.clip"] = description["actions"]["clip"]
    for path, limits in ranges.items():
        if isinstance(limits, list) and len(limits) == 2 and limits[0] > limits[1]:
            raise UserError(f"{where}: {path} must be [lowest, highest], not {limits}")


def _numbers(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Return every number of nested lists and dictionaries, with its dotted path."""
    if isinstance(value, (dict, list)):
        entries = value.items() if isinstance(value, dict) else enumerate(value)
        for key, entry in entries:
            yield from _numbers(entry, f"{path}.{key}" if path else str(key))
    elif isinstance(value, (int, float)):
        yield path, value


def missing_extra(package: str) -> UserError:
    """Return the error for a package that is not installed."""
    return UserError(
        f"{package} is not installed; exported policies need the extra: pip install 'legged_torque[export]'"
    )
