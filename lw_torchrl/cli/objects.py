"""What `evaluate` and `record` both take: a policy's file or an object of yours, and a network for the conditions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lw_torchrl as lw
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


def with_evaluator(policy: Any, evaluator: Path | None, text_encoder: str | None) -> Any:
    """The policy with its conditions answered by the network of a file, if one is given."""
    if evaluator is None:
        return policy
    if getattr(policy, "plans", None) is None or not hasattr(policy, "with_evaluator"):
        raise ValueError(f"--evaluator is for a policy with plans, {type(policy).__name__} has none")
    encoder = options.read_encoder(text_encoder)
    return policy.with_evaluator(lw.training.load_evaluator(evaluator, policy.plans, text_encoder=encoder))


def check_evaluator(evaluator: Path | None, who: str) -> None:
    """Refuse a network's file that is not there, and one for who asks no conditions."""
    if evaluator is None:
        return
    if who in options.ACTORS and who != "scripted":
        asks = "the scripted experts ask" if who == "expert" else f"{who} asks"
        raise ValueError(f"--evaluator is for a policy with plans, {asks} no conditions")
    options.check_saved("evaluator", evaluator, "network", "train-evaluator")
