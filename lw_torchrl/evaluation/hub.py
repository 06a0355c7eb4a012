"""Share policies with their cards, in folders and on the Hugging Face Hub."""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath, replacing, write_text
from lw_torchrl.evaluation.card import hub, policy_card
from lw_torchrl.evaluation.result import EvaluationResult
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.training.checkpoint import load_actor, policy_file

POLICY_FILE, CARD = "policy.safetensors", "README.md"


@checked
def save_pretrained(
    policy: AnyPath, folder: AnyPath, result: EvaluationResult | None = None, *, repo: str = ""
) -> None:
    """Write a policy and its card to a folder, as ``policy.safetensors`` and ``README.md``.

    Args:
        policy, result, repo: as for :func:`policy_card`, with its errors.
        folder: the folder; files of these names are replaced.

    Example:
        >>> import os, tempfile
        >>> folder = tempfile.mkdtemp()
        >>> save_pretrained("few-shot-mt50", folder)
        >>> sorted(os.listdir(folder)), len(from_pretrained(folder).tasks)
        (['README.md', 'policy.safetensors'], 50)
    """
    card = policy_card(policy, result, repo=repo)
    with replacing(Path(folder) / POLICY_FILE) as temporary:
        shutil.copyfile(policy_file(policy), temporary)
    write_text(Path(folder) / CARD, str(card))


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
        policy, result: as for :func:`policy_card`, with its errors.
        repo: the repository, such as "me/my-policy"; it is created if necessary.
        private: create it as a private repository.
        token: an access token; None for the one that ``hf auth login`` stored.

    Returns:
        The URL of the commit.

    Source: ``huggingface_hub.HfApi.upload_folder``.
    """
    api = hub().HfApi(token=token)
    with TemporaryDirectory() as folder:
        save_pretrained(policy, folder, result, repo=repo)
        api.create_repo(repo, private=private, exist_ok=True)
        return str(api.upload_folder(repo_id=repo, folder_path=folder, commit_message="Add a policy of lw_torchrl"))


@checked
def from_pretrained(source: AnyPath, *, revision: str | None = None, text_encoder: TextEncoder | None = None) -> Any:
    """Load a policy from a folder or from the Hugging Face Hub, in eval mode. Nothing in the file is executed.

    Args:
        source: a folder that :func:`save_pretrained` wrote, or a repository such as "me/my-policy".
        revision: the repository's branch, tag or commit.
        text_encoder: as for :func:`~lw_torchrl.load_actor`.

    Raises:
        FileNotFoundError: the folder holds no policy; or there is no such folder, nor such a repository.
        ImportError: the extra ``[hub]`` is not installed.
        ValueError: as for :func:`~lw_torchrl.load_actor`.

    Source: ``transformers.PreTrainedModel.from_pretrained``.
    """
    if Path(source).is_dir():
        return load_actor(Path(source) / POLICY_FILE, text_encoder=text_encoder)
    if Path(source).is_file():
        raise ValueError(f"source must be a folder or a repository, got the file {str(source)!r}; use lw.load_actor")
    try:
        path = hub().hf_hub_download(str(source), POLICY_FILE, revision=revision)
    except (OSError, ValueError) as error:
        raise FileNotFoundError(
            f"source: there is no folder {str(source)!r}, and no such policy on the Hub: {error}"
        ) from error
    return load_actor(path, text_encoder=text_encoder)
