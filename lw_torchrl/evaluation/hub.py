"""Save and load policies and their model cards, in folders and on the Hugging Face Hub."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any

from lw_torchrl._util.checks import typed
from lw_torchrl._util.files import AnyPath, replacing, shipped_policy, write_text
from lw_torchrl._util.text import counted, markdown, printable
from lw_torchrl.evaluation.result import EvaluationResult, wilson_interval
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.training.checkpoint import demonstrated_tasks, load_actor, policy_file, read_description

_SHOWN = {  # the entries of a policy's metadata that a card shows
    *("loss", "reward"),
    *("episodes_per_task", "seed", "noise_scale", "noise_hold", "redraw_failures", "max_steps", "behaviour"),
    *("steps", "batch_size", "learning_rate", "optimizer", "schedule"),
    *("lw_torchrl", "metaworld", "mujoco", "torch"),
}
POLICY_FILE, CARD = "policy.safetensors", "README.md"
_TAGS = ["robotics", "imitation-learning", "reinforcement-learning", "torchrl", "lw_torchrl"]


def hub() -> Any:
    """Import huggingface_hub, or raise an :class:`ImportError` that names the missing extra."""
    try:
        import huggingface_hub
    except ImportError as error:
        raise ImportError("model cards and the Hub require the extra [hub]: pip install 'lw_torchrl[hub]'") from error
    return huggingface_hub


@typed
def policy_card(policy: AnyPath, result: EvaluationResult | None = None, *, repo: str = "") -> Any:
    """Make a policy's model card: training data, success rates, limits, and how to load and cite the policy.

    Args:
        policy: the policy's file, or the name of a shipped policy.
        result: an evaluation of the policy; None for the stored result of a shipped policy. For any other policy, None
            gives a card without success rates.
        repo: the Hub repository in the card's loading example, such as "me/my-policy"; "" to load from the file.

    Returns:
        A ``huggingface_hub.ModelCard``; ``str(card)`` is Markdown, and ``card.save("README.md")`` writes a file.

    Raises:
        ValueError: the result contains tasks that are unknown to the policy.
        ImportError: the extra ``[hub]`` is not installed.

    Example:
        >>> policy_card("few-shot-mt50").data.library_name
        'lw_torchrl'

    Source: ``huggingface_hub.ModelCard``; Mitchell et al., 'Model Cards for Model Reporting'.
    """
    about = {"library_name": "lw_torchrl", "pipeline_tag": "robotics", "tags": _TAGS, "model_name": Path(policy).stem}
    metadata, result = hub().ModelCardData(**about), _own_result(policy, result)
    if result is not None:
        row = {"task_type": "robotics", "dataset_type": "meta-world", "metric_type": "success_rate"}
        row |= {"dataset_name": counted(len(result.success_once), "task"), "metric_name": "mean success"}
        metadata.eval_results = [hub().EvalResult(**row, metric_value=round(result.mean_success, 3))]
    return hub().ModelCard(f"---\n{metadata.to_yaml()}\n---\n\n{describe_policy(policy, result, repo=repo)}")


def _own_result(policy: AnyPath, result: EvaluationResult | None) -> EvaluationResult | None:
    """Return ``result``; if it is None, return the stored result of a shipped policy, or None for any other policy."""
    shipped = shipped_policy(policy)
    return EvaluationResult.load(shipped.with_suffix(".json")) if result is None and shipped is not None else result


@typed
def describe_policy(policy: AnyPath, result: EvaluationResult | None = None, *, repo: str = "") -> str:
    """Return the text of :func:`policy_card` as Markdown. The arguments are the same, but no extra is required.

    Example:
        >>> describe_policy("few-shot-mt50").splitlines()[0]
        '# few-shot-mt50'
    """
    result = _own_result(policy, result)
    description, demonstrated = read_description(policy), demonstrated_tasks(policy)
    tasks = _tasks(description["actor"])
    if result is not None and tasks and (unknown := set(result.config["tasks"]) - tasks):
        raise ValueError(f"result contains tasks that the policy does not know: {', '.join(sorted(unknown))}")
    limits = [f"- {counted(len(tasks - demonstrated), 'task')} had no demonstrations."] * bool(tasks - demonstrated)
    rates = {} if result is None else result.success_once
    if weak := [f"{markdown(task)} ({rate:.2f})" for task, rate in rates.items() if rate is not None and rate < 0.8]:
        limits.append(f"- Success below 0.8: {', '.join(weak)}.")
    texts = files("lw_torchrl.evaluation") / "data"
    return Template((texts / "card.md").read_text("utf-8")).substitute(
        name=markdown(Path(policy).stem),
        kind=_kind(description["actor"]),
        tasks=counted(len(tasks), "task"),
        demonstrated=len(demonstrated),
        training=_training(description, demonstrated),
        success="Not measured." if result is None else _success(result),
        limits="\n".join(limits),
        load=f"lw.from_pretrained({repo!r})" if repo else f"lw.load_actor({Path(policy).name!r})",
        citation=(texts / "citation.bib").read_text("utf-8").strip(),
    )


def _tasks(node: Any) -> set[str]:
    """Return the tasks named in a module's description: in its plans or its submodules' options."""
    if isinstance(node, list):
        return set().union(*map(_tasks, node))
    if not isinstance(node, dict):
        return set()
    names = {task for plans in node["plans"] for task in plans} if isinstance(node.get("plans"), list) else set()
    listed = node["tasks"] if isinstance(node.get("tasks"), list) else []
    names |= {task if isinstance(task, str) else task["task"]["name"] for task in listed}
    return names.union(*(_tasks(value) for key, value in node.items() if key not in ("plans", "tasks")))


def _kind(actor: Mapping[str, Any]) -> str:
    members = actor.get("options", {}).get("members", ())
    networks = f" of {counted(len(members), 'network')}" if members else ""
    module, _, kind = actor["class"].rpartition(":")
    hint = f" (import {markdown(module)} first)" if module else ""
    conditioned = "conditioned on plans in English" if actor.get("plans") else "of fixed tasks"
    return f"{conditioned}: {_code(kind)}{networks}{hint}"


def _training(description: Mapping[str, Any], demonstrated: set[str]) -> str:
    run, data = description.get("run") or {}, description.get("data") or {}
    training = description.get("training") or run.get("training") or {}
    rows: list[tuple[str, Mapping[str, Any]]] = [("dataset", part) for part in data.get("parts", [data])]
    loss = description.get("loss") or {}
    learned = {"loss": loss["class"], "reward": description["replay"].get("reward")} if loss else {}
    rows.append(("training", learned | training | ({"seed": run["seed"]} if "seed" in run else {})))
    rows.append(("versions", description["versions"]))
    lines = [f"- tasks: {', '.join(map(markdown, sorted(demonstrated))) or 'not recorded'}"]
    for name, row in rows:
        if shown := [f"{key} {_value(value)}" for key, value in row.items() if value is not None and key in _SHOWN]:
            lines.append(f"- {name}: {', '.join(shown)}")
    return "\n".join(lines)


def _value(value: object) -> str:
    """Return a value as Markdown text, escaped unless it is a number or a list of numbers."""
    text = str(value)
    return text if re.fullmatch(r"[-+\d.,e \[\]]*", text) else markdown(text)


def _code(text: object) -> str:
    """Return a Markdown code span, so that addresses in the text do not become links."""
    return f"`{printable(str(text)).replace('`', '')}`"


def _success(result: EvaluationResult) -> str:
    config, runs = result.config, len(result.episodes)
    solved = sum(episode.success for episode in result.episodes)
    low, high = wilson_interval(solved, runs)
    rows = "".join(
        f"| {markdown(task)} | {rate:.2f} |\n" for task, rate in result.success_once.items() if rate is not None
    )
    return (
        f"{counted(config['episodes_per_task'], 'episode')} of each task, seed {config['seed']}, action noise "
        f"{config['noise_scale']}, success at any step, one training seed: {solved} of {runs} episodes succeeded, "
        f"95 % interval {low:.3f} to {high:.3f} (Wilson).\n\n"
        f"| task | success |\n|---|---|\n{rows}| **mean** | **{result.mean_success:.3f}** |"
    )


@typed
def save_pretrained(
    policy: AnyPath, folder: AnyPath, result: EvaluationResult | None = None, *, repo: str = ""
) -> None:
    """Write a policy and its model card to a folder as ``policy.safetensors`` and ``README.md``, replacing both files.

    See :func:`policy_card` for the other arguments and the errors.

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


@typed
def push_to_hub(
    policy: AnyPath,
    repo: str,
    result: EvaluationResult | None = None,
    *,
    private: bool = False,
    token: str | None = None,
) -> str:
    """Upload a policy and its model card to the Hugging Face Hub, and return the URL of the commit.

    Args:
        policy, result: see :func:`policy_card`.
        repo: the repository, such as "me/my-policy"; created if it does not exist.
        private: make a newly created repository private.
        token: an access token; None for the token stored by ``hf auth login``.
    """
    api = hub().HfApi(token=token)
    with TemporaryDirectory() as folder:
        save_pretrained(policy, folder, result, repo=repo)
        api.create_repo(repo, private=private, exist_ok=True)
        return str(api.upload_folder(repo_id=repo, folder_path=folder, commit_message="Add a lw_torchrl policy"))


@typed
def from_pretrained(source: AnyPath, *, revision: str | None = None, text_encoder: TextEncoder | None = None) -> Any:
    """Load a policy from a folder or from the Hugging Face Hub, in eval mode. No code in the file is executed.

    Args:
        source: a folder that :func:`save_pretrained` wrote, or a repository such as "me/my-policy".
        revision: the repository's branch, tag or commit.
        text_encoder: see :func:`~lw_torchrl.load_actor`.

    Raises:
        FileNotFoundError: the folder contains no policy, or neither a folder nor a repository of that name exists.
        ImportError: the extra ``[hub]`` is not installed.
        ValueError: ``source`` is a file, or the policy file is invalid (see :func:`~lw_torchrl.load_actor`).
    """
    if Path(source).is_dir():
        return load_actor(Path(source) / POLICY_FILE, text_encoder=text_encoder)
    if Path(source).is_file():
        raise ValueError(f"source must be a folder or a repository, got the file {str(source)!r}; use lw.load_actor")
    try:
        path = hub().hf_hub_download(str(source), POLICY_FILE, revision=revision)
    except (OSError, ValueError) as error:
        message = f"source: neither a folder nor a Hub repository {str(source)!r} with a policy exists: {error}"
        raise FileNotFoundError(message) from error
    return load_actor(path, text_encoder=text_encoder)
