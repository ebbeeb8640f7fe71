"""Trained policies that come with the package: run folders below ``resources/policies``, each with a card."""

import hashlib
from pathlib import Path
from typing import Any

from legged_torque import RESOURCES_DIR
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.plain_yaml import parse_yaml

POLICIES_DIR = RESOURCES_DIR / "policies"
CARD = "card.yaml"
"""What a policy is, how it was made and measured, and the checksums of its files."""


def policy_names() -> list[str]:
    """Return the names of all policies, ``robot/approach``."""
    return sorted(file.parent.relative_to(POLICIES_DIR).as_posix() for file in POLICIES_DIR.glob(f"*/*/{CARD}"))


def policy_dir(name: str) -> Path:
    """Return the folder of a policy, which scripts take as a run and as an export.

    A UserError if there is none of this name, or a file is not the one that its card was written for.
    """
    if name not in policy_names():
        raise unknown_name("policy", name, policy_names())
    folder = POLICIES_DIR / name
    for file, checksum in read_card(folder)["files"].items():
        if not (folder / file).is_file() or sha256(folder / file) != checksum:
            raise UserError(f"'{folder / file}' is not the file that {CARD} describes")
    return folder


def name_of(folder: Path) -> str:
    """Return the name of the policy that a folder has; "" if it is none of them."""
    return next((name for name in policy_names() if (POLICIES_DIR / name).samefile(folder)), "")


def read_card(folder: Path) -> dict[str, Any]:
    """Return the card of a policy's folder."""
    card: dict[str, Any] = parse_yaml((folder / CARD).read_text("utf-8"), f"'{folder / CARD}'")
    return card


def sha256(file: Path) -> str:
    """Return the checksum of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()
