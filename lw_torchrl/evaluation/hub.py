"""Policies in folders and on the Hugging Face Hub: the file and its card."""

from __future__ import annotations

import os
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath, replacing, shipped_policy, write_text
from lw_torchrl.evaluation.card import policy_card
from lw_torchrl.evaluation.result import EvaluationResult
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.policy import Policy
from lw_torchrl.training.files import load_actor, policy_file

POLICY_FILE, CARD = "policy.zip", "README.md"
_REPOSITORY = re.compile(r"[\w.-]+/[\w.-]+")


@checked
def save_pretrained(
    policy: AnyPath, folder: AnyPath, result: EvaluationResult | None = None, *, repo: str = ""
) -> None:
    """Put a policy and its card in a folder, for :func:`from_pretrained`: ``policy.zip`` and ``README.md``.

    Args:
        policy, result, repo: as of :func:`policy_card`, with its errors.
        folder: where they go; files of these names are replaced.

    Raises:
        IsADirectoryError: it holds a folder of one of these names; nothing is written.

    Example:
        >>> import os, tempfile
        >>> folder = tempfile.mkdtemp()
        >>> save_pretrained("few-shot-mt50", folder)
        >>> sorted(os.listdir(folder)), len(from_pretrained(folder).tasks)
        (['README.md', 'policy.zip'], 50)
    """
    card = policy_card(policy, result, repo=repo)
    for name in (POLICY_FILE, CARD):
        if (place := Path(folder) / name).is_dir():
            raise IsADirectoryError(f"folder must have room for the file {name}, {str(place)!r} is a folder")
    with replacing(Path(folder) / POLICY_FILE) as temporary:
        temporary.write_bytes(policy_file(policy).read_bytes())
    write_text(Path(folder) / CARD, card)


@checked
def push_to_hub(
    policy: AnyPath,
    repo: str,
    result: EvaluationResult | None = None,
    *,
    private: bool = False,
    token: str | None = None,
) -> str:
    """Upload a policy and its card to the Hugging Face Hub.

    Args:
        policy, result: as of :func:`policy_card`, with its errors.
        repo: "me/my-policy"; it is made if there is none.
        private: whether a new one is seen by you alone.
        token: of your account; None for the one that ``hf auth login`` keeps.

    Returns:
        The address of what was uploaded.

    Raises:
        ImportError: the extra ``[hub]`` is not installed.
        Exception: huggingface_hub's own, where the Hub refuses.

    Source: ``huggingface_hub.HfApi.upload_folder``.
    """
    api = _hub().HfApi(token=token)
    with TemporaryDirectory() as folder:
        save_pretrained(policy, folder, result, repo=repo)
        api.create_repo(repo, private=private, exist_ok=True)
        return str(api.upload_folder(repo_id=repo, folder_path=folder, commit_message="A policy of lw_torchrl"))


@checked
def from_pretrained(source: AnyPath, *, revision: str | None = None, text_encoder: TextEncoder | None = None) -> Policy:
    """The policy of a folder, or of a repository on the Hugging Face Hub, in eval mode.

    Args:
        source: a folder that :func:`save_pretrained` wrote, or "me/my-policy".
        revision: of the repository: a branch, a tag or a commit.
        text_encoder: as of :func:`~lw_torchrl.load_actor`.

    Raises:
        FileNotFoundError: a folder without a policy; or there is no such folder, and the Hub gives none.
        ImportError: it is no folder, and the extra ``[hub]`` is not installed.
        ValueError: it is a file or a shipped policy's name; or as of :func:`~lw_torchrl.load_actor`. Nothing in the
            file is run.

    Source: ``transformers.PreTrainedModel.from_pretrained``.
    """
    named = os.fspath(source)
    if named and Path(named).is_dir():
        return load_actor(Path(source) / POLICY_FILE, text_encoder=text_encoder)
    if Path(source).is_file() or named.endswith(".zip") or shipped_policy(named) is not None:
        raise ValueError(f"source must be a folder or a repository, got {named!r}; lw.load_actor loads it")
    if not _REPOSITORY.fullmatch(named):
        raise FileNotFoundError(f"source: there is no folder {named!r}; a repository is named like 'me/my-policy'")
    hub = _hub()
    try:
        file = hub.hf_hub_download(named, POLICY_FILE, revision=revision)
    except (OSError, ValueError) as error:
        told = f"there is no folder {named!r}, and the Hub gave no policy"
        raise FileNotFoundError(f"source: {told}: {error}") from error
    return load_actor(file, text_encoder=text_encoder)


def _hub() -> Any:
    try:
        import huggingface_hub
    except ImportError as error:
        raise ImportError("the Hugging Face Hub needs the extra [hub]: pip install 'lw_torchrl[hub]'") from error
    return huggingface_hub
