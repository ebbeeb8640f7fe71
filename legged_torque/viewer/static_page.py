"""A page that runs an exported policy in the browser, with MuJoCo in WebAssembly and no server but one of files."""

import base64
import hashlib
import http.client
import io
import os
import shutil
import tarfile
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np

from legged_torque import resource_path
from legged_torque.deploy.description import not_understood
from legged_torque.deploy.policy import Policy
from legged_torque.deploy.robot import MujocoRobot
from legged_torque.motors.twin import constants
from legged_torque.utils.errors import UserError, refuse
from legged_torque.utils.files import write_json, write_whole

STATIC = Path(__file__).with_name("static")
PACKAGES = {
    "@mujoco/mujoco/-/mujoco-3.14.0.tgz": (
        "WPUYidu4Fx8+uM4hQv80SOA0ifpWGrsNJguKs8JBV8SCTxjKQ2/rqsh880nUH0/Vwa8vuefghvCQkkoed3bkUg==",
        ("mujoco.js", "mujoco.wasm"),
    ),
    "onnxruntime-web/-/onnxruntime-web-1.30.0.tgz": (
        "q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ==",
        ("dist/ort.wasm.bundle.min.mjs", "dist/ort-wasm-simd-threaded.wasm"),
    ),
    "three/-/three-0.187.0.tgz": (
        "Qiu7R+Cmh8CstZsY1uJOSWnVlfo7ZtNLV7mF8Jltk3LB3AtDu9cRZlcnRKkAk8Y4z6KKw35z7Y7Urd7jWY8etA==",
        (
            "build/three.module.js",
            "build/three.core.js",
            "examples/jsm/controls/OrbitControls.js",
            "examples/jsm/utils/BufferGeometryUtils.js",
        ),
    ),
}
"""Packages of the npm registry, their sha512, and the files that the page needs; of licences Apache-2.0 and MIT."""
REGISTRY = "https://registry.npmjs.org/"
OBSERVATIONS = ("projected_gravity", "angular_velocity", "command", "joint_position", "joint_velocity", "last_action")
ACTIONS, MOTORS = ("position_residual", "torque"), ("ideal", "drive", "curve", "friction")
"""What the page can compute: terms of observations and actions, and models of motors."""


def check(policy: Policy) -> None:
    """Refuse what the page cannot compute, with a UserError that lists it."""
    problems, motors = not_understood(policy.description, OBSERVATIONS, ACTIONS), policy.description.get("motors", {})
    problems += [f"the motor {name}" for name, each in motors.items() if each["model"] not in MOTORS]
    refuse(problems, "the page cannot compute")


def write_page(folder: Path, policy: Policy, title: str) -> list[str]:
    """Add the page to the folder of an export, and return what it does otherwise than the training.

    It has the robot of the training on a plane, with its motors, and no latency. A UserError if the libraries cannot be
    had, which are downloaded once.
    """
    check(policy)
    description = policy.description
    on_plane = {key: value for key, value in description.items() if key != "terrain"}
    robot = MujocoRobot(resource_path(description["robot"]["file"]), on_plane)
    notes = robot.notes + differences(description)
    content = {
        "title": title,
        "notes": notes,
        "description": description,
        "nominal_pose": policy.nominal_pose.tolist(),
        "motors": motors(description),
        "robot": {"files": write_robot(folder / "robot", robot), "trunk": robot.trunk, **robot.addresses()},
    }
    write_json(folder / "page.json", content)
    for part in STATIC.iterdir():
        shutil.copy(part, folder)
    for package, (checksum, names) in PACKAGES.items():
        with tarfile.open(fileobj=io.BytesIO(library(package, checksum))) as archive:
            for name in names:
                stream = archive.extractfile(f"package/{name}")
                assert stream  # the archive is the one that was checked
                place = name.removeprefix("examples/jsm/")  # whose folder the page's import map names
                file = f"addons/{place}" if place != name else Path(name).name
                write_whole(folder / "vendor" / file, stream.read())
    return notes


def differences(description: dict[str, Any]) -> list[str]:
    """Return what the page leaves out of the training, a line each."""
    latency = description.get("latency", {})
    notes = ["ground: a plane, the policy was trained on rough ground"] if "terrain" in description else []
    late = [name for name, each in latency.items() if each["range"][1] or each["jitter"] or each.get("loss")]
    notes += [f"latency of {name}: none" for name in late]
    has_sag = any(each.get("sag") or each.get("voltage", 1.0) != 1.0 for each in description.get("motors", {}).values())
    return notes + (["bus voltage: the nominal one"] if has_sag else [])


def motors(description: dict[str, Any]) -> list[dict[str, Any]]:
    """Return models of motors in their order, with their constants by joint; limits alone if there are none."""
    names, dt = description["joint_order"], 1.0 / description["timing"]["physics_frequency"]
    links = description.get("motors") or {"ideal": {"model": "ideal"}}
    values = [{"model": each["model"]} | constants(each, names, f"motors.{link}", dt) for link, each in links.items()]
    return [{name: np.asarray(value).tolist() for name, value in motor.items()} for motor in values]


def write_robot(folder: Path, robot: MujocoRobot) -> list[str]:
    """Write the robot's MJCF with all files that it reads into one folder, and return their names, the MJCF's first."""
    spec, names, assets = robot.spec, ["robot.xml"], dict[str, bytes]()
    for kind, root in ((spec.meshes, spec.meshdir), (spec.textures, spec.texturedir)):
        for asset in kind:
            if asset.file:
                names.append(f"{len(names)}{Path(asset.file).suffix}")
                assets[names[-1]] = (robot.file.parent / root / asset.file).read_bytes()
                write_whole(folder / names[-1], assets[names[-1]])
                asset.file = names[-1]
    spec.meshdir = spec.texturedir = ""
    spec.assets = assets  # they are read once more
    write_whole(folder / names[0], spec.to_xml())
    return names


def library(package: str, checksum: str) -> bytes:
    """Return the archive of a package from the user's cache, else from the registry; a UserError if neither has it."""
    file = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "legged_torque", Path(package).name)
    content = file.read_bytes() if file.is_file() else b""
    if not _is_genuine(content, checksum):
        try:
            with urllib.request.urlopen(REGISTRY + package, timeout=60) as answer:
                content = answer.read()
        except (OSError, http.client.HTTPException) as error:  # also if it ends too soon
            raise UserError(f"cannot download {REGISTRY}{package}, which the page needs: {error}") from None
        if not _is_genuine(content, checksum):
            raise UserError(f"{REGISTRY}{package} is not the file that was expected (sha512 differs)")
        write_whole(file, content)
    return content


def _is_genuine(content: bytes, checksum: str) -> bool:
    """Return whether a file has a sha512 in base64, as npm writes it."""
    return base64.b64encode(hashlib.sha512(content).digest()).decode() == checksum
