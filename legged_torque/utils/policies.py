"""Trained policies: those of the package in ``resources/policies``, each with a card, and others from servers."""

import contextlib
import hashlib
import importlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from legged_torque import RESOURCES_DIR
from legged_torque.utils.errors import UserError, check_names, require
from legged_torque.utils.files import is_whole_archive
from legged_torque.utils.plain_yaml import parse_yaml
from legged_torque.utils.runs import CONFIG_FILE, checkpoint_file

POLICIES_DIR = RESOURCES_DIR / "policies"
CARD = "card.yaml"
"""What a policy is, how it was made and measured, and the checksums of its files."""
HUB, WANDB = "hf:", "wandb:"
"""Begin the names of models of the Hugging Face Hub, ``hf:owner/name``, and runs, ``wandb:entity/project/run``."""


def policy_names() -> list[str]:
    """Return the names of all policies, ``robot/approach``."""
    return sorted(file.parent.relative_to(POLICIES_DIR).as_posix() for file in POLICIES_DIR.glob(f"*/*/{CARD}"))


def policy_dir(name: str, checkpoint: int | None = None) -> Path:
    """Return the folder of a bundled policy, or a copy of one from the Hub, which scripts take as run and as export.

    Of a run of wandb, it is a copy with one checkpoint, by default the last. A UserError if there is none of this name,
    or a file is not the one that its card was written for.
    """
    if name.startswith(WANDB):
        return download_run(name.removeprefix(WANDB), checkpoint)
    if name.startswith(HUB):
        kinds = [CARD, "config.yaml", "policy.onnx", "policy.yaml", "model_*.pt"]  # as publish.py --push uploads
        with _client("huggingface_hub", "hub", f"cannot download the policy '{name}'") as client:
            folder = Path(client.HfApi().snapshot_download(name.removeprefix(HUB), allow_patterns=kinds))
    else:
        check_names("policy", [name], policy_names())
        folder = POLICIES_DIR / name
    for file, checksum in read_card(folder)["files"].items():
        if not (folder / file).is_file() or sha256(folder / file) != checksum:
            raise UserError(f"'{folder / file}' is not the file that {CARD} describes")
    return folder


def download_run(path: str, checkpoint: int | None) -> Path:
    """Return a copy of a run of wandb, ``entity/project/run``, with its settings and a checkpoint, by default the last.

    A UserError if there is none. What WandbWriter has uploaded is in a folder of the run's name.
    """
    with _client("wandb", "wandb", f"cannot download the run '{WANDB}{path}'") as client:
        if len(path.split("/")) != 3 or {"", ".", ".."} & {*path.split("/")}:
            raise ValueError(f"it must be {WANDB}entity/project/run")
        root = Path(client.env.get_cache_dir(), "legged_torque", path)
        files = {root / file.name: file for file in client.Api().run(path).files()}
        run = next((file.parent for file in files if file.name == CONFIG_FILE and file.parent != root), root)
        found = {int(name[1]): file for file in files if (name := re.fullmatch(r"model_(\d+)\.pt", file.name))}
        numbers = [number for number, file in found.items() if file.parent == run != root]
        if not numbers:
            raise ValueError("it holds no settings and checkpoint of train.py --logger wandb")
        chosen = max(numbers) if checkpoint is None else checkpoint
        check_names("checkpoint", [str(chosen)], [*map(str, numbers)])
        for file in (run / CONFIG_FILE, checkpoint_file(run, chosen)):
            if not is_whole_archive(file):  # else it is here already
                files[file].download(str(root), replace=True).close()  # a UserError for names that lead out of it
    return run


def check_upload(repository: str) -> None:
    """Raise a UserError if the Hub's client is not installed, or takes no such name of a model."""
    with _client("huggingface_hub", "hub", f"cannot upload to '{repository}'"):
        importlib.import_module("huggingface_hub.utils").validate_repo_id(repository)


def upload(folder: Path, repository: str) -> str:
    """Upload a folder to a model of the Hub, and return the address of the commit; a UserError if that fails."""
    again = f"'{shlex.join(['hf', 'upload', repository, str(folder)])}' tries again"
    with _client("huggingface_hub", "hub", f"cannot upload '{folder}' to '{repository}' ({again})") as client:
        hub = client.HfApi()
        hub.create_repo(repository, exist_ok=True)
        return str(hub.upload_folder(repo_id=repository, folder_path=folder).commit_url)


@contextlib.contextmanager
def _client(package: str, extra: str, failure: str) -> Iterator[Any]:
    """Give a package that is a client of a server; a UserError if it is not installed, or says why something failed."""
    require(package, extra=extra)
    client = importlib.import_module(package)
    try:
        yield client
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
