"""What `evaluate` and `record` both take: a policy's file or an object of yours, and a network for the conditions."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from inspect import signature
from pathlib import Path
from typing import Any

import lw_torchrl as lw
from lw_torchrl._registry import entry_points_of
from lw_torchrl.cli import options
from lw_torchrl.language.plans import Plans


def is_object(who: str) -> bool:
    """Whether a word names an object of yours, as my_module:policy."""
    module, _, name = who.partition(":")
    return name.isidentifier() and all(part.isidentifier() for part in module.split("."))


def check_policy(argument: str, who: str) -> None:
    """Refuse who is neither one of :data:`options.ACTORS`, nor a policy's file, nor looks like an object of yours."""
    if ":" in who and not is_object(who) and not Path(who).exists():
        raise ValueError(f"{argument} must be like my_module:policy, a module and a policy in it, got {who!r}")
    if not is_object(who):
        options.check_actor(argument, who)


def name_of(who: str) -> str:
    """What a policy is called: its file's name, or the object's."""
    return who.partition(":")[2] if is_object(who) else Path(who).stem


def read_policy(argument: str, who: str, plans: Plans | None, load: Callable[[Path], Any]) -> Any:
    """The object of yours, with the plans if any are given, or what ``load`` makes of a policy's file."""
    if not is_object(who):
        return load(Path(who))
    found = options.imported(argument, who, "policy")
    if not callable(found) or isinstance(found, type):
        what = f"the class {found.__name__}" if isinstance(found, type) else f"a {type(found).__name__}"
        raise ValueError(f"{argument} {who!r} must name a policy, from TensorDict to TensorDict, it names {what}")
    if plans is None:
        return found
    if not hasattr(found, "with_plans"):
        raise ValueError(f"--plans is for a policy with plans, {who} carries out none")
    return found.with_plans(plans)


def with_evaluator(policy: Any, evaluator: str | None, text_encoder: str | None) -> tuple[Any, Any]:
    """The policy with an evaluator inside, if one is named, and None; or, of a policy that takes none, both."""
    if evaluator is None:
        return policy, None
    if getattr(policy, "plans", None) is None:
        raise ValueError(f"--evaluator is for a policy with plans, {type(policy).__name__} has none")
    asked = _read_evaluator(evaluator, policy.plans, text_encoder)
    with suppress(AttributeError, TypeError, ValueError):  # a policy of yours, or one that reads exact truth too
        return policy.with_evaluator(asked), None
    return policy, asked


def _read_evaluator(named: str, plans: Plans, text_encoder: str | None) -> lw.QueryEvaluator:
    encoder = options.read_encoder(text_encoder)
    if not is_object(named) and (Path(named).exists() or not _is_class(named)):
        return lw.training.load_evaluator(named, plans, text_encoder=encoder)
    found: Any = options.imported("--evaluator", named, "evaluator") if is_object(named) else None
    found = lw.modules.EVALUATORS[named] if found is None else found
    if isinstance(found, lw.QueryEvaluator):
        return found.with_plans(plans)
    if not isinstance(found, type) or not issubclass(found, lw.QueryEvaluator):
        raise ValueError(
            f"--evaluator {named!r} must name an lw.QueryEvaluator, or a class of these, it names {found!r:.80}"
        )
    _check_yours(named, found)
    return fresh_evaluator(named, found, plans, encoder)


def fresh_evaluator(named: str, made: type[lw.QueryEvaluator], plans: Plans, encoder: Any) -> lw.QueryEvaluator:
    """One of a class that --evaluator names, which is made of the plans alone."""
    if made.from_options.__func__ is lw.QueryEvaluator.from_options.__func__:  # type: ignore[attr-defined]
        try:
            signature(made).bind(plans)
        except TypeError as error:
            raise ValueError(
                f"--evaluator {named}: the class is made of the plans alone, its other arguments need defaults: {error}"
            ) from None
    return made.from_options(plans, {}, encoder)


def _is_class(name: str) -> bool:
    """Whether a word is a class in the table of evaluators, to which a module of yours may have added."""
    added = "lw_torchrl.modules" in sys.modules or bool(entry_points_of("lw_torchrl.evaluators"))
    return name.isidentifier() and added and name in lw.modules.EVALUATORS


def _check_yours(named: str, made: type) -> None:
    """Refuse a class of ours."""
    if made.__module__.partition(".")[0] == "lw_torchrl":
        raise ValueError(
            f"--evaluator: {named} knows nothing before it is trained; give a file of `lw-torchrl train-evaluator`"
        )


def check_evaluator(evaluator: str | None, who: str) -> None:
    """Refuse an evaluator that is not there, and one for who asks no conditions."""
    if evaluator is None:
        return
    if who in options.ACTORS and who != "scripted":
        asks = "the scripted experts ask" if who == "expert" else f"{who} asks"
        raise ValueError(f"--evaluator is for a policy with plans, {asks} no conditions")
    if is_object(evaluator):
        return
    if Path(evaluator).exists() or not _is_class(evaluator):
        options.check_saved("evaluator", Path(evaluator), "network", "train-evaluator")
    else:
        _check_yours(evaluator, lw.modules.EVALUATORS[evaluator])
