"""Reading, checking and writing ``policy.yaml``, the description of how to run a policy; its network holds it, too."""

import hashlib
import json
import math
from collections.abc import Container
from pathlib import Path
from typing import Any

from legged_torque.motors.model_config import MODELS
from legged_torque.utils.errors import UserError, check_names, refuse, require
from legged_torque.utils.limits import LARGEST
from legged_torque.utils.plain_yaml import dump_yaml, parse_yaml
from legged_torque.utils.policies import HUB, WANDB, policy_dir, policy_names, sha256

DESCRIPTION_FILE = "policy.yaml"
NETWORK_FILE = "policy.onnx"
FORMAT_VERSION = 1
SCHEMA: dict[str, Any] = json.loads(Path(__file__).with_name("policy.schema.json").read_text(encoding="utf-8"))
"""The JSON schema of descriptions."""


def read(path: str | Path) -> tuple[dict[str, Any], Path]:
    """Read and check the description of a policy; return it and the file of the network.

    ``path`` is ``policy.yaml``, a network in its folder, that folder, or the name of a bundled policy; a
    network alone describes itself. A UserError names what is missing or wrong.
    """
    path = Path(path)
    if not path.exists():
        if not path.as_posix().startswith((HUB, WANDB)) and path.as_posix() not in policy_names():
            raise UserError(f"there is no file or folder '{path}', nor a bundled policy: {', '.join(policy_names())}")
        path = policy_dir(path.as_posix())
        if not (path / DESCRIPTION_FILE).is_file():  # a run of wandb: what export.py has made of it
            path = max(path.glob("exported_*"), key=lambda export: export.stat().st_mtime, default=path)
    folder, is_network = path if path.is_dir() else path.parent, path.suffix == ".onnx"
    file = folder / DESCRIPTION_FILE if path.is_dir() or is_network else path
    network = path if is_network else folder / NETWORK_FILE
    if network.is_file() and not file.exists():
        session, checksum = open_network(network)
        description = from_metadata(session.get_modelmeta().custom_metadata_map, f"'{network}'")
        if not isinstance(description.get("network"), dict):  # it is not of export.py, or of an older one
            raise UserError(f"there is no {DESCRIPTION_FILE} in '{folder}', and '{network}' does not describe itself")
        description["network"]["sha256"] = checksum
        check(description, f"'{network}'")
        return description, network
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UserError(f"there is no {DESCRIPTION_FILE} in '{folder}': export.py makes it") from None
    except (OSError, ValueError) as error:
        raise UserError(f"'{file}' is not valid YAML: {error}") from None
    description = parse_yaml(text, f"'{file}'")
    check(description, f"'{file}'")
    name = description["network"]["file"]
    if Path(name).name != name:
        raise UserError(f"'{file}': network.file must be the name of a file in the same folder, not '{name}'")
    network = path if is_network else folder / name
    if not network.is_file():
        raise UserError(f"there is no network '{network}'")
    return description, network


def place_of_results(run: Path, policy: str | None, log_root: str | Path) -> Path:
    """Return the folder for what is made of a run: its own, but for policies of the package and the Hub a new one."""
    return Path(log_root, policy.removeprefix(HUB)) if policy and not policy.startswith(WANDB) else run


def to_yaml(description: dict[str, Any]) -> str:
    """Return the text of a description, section by section with the schema's comment above each."""
    parts = []
    for key, value in description.items():
        comment = SCHEMA["properties"][key].get("description", "").splitlines()
        flow = None if isinstance(value, (dict, list)) else False  # plain values on one line
        text = dump_yaml({key: value}, width=100, default_flow_style=flow)
        parts.append("".join(f"# {line}\n" for line in comment) + text)
    return "\n".join(parts)


def metadata(description: dict[str, Any]) -> dict[str, str]:
    """Return what a network holds of its description: all but its own checksum, as JSON by section."""
    network = {key: value for key, value in description["network"].items() if key != "sha256"}
    return {key: json.dumps(value) for key, value in {**description, "network": network}.items()}


def from_metadata(stored: dict[str, str], where: str) -> dict[str, Any]:
    """Return the sections of a description in a network's metadata, unchecked; ``where`` they are is for errors."""
    return {key: parse_yaml(text, f"{key} in {where}") for key, text in stored.items() if key in SCHEMA["properties"]}


def write_description(folder: Path, description: dict[str, Any]) -> None:
    """Store a description in its network, add that file's checksum, check it, and write it as ``policy.yaml``."""
    import onnx

    network = onnx.load(folder / NETWORK_FILE)
    onnx.helper.set_model_props(network, metadata(description))
    onnx.save(network, folder / NETWORK_FILE)
    description["network"]["sha256"] = sha256(folder / NETWORK_FILE)
    check(description)
    (folder / DESCRIPTION_FILE).write_text(to_yaml(description), encoding="utf-8")


def open_network(file: Path) -> tuple[Any, str]:
    """Return an onnxruntime session of a file, on one thread, and its checksum; a UserError if it is no network."""
    require("onnxruntime")
    import onnxruntime

    content, options = file.read_bytes(), onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has an exception class per kind of damage
        raise UserError(f"'{file}' is not a readable network: {' '.join(str(error).split())[:160]}") from None
    return session, hashlib.sha256(content).hexdigest()


def columns(observations: dict[str, Any]) -> list[str]:
    """Return the names of the terms of all numbers that the network reads, from the section ``observations``."""
    with_history, others = list[str](), list[str]()
    for term in observations["terms"]:
        (others if "group" in term else with_history).extend([term["name"]] * term["size"])
    return with_history * observations["history_length"] + others


def check(description: Any, where: str = DESCRIPTION_FILE) -> None:
    """Check structure and values; a UserError names the first wrong entry, and ``where`` it is."""
    _check_schema(description, where)
    joints = description["joint_order"]
    keys = ("nominal_pose", "torque_limits", "joints", "copper_loss")
    by_joint = {key: description[key] for key in keys if key in description}
    by_joint |= {f"gains.{key}": values for key, values in description["gains"].items()}
    for path, values in by_joint.items():
        check_names(f"joint in {path} of {where}", values, joints)
        for name in joints:
            if name not in values:
                raise UserError(f"{where}: {path} lacks the joint '{name}'")
    for section in ("torque_limits", "commands", "initial_state"):
        for key, limits in description[section].items():
            if isinstance(limits, list) and len(limits) == 2 and limits[0] > limits[1]:
                raise UserError(f"{where}: {section}.{key} must be [lowest, highest], not {limits}")
    network, terms = description["network"], description["actions"]["terms"]
    for term in description["observations"]["terms"]:
        if isinstance(term["scale"], list) and len(term["scale"]) != term["size"]:
            raise UserError(f"{where}: the scale of the observation '{term['name']}' must have {term['size']} numbers")
    sizes = {"observations": len(columns(description["observations"])), "actions": len(terms) * len(joints)}
    for kind, size in sizes.items():
        if size != network[f"num_{kind}"]:
            raise UserError(f"{where}: {kind} have {size} numbers, those of the network {network[f'num_{kind}']}")
    timing = description["timing"]
    if not math.isclose(timing["physics_frequency"], timing["control_frequency"] * timing["decimation"], rel_tol=1e-6):
        raise UserError(f"{where}: timing.physics_frequency is not control_frequency times decimation")


def _check_schema(description: Any, where: str) -> None:
    """Check structure, types and single values, also that numbers are finite."""
    require("jsonschema")
    import jsonschema

    draft = jsonschema.Draft202012Validator  # which would take 4.0 as an integer, and NaN as a number
    types = draft.TYPE_CHECKER.redefine("integer", lambda _, value: type(value) is int)
    types = types.redefine("number", lambda _, value: type(value) in (int, float) and abs(value) <= LARGEST)
    validator = jsonschema.validators.extend(draft, type_checker=types)(SCHEMA)
    error = jsonschema.exceptions.best_match(validator.iter_errors(description))
    if error is not None:
        path = ".".join(str(key) for key in error.absolute_path) or "the file"
        if error.validator == "type" and "number" in error.validator_value and type(error.instance) in (int, float):
            raise UserError(f"{where}: {path} is not a finite number, at most {LARGEST:g} either way")
        message = " ".join(error.message.split())
        raise UserError(f"{where}: {path}: {message if len(message) < 160 else '... ' + message[-150:]}")


def holds_gains(description: dict[str, Any]) -> bool:
    """Return whether torques of gains are held for a control step, while drives of robots make them anew all the time.

    That is ``control.refresh_torques: false`` with the term position_residual.
    """
    timing, terms = description["timing"], [term["name"] for term in description["actions"]["terms"]]
    return "position_residual" in terms and timing["decimation"] > 1 and not timing["refresh_torques"]


def laws_of_motors(description: dict[str, Any]) -> list[str]:
    """Return what motors add to the control law beyond gains of a ``drive``: all that a robot's drives take."""
    models = {model for model, cfg in MODELS.items() if cfg._of_law and model != "drive"}
    motors = description.get("motors", {}).items()
    return [f"the law of the motors' {name}" for name, motor in motors if motor.get("model") in models]


def refuse_laws(description: dict[str, Any]) -> None:
    """Raise a UserError that lists :func:`laws_of_motors`, which no robot has: it would get other torques."""
    refuse(laws_of_motors(description), "a robot's drives take the gains of a motor 'drive' alone, not")


def not_understood(description: dict[str, Any], observations: Container[str], actions: Container[str]) -> list[str]:
    """Return what a policy needs beyond terms of ``observations`` and ``actions`` and a network without memory."""
    observed, acted = description["observations"], description["actions"]["terms"]
    problems = [f"the observation {term['name']}" for term in observed["terms"] if term["name"] not in observations]
    problems += [f"the actions {term['name']}" for term in acted if term["name"] not in actions]
    problems += [f"an interval of {term['name']}" for term in acted if term.get("interval", 1) > 1]
    problems += ["a history of observations"] if observed["history_length"] > 1 else []
    return problems + (["a recurrent network"] if "memory" in description["network"] else [])
