"""Trained policies that come with the package: run folders below ``resources/policies``, each with a card."""

import contextlib
import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from legged_torque import RESOURCES_DIR
from legged_torque.utils.errors import UserError, unknown_name
from legged_torque.utils.plain_yaml import parse_yaml

POLICIES_DIR = RESOURCES_DIR / "policies"
CARD = "card.yaml"
"""What a policy is, how it was made and measured, and the checksums of its files."""
HUB = "hf:"
"""Begins the name of a policy that is a model of the Hugging Face Hub: ``hf:owner/name``."""


def policy_names() -> list[str]:
    """Return the names of all policies, ``robot/approach``."""
    return sorted(file.parent.relative_to(POLICIES_DIR).as_posix() for file in POLICIES_DIR.glob(f"*/*/{CARD}"))


def policy_dir(name: str) -> Path:
    """Return the folder of a bundled policy, or a copy of one from the Hub, which scripts take as run and as export.

    A UserError if there is none of this name, or a file is not the one that its card was written for.
    """
    if name.startswith(HUB):
        folder = download(name.removeprefix(HUB))
    elif name in policy_names():
        folder = POLICIES_DIR / name
    else:
        raise unknown_name("policy", name, policy_names())
    for file, checksum in read_card(folder)["files"].items():
        if not (folder / file).is_file() or sha256(folder / file) != checksum:
            raise UserError(f"'{folder / file}' is not the file that {CARD} describes")
    return folder


def download(repository: str) -> Path:
    """Return a copy of a model of the Hub, as ``publish.py --push`` has uploaded it; a UserError if there is none."""
    kinds = [CARD, "config.yaml", "policy.onnx", "policy.yaml", "model_*.pt"]
    with _hub(f"cannot download the policy '{HUB}{repository}'") as hub:
        return Path(hub.snapshot_download(repository, allow_patterns=kinds))


def upload(folder: Path, repository: str) -> str:
    """Upload a folder to a model of the Hub, and return the address of the commit; a UserError if that fails."""
    with _hub(f"cannot upload '{folder}' to '{repository}'") as hub:
        hub.create_repo(repository, exist_ok=True)
        return str(hub.upload_folder(repo_id=repository, folder_path=folder).commit_url)


@contextlib.contextmanager
def _hub(failure: str) -> Iterator[Any]:
    """Give the Hub; a UserError if huggingface_hub is not installed, or says why something has failed."""
    try:
        import huggingface_hub
    except ImportError:
        raise UserError("huggingface_hub is not installed: pip install 'legged_torque[hub]'") from None
    try:
        yield huggingface_hub.HfApi()
    except Exception as error:  # of httpx, OSErrors, ValueErrors, and others if an answer is not what it expects
        raise UserError(f"{failure}: {' '.join(str(error).split())[:200]}") from None


def name_of(folder: Path) -> str:
    """Return the name of the policy that a folder has; "" if it is none of them."""
    return next((name for name in policy_names() if (POLICIES_DIR / name).samefile(folder)), "")


def read_card(folder: Path) -> dict[str, Any]:
    """Return the card of a policy's folder; a UserError if it has none, or one that names no files of the folder."""
    if not (folder / CARD).is_file():
        raise UserError(f"'{folder}' has no {CARD}")
    card: dict[str, Any] = parse_yaml((folder / CARD).read_text("utf-8", errors="replace"), f"'{folder / CARD}'")
    files = card.get("files") if isinstance(card, dict) else None
    if not files or not isinstance(files, dict) or any(Path(str(name)).name != name for name in files):
        raise UserError(f"'{folder / CARD}' does not list the files of its folder under 'files'")
    return card


def sha256(file: Path) -> str:
    """Return the checksum of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()
