"""Files of policies and of query evaluators, and what they say of the data that was trained on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torchrl.envs import Compose, Transform

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath, shipped_policy
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.query_evaluator import QueryEvaluator, evaluator_from_description
from lw_torchrl.modules.registry import from_description
from lw_torchrl.training.envelope import EVALUATOR, POLICY
from lw_torchrl.training.file_checks import stand_in, text_vectors

_PROBE = "the robot's gripper is open"


@checked
def save_actor(actor: Policy, path: AnyPath, **about: Any) -> None:
    """Write a policy, for :func:`load_actor`; an earlier file is replaced whole.

    Args:
        actor: what to write.
        path: the file.
        **about: what else the file is to say, as JSON.

    Raises:
        TypeError: the actor is no :class:`Policy`.
        ValueError: :func:`load_actor` would not make it again: its weights are of other names, shapes or dtypes than
            its description's, or are no finite numbers; or ``about`` names what a file says itself.
        OSError: it cannot be written; an earlier file stays.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "policy.zip")
        >>> lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10"), width=8), path)
        >>> lw.load_actor(path).config["width"]
        8
    """
    POLICY.save(path, check_can_be_saved(actor), text_vectors(actor), about)


def check_can_be_saved(actor: Any) -> Policy:
    """Return the actor if a policy file can hold it: what cannot be loaded again is refused before any training."""
    if not isinstance(actor, Policy):
        what = f"actor must be a Policy to be kept in a file, got {type(actor).__name__}"
        raise TypeError(f"{what}: save the policy inside of it, or derive your class from lw_torchrl.Policy")

    def make(described: Any) -> Policy:
        again = from_description(described, stand_in(text_vectors(actor)))
        if (again.in_keys, again.out_keys_source) != (actor.in_keys, actor.out_keys_source):
            raise ValueError("its in_keys or out_keys were changed later: give them where it is made")
        return again

    POLICY.check_can_be_saved(actor, make)
    return actor


@checked
def load_actor(path: AnyPath, *, text_encoder: TextEncoder | None = None) -> Policy:
    """Make the policy of a file, with its plans and weights, in eval mode.

    Args:
        path: the file; or "few-shot-mt50", a policy that is shipped, if there is no file of that name.
        text_encoder: the one that the policy was made with, if it was not the shipped one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, or its weights, sizes or texts are not those that it says, or are no finite numbers;
            or the text encoder is another than the policy was trained with.
        ImportError: its texts are not shipped, and the extra ``[text]`` is not installed.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.load_actor("few-shot-mt50").tasks == lw.MT50
        True
    """
    return POLICY.load(policy_file(path), from_description, text_encoder, text_vectors)


def policy_file(path: AnyPath) -> Path:
    """The file of a policy: the path itself, or a shipped policy's of that name where there is no such file."""
    return shipped_policy(path) or Path(path)


@checked
def save_evaluator(evaluator: QueryEvaluator, path: AnyPath, **about: Any) -> None:
    """Write an evaluator, for :func:`load_evaluator`; an earlier file is replaced whole. It holds the network alone.

    Args:
        evaluator: what to write, of a class in :data:`~lw_torchrl.modules.EVALUATORS`; else :class:`TypeError`.
        path, **about: as of :func:`save_actor`, with its errors.

    Example:
        >>> import lw_torchrl as lw, os, tempfile
        >>> path = os.path.join(tempfile.mkdtemp(), "evaluator.zip")
        >>> lw.training.save_evaluator(lw.StateQueryEvaluator(lw.load_plans("MT10"), width=8), path)
        >>> lw.training.load_evaluator(path, lw.load_plans("MT50")).config["width"]
        8
    """
    EVALUATOR.save(path, check_evaluator_can_be_saved(evaluator), evaluator_texts(evaluator), about)


def check_evaluator_can_be_saved(evaluator: Any) -> QueryEvaluator:
    """As :func:`check_can_be_saved`, of an evaluator."""
    if not isinstance(evaluator, QueryEvaluator):
        raise TypeError(f"evaluator must be a QueryEvaluator to be kept in a file, got {type(evaluator).__name__}")
    plans, encoder = evaluator.plans, evaluator.text_encoder
    EVALUATOR.check_can_be_saved(evaluator, lambda found: evaluator_from_description(found, plans, encoder))
    return evaluator


def evaluator_texts(evaluator: QueryEvaluator) -> dict[str, Tensor]:
    """The vector of one text, of an evaluator that reads texts: a file's texts."""
    return {"probe": encoded([_PROBE], evaluator.text_encoder)} if text_vectors(evaluator) else {}


@checked
def load_evaluator(path: AnyPath, plans: AnyPlans, *, text_encoder: TextEncoder | None = None) -> QueryEvaluator:
    """Make the evaluator of a file, for the conditions of some plans, in eval mode.

    Args:
        path, text_encoder: as of :func:`load_actor`, with its errors.
        plans: whose conditions it is to answer, any; :class:`ValueError` if they ask for what it cannot answer.
    """

    def make(described: Any, encoder: TextEncoder | None) -> QueryEvaluator:
        return evaluator_from_description(described, as_plans(plans), encoder)

    return EVALUATOR.load(path, make, text_encoder, evaluator_texts)


def read_description(path: AnyPath) -> dict[str, Any]:
    """The description that a policy file was saved with; errors as of :func:`load_actor`."""
    return POLICY.open(policy_file(path)).description


def demonstration_seeds(path: AnyPath) -> set[int]:
    """The seeds of the demonstrations that a file's policy was trained on, as far as the file says."""
    data = read_description(path).get("data")
    parts = data.get("parts", [data]) if isinstance(data, dict) else []
    return {part["seed"] for part in parts if isinstance(part, dict) and isinstance(part.get("seed"), int)}


def demonstrated_tasks(path: AnyPath) -> set[str]:
    """The tasks of the demonstrations that a file's policy was trained on, as far as the file says."""
    data = read_description(path).get("data")
    found = data if isinstance(data, dict) else {}
    parts = found.get("episodes", [found.get("tasks")])  # of joined datasets, task name to episodes each
    named = [part for part in parts if isinstance(part, (dict, list))] if isinstance(parts, list) else []
    return {task for part in named for task in part if isinstance(task, str)}


def describe_data(replay: Any) -> dict[str, Any] | None:
    """What demonstrations a replay buffer shows, as JSON; None for a buffer that is none of ours."""
    demonstrations = getattr(replay, "demonstrations", None)
    return None if demonstrations is None else demonstrations.config.to_json()


def describe_replay(replay: Any) -> dict[str, Any]:
    """How a replay buffer shows its rows, as JSON: what its batches depend on besides :func:`describe_data`."""
    parts = [one for one in replay.transform.modules() if isinstance(one, Transform) and not isinstance(one, Compose)]
    told = [{"class": type(one).__name__} | {k: repr(v) for k, v in plain_options(one).items()} for one in parts]
    return {
        "label": getattr(replay, "label", None),
        "rows": None if describe_data(replay) is None else len(replay),  # after_success leaves so many
        "sampler": type(replay.sampler).__name__,
        "transforms": told,
    }


def describe_learning(replay: Any) -> dict[str, Any]:
    """As :func:`describe_replay`, for what learns from rewards too; of a buffer that is none of ours, no more."""
    names = ("reward", "terminate_on_success", "n_steps", "gamma", "columns")
    told = {name: getattr(replay, name) for name in names if hasattr(replay, name)}
    grow = getattr(replay.storage, "grow", None)
    return describe_replay(replay) | told | ({} if grow is None else {"grow": grow})


def plain_options(module: nn.Module) -> dict[str, bool | int | float | str]:
    """The attributes of a transform or a loss that are flags, numbers and texts."""
    options = {name: value for name, value in vars(module).items() if name[0] != "_" and name != "training"}
    return {name: value for name, value in options.items() if isinstance(value, (bool, int, float, str))}
