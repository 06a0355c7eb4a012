"""Model cards: what a policy's file says of it, and what an evaluation measured, as Markdown."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from lw_torchrl._checks import checked, counted
from lw_torchrl._files import AnyPath, shipped_policy
from lw_torchrl.evaluation.result import EvaluationResult
from lw_torchrl.evaluation.statistics import wilson_interval
from lw_torchrl.training.files import demonstrated_tasks, read_description

_TRAINING = ("steps", "batch_size", "learning_rate", "optimizer", "schedule", "frames", "seed")
_DATA = ("episodes_per_task", "seed", "noise_scale", "noise_hold", "redraw_failures", "max_steps", "behaviour")
_TAGS = ("robotics", "imitation-learning", "reinforcement-learning", "torchrl", "lw_torchrl")


@checked
def policy_card(policy: AnyPath, result: EvaluationResult | None = None, *, repo: str = "") -> str:
    """A model card of a policy: Markdown with YAML in front, as model hubs read it.

    Args:
        policy: its file, or the name of a shipped one.
        result: an evaluation of it, for the table of success; None for none, or, of a shipped one, for the one that is
            shipped beside it.
        repo: where it can be had, "me/my-policy"; "" for the file alone.

    Returns:
        What it is, what it was trained on as far as the file says, its success, its limits, how to load it and what to
        cite.

    Raises:
        FileNotFoundError, ValueError: as of :func:`~lw_torchrl.load_actor`.
        ValueError: the result is of tasks that the policy does not know.

    Example:
        >>> print(policy_card("few-shot-mt50").splitlines()[1])
        library_name: lw_torchrl

    Source: the model cards of the Hugging Face Hub; Mitchell et al., 'Model Cards for Model Reporting'.
    """
    described, name = read_description(policy), Path(policy).stem
    actor: Mapping[str, Any] = described["actor"]
    tasks, shown = _tasks(actor), demonstrated_tasks(policy)
    if result is None and (shipped := shipped_policy(policy)) is not None:
        result = EvaluationResult.load(shipped.with_suffix(".json"))
    if result is not None and tasks and (other := set(result.config["tasks"]) - tasks):
        raise ValueError(f"result must be of the policy's tasks, it does not know {', '.join(sorted(other))}")
    lines = ["---", "library_name: lw_torchrl", "pipeline_tag: robotics", "tags:", *(f"- {tag}" for tag in _TAGS)]
    lines += [
        *_front(name, result),
        "---",
        "",
        f"# {_plain(name).strip() or 'A policy'}",
        "",
        *_about(actor, tasks, shown),
        "",
    ]
    lines += ["## What it was trained on", "", *_trained(described, shown), "", "## Success", "", *_success(result), ""]
    lines += ["## Limits", "", *_limits(tasks, shown, result), "", "## How to load it", "", *_loading(policy, repo), ""]
    cited = (files("lw_torchrl.evaluation") / "data" / "citation.bib").read_text("utf-8").strip()
    return "\n".join([*lines, "## How to cite", "", "```bibtex", cited, "```", ""])


def _plain(value: Any) -> str:
    """What a file says, which may be a stranger's, as one line without Markdown, links, HTML and YAML."""
    text = value if isinstance(value, str) else json.dumps(value)
    text = re.sub(r"[^\w .,:+/'()\[\]-]", "", " ".join(text.split()))[:200]
    # [text](address) is a link, and so is an address alone.
    return re.sub(r"(?<=[\]:])(?=[(\[/:])|(?<=\bwww)(?=\.)", " ", text, flags=re.IGNORECASE)


def _quoted(text: str) -> str:
    """A text in quotes, as Python, JSON and YAML read it back."""
    return json.dumps(text, ensure_ascii=not text.isprintable())


def _object(found: Any) -> dict[str, Any]:
    return found if isinstance(found, dict) else {}


def _tasks(actor: Mapping[str, Any]) -> set[str]:
    """The tasks that an actor's description names, those of its parts among them."""
    found: set[str] = set()
    for name in ("plans", "tasks"):
        if isinstance(named := actor.get(name), (dict, list)):
            found |= {task for task in named if isinstance(task, str)}
    for part in [*actor.values(), *(one for value in actor.values() if isinstance(value, list) for one in value)]:
        if isinstance(part, dict) and "kind" in part:
            found |= _tasks(part)
    return found


def _front(name: str, result: EvaluationResult | None) -> list[str]:
    """The part of the YAML that holds numbers."""
    if result is None:
        return []
    rate = f"{result.mean_success:.3f}"
    return [
        "model-index:",
        f"- name: {_quoted(name)}",
        "  results:",
        "  - task: {type: robotics}",
        f"    dataset: {{type: meta-world, name: {_plain(len(result.config['tasks']))} tasks}}",
        f"    metrics: [{{type: success_rate, name: mean success, value: {rate}}}]",
    ]


def _about(actor: Mapping[str, Any], tasks: set[str], shown: set[str]) -> list[str]:
    options = _object(actor.get("options"))
    told = ", ".join(f"{key} {_plain(options[key])}" for key in ("features", "width", "depth") if key in options)
    plans = "conditioned on plans in English" if "plans" in actor else "that knows its tasks"
    about = f"A policy of lw_torchrl, {plans}: `{_plain(actor.get('kind'))}`"
    parts = f" of {counted(len(actor['members']), 'network')}" if isinstance(actor.get("members"), list) else ""
    lines = [f"{about}{parts}{f', {told}' if told else ''}.", ""]
    lines += [f"It knows {counted(len(tasks), 'task')}, and was shown demonstrations of {len(shown)}."]
    if "module" in actor:
        lines.append(f"Its class is of the module `{_plain(actor['module'])}`, which must be imported first.")
    return lines


def _trained(described: Mapping[str, Any], shown: set[str]) -> list[str]:
    run, data, lines = _object(described.get("run")), _object(described.get("data")), []
    parts = data.get("parts", [data] if data else [])
    for number, part in enumerate(parts if isinstance(parts, list) else [], 1):
        told = [f"{key} {_plain(one)}" for key, one in _object(part).items() if key in _DATA]
        lines.append(f"- dataset {number}: {', '.join(told)}")
    if shown:
        lines.append(f"- tasks: {', '.join(_plain(task) for task in sorted(shown))}")
    for where in ("training", "online"):
        if found := _object(described.get(where) or run.get(where)):
            seed = {"seed": run["seed"]} if "seed" in run else {}
            told = [f"{key} {_plain(value)}" for key, value in (found | seed).items() if key in _TRAINING]
            lines.append(f"- {where}: {', '.join(told)}")
    if versions := _object(described.get("versions")):
        lines.append(f"- versions: {', '.join(f'{_plain(k)} {_plain(v)}' for k, v in versions.items())}")
    return lines or ["The file does not say."]


def _success(result: EvaluationResult | None) -> list[str]:
    if result is None:
        return ["Not measured. `lw-torchrl evaluate` writes a result, and `lw-torchrl info --result` puts it here."]
    config, ends = result.config, result.success_at_end
    solved, runs = sum(one.success for one in result.episodes), len(result.episodes)
    least, most = wilson_interval(solved, runs)
    how = (
        f"{counted(config['episodes_per_task'], 'episode')} of each task, seed {_plain(config['seed'])}, action noise "
    )
    noise = _plain(config["noise_scale"])
    lines = [f"{how}{noise}, success at any step. It is one policy, of one training seed.", ""]
    lines += ["| task | success | at the end |", "|---|---|---|"]
    for task, rate in result.success_once.items():
        at_end = "" if ends[task] is None else f"{ends[task]:.2f}"
        lines.append(f"| {_plain(task)} | {'' if rate is None else f'{rate:.2f}'} | {at_end} |")
    interval = f"{solved} of {runs} episodes, 95 % interval {least:.3f} to {most:.3f}"
    return [*lines, f"| **mean** | **{result.mean_success:.3f}** | |", "", f"{interval} (Wilson)."]


def _limits(tasks: set[str], shown: set[str], result: EvaluationResult | None) -> list[str]:
    lines = ["- It was trained and evaluated in simulation alone, on positions that the simulator tells."]
    if unseen := len(tasks - shown):
        lines.append(f"- {counted(unseen, 'task')} that it knows had no demonstrations.")
    lines.append("- It knows no other task, robot or simulator, unless the table above says so.")
    rates = {} if result is None else result.success_once
    if weak := [f"{_plain(task)} ({rate:.2f})" for task, rate in rates.items() if rate is not None and rate < 0.8]:
        lines.append(f"- Below 0.8: {', '.join(weak)}.")
    return lines


def _loading(policy: AnyPath, repo: str) -> list[str]:
    source = f"lw.from_pretrained({_quoted(repo)})" if repo else f"lw.load_actor({_quoted(Path(policy).name)})"
    return [
        "```python",
        "import lw_torchrl as lw",
        "",
        f"policy = {source}",
        "print(lw.evaluate(policy, tasks=policy.tasks[:1], episodes_per_task=5, seed=1_000).table())",
        "```",
        "",
        "The file holds numbers and JSON. Reading it runs no code.",
    ]
