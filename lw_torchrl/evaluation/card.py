"""Model cards of policies, from their files and evaluations."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

from lw_torchrl._checks import checked, counted
from lw_torchrl._files import AnyPath, shipped_policy
from lw_torchrl.evaluation.result import EvaluationResult
from lw_torchrl.evaluation.statistics import wilson_interval
from lw_torchrl.training.checkpoint import demonstrated_tasks, read_description

if TYPE_CHECKING:
    from huggingface_hub import ModelCard

_SHOWN = {
    *("episodes_per_task", "seed", "noise_scale", "noise_hold", "redraw_failures", "max_steps", "behaviour"),
    *("steps", "batch_size", "learning_rate", "optimizer", "schedule"),
    *("lw_torchrl", "metaworld", "mujoco", "torch"),
}
_TAGS = ["robotics", "imitation-learning", "reinforcement-learning", "torchrl", "lw_torchrl"]


def hub() -> Any:
    """Import huggingface_hub, or raise :class:`ImportError` with the name of the extra."""
    try:
        import huggingface_hub
    except ImportError as error:
        raise ImportError("model cards and the Hub need the extra [hub]: pip install 'lw_torchrl[hub]'") from error
    return huggingface_hub


@checked
def policy_card(policy: AnyPath, result: EvaluationResult | None = None, *, repo: str = "") -> ModelCard:
    """Make a model card of a policy: training data, success rates, limits, how to load and cite it.

    Args:
        policy: its file, or the name of a shipped policy.
        result: an evaluation of the policy; None for no success rates, or a shipped policy's own evaluation.
        repo: the Hub repository to load it from, such as "me/my-policy"; "" for a file.

    Returns:
        ``huggingface_hub.ModelCard``; ``str()`` of it is Markdown, and ``card.save("README.md")`` writes it.

    Raises:
        FileNotFoundError, ValueError: as for :func:`~lw_torchrl.load_actor`.
        ValueError: the result is of tasks that the policy does not know.
        ImportError: the extra ``[hub]`` is not installed.

    Example:
        >>> policy_card("few-shot-mt50").data.library_name
        'lw_torchrl'

    Source: ``huggingface_hub.ModelCard``; Mitchell et al., 'Model Cards for Model Reporting'.
    """
    measured = _measured(policy, result)
    text = describe_policy(policy, measured, repo=repo)
    metadata = hub().ModelCardData(
        library_name="lw_torchrl", pipeline_tag="robotics", tags=_TAGS, model_name=Path(policy).stem
    )
    if measured is not None:
        metadata.eval_results = [
            hub().EvalResult(
                task_type="robotics",
                dataset_type="meta-world",
                dataset_name=counted(len(measured.success_once), "task"),
                metric_type="success_rate",
                metric_name="mean success",
                metric_value=round(measured.mean_success, 3),
            )
        ]
    card: ModelCard = hub().ModelCard(f"---\n{metadata.to_yaml()}\n---\n\n{text}")
    return card


def _measured(policy: AnyPath, result: EvaluationResult | None) -> EvaluationResult | None:
    """Return the given result, or a shipped policy's own."""
    shipped = shipped_policy(policy)
    return EvaluationResult.load(shipped.with_suffix(".json")) if result is None and shipped is not None else result


@checked
def describe_policy(policy: AnyPath, result: EvaluationResult | None = None, *, repo: str = "") -> str:
    """Describe a policy in Markdown: training data, success rates, limits, how to load and cite it.

    Args:
        policy, result, repo: as for :func:`policy_card`, with its errors; no extra is needed.

    Example:
        >>> describe_policy("few-shot-mt50").splitlines()[0]
        '# few-shot-mt50'
    """
    description, demonstrated = read_description(policy), demonstrated_tasks(policy)
    tasks = _tasks(description["actor"])
    result = _measured(policy, result)
    if result is not None and tasks and (unknown := set(result.config["tasks"]) - tasks):
        raise ValueError(f"result must be of the policy's tasks, it does not know {', '.join(sorted(unknown))}")
    limits = [f"- {counted(len(tasks - demonstrated), 'task')} had no demonstrations."] * bool(tasks - demonstrated)
    rates = {} if result is None else result.success_once
    if weak := [f"{task} ({rate:.2f})" for task, rate in rates.items() if rate is not None and rate < 0.8]:
        limits.append(f"- Success below 0.8: {', '.join(weak)}.")
    texts = files("lw_torchrl.evaluation") / "data"
    return Template((texts / "card.md").read_text("utf-8")).substitute(
        name=Path(policy).stem,
        kind=_kind(description["actor"]),
        tasks=counted(len(tasks), "task"),
        demonstrated=len(demonstrated),
        training=_training(description, demonstrated),
        success="Not measured." if result is None else _success(result),
        limits="\n".join(limits),
        load=f"lw.from_pretrained({repo!r})" if repo else f"lw.load_actor({Path(policy).name!r})",
        citation=(texts / "citation.bib").read_text("utf-8").strip(),
    )


def _tasks(actor: Mapping[str, Any]) -> set[str]:
    """Return the tasks that an actor's description names, those of its members included."""
    parts = [part for value in actor.values() for part in (value if isinstance(value, list) else [value])]
    members = [_tasks(part) for part in parts if isinstance(part, dict) and "kind" in part]
    return {*actor.get("plans", ()), *actor.get("tasks", ())}.union(*members)


def _kind(actor: Mapping[str, Any]) -> str:
    members = f" of {counted(len(actor['members']), 'network')}" if "members" in actor else ""
    module = f" (import {actor['module']} first)" if "module" in actor else ""
    conditioned = "conditioned on plans in English" if "plans" in actor else "of fixed tasks"
    return f"{conditioned}: `{actor['kind']}`{members}{module}"


def _training(description: Mapping[str, Any], demonstrated: set[str]) -> str:
    run, data = description.get("run") or {}, description.get("data") or {}
    rows: list[tuple[str, Mapping[str, Any]]] = [("dataset", part) for part in data.get("parts", [data])]
    training = description.get("training") or run.get("training") or {}
    rows.append(("training", {**training, **({"seed": run["seed"]} if "seed" in run else {})}))
    rows.append(("versions", description["versions"]))
    lines = []
    for name, row in rows:
        shown = [f"{key} {value}" for key, value in row.items() if value is not None and key in _SHOWN]
        lines += [f"- {name}: {', '.join(shown)}"] * bool(shown)
    return "\n".join([f"- tasks: {', '.join(sorted(demonstrated)) or 'not recorded'}", *lines])


def _success(result: EvaluationResult) -> str:
    config, runs = result.config, len(result.episodes)
    solved = sum(episode.success for episode in result.episodes)
    low, high = wilson_interval(solved, runs)
    rows = "".join(f"| {task} | {rate:.2f} |\n" for task, rate in result.success_once.items() if rate is not None)
    return (
        f"{counted(config['episodes_per_task'], 'episode')} of each task, seed {config['seed']}, action noise "
        f"{config['noise_scale']}, success at any step; one policy of one training seed: {solved} of {runs} episodes, "
        f"95 % interval {low:.3f} to {high:.3f} (Wilson).\n\n"
        f"| task | success |\n|---|---|\n{rows}| **mean** | **{result.mean_success:.3f}** |"
    )
