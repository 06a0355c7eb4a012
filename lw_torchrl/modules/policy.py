"""The contracts of what acts and of the encoders it is built on, and the tables that find policies by name."""

from __future__ import annotations

from collections.abc import Mapping
from inspect import signature
from typing import Any, ClassVar, NamedTuple, Self

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import Compose, Transform

from lw_torchrl._checks import check_choice
from lw_torchrl._keys import dispatched, read, write
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.tasks import TASKS, Task
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.networks import with_weights_of
from lw_torchrl.modules.observation_features import ObservationFeatures
from lw_torchrl.transforms.qaf import QAFTransform


class Encoding(NamedTuple):
    """What an encoder makes of a batch."""

    latent: Tensor  # (B, D) float32, what is to be done
    features: Tensor  # (B, F) float32, where things are
    weights: Tensor | None = None  # (B, S) float32, the attention over the plan's steps; None without plans

    @property
    def joined(self) -> Tensor:
        """(B, D + F) float32, the latent beside the features: what networks read."""
        return torch.cat((self.latent, self.features), -1)


class Prepared(TensorDictModuleBase):
    """What policies and encoders share: they read ``in_keys``, know tasks, and say what must run before them.

    Attributes:
        config: the keyword arguments that make it again, as JSON.
        plans: the plans that it is conditioned on; None for none.
        tasks: the names of the tasks that it knows.
        layout: what the observations and actions are: its plans', or Meta-World's.
        plan_options: whether its class reads plans, and has options about their steps, like ``focus``.
    """

    plan_options: ClassVar[bool] = False

    config: dict[str, Any]
    plans: Plans | None = None
    tasks: tuple[str, ...]
    layout: Layout = METAWORLD

    def definition(self, task: str) -> Task | None:
        """What it knows of a task: its plan's definition, or the shipped one; None if it knows none."""
        return TASKS.get(task) if self.plans is None else self.plans[task].definition

    @classmethod
    def for_plans(cls, plans: Plans, *, text_encoder: TextEncoder | None = None, **options: Any) -> Self:
        """One for the tasks of ``plans``, ``cls(plans, **options)``; a class that takes a ``text_encoder`` gets it."""
        if text_encoder is not None and "text_encoder" in signature(cls).parameters:
            options["text_encoder"] = text_encoder
        known = signature(cls).parameters
        if not any(one.kind is one.VAR_KEYWORD for one in known.values()):
            for name in options:
                check_choice(f"option of {cls.__name__}", name, [*known][1:])
        return cls(plans, **options)

    def transform(self) -> Transform | None:
        """A new transform that writes what it reads and the environment does not give; None for none."""
        return None

    def read(self, tensordict: TensorDictBase) -> list[Tensor]:
        """The tensors of ``in_keys``; :class:`ValueError` names those that are missing."""
        return read(tensordict, self.in_keys)

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """What no trained parameter touches, and all checks of values, outside of vmap."""
        raise NotImplementedError(f"{type(self).__name__} must override prepare")

    def describe(self) -> dict[str, Any]:
        """What a policy's description needs beside the options, as JSON."""
        return {}

    def fit_contacts(self, observation: Tensor, task_id: Tensor) -> None:
        """Take contacts from demonstrations, (R, 39) float32 and (R,) int64, in place; by default none."""


class Encoder(Prepared):
    """From what is to be done, and where things are, to a latent and features.

    A subclass splits its work into :meth:`prepare`, which no trained parameter touches and which checks the values,
    and :meth:`encode`, which can be vmapped over parameters. As a module it writes ``encoding`` (B, D + F) float32.
    :class:`~lw_torchrl.modules.ConditionedActor` makes a policy of it. The policy's file holds it if its class is in
    :data:`~lw_torchrl.modules.ENCODERS`, is made of plans or of a list of tasks, and has its other arguments in
    ``config``.

    Attributes:
        features: what it sees of the observation.
        latent_size: D.

    Source: paper section 'Plan Conditioning'.
    """

    features: ObservationFeatures
    latent_size: int
    text_encoder: TextEncoder | None = None

    @property
    def width(self) -> int:
        """D + F, the width of ``encoding``."""
        return self.latent_size + self.features.width

    def encode(self, *prepared: Any, **_: Any) -> Encoding:  # any signature overrides it
        """From what :meth:`prepare` gives."""
        raise NotImplementedError(f"{type(self).__name__} must override encode")

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return write(tensordict, self, [self.encode(*self.prepare(tensordict)).joined])

    def describe(self) -> dict[str, Any]:
        """Its plans, or its tasks and which of them are not ours, as JSON."""
        if self.plans is not None:
            return {"plans": self.plans.to_json()}
        known = {name: self.definition(name) for name in self.tasks}
        own = {name: task.to_json() for name, task in known.items() if task is not None and task != TASKS.get(name)}
        return {"tasks": list(self.tasks), "own_tasks": own}

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> Self:
        """Make what :meth:`describe` and ``config``, as ``options``, described, with fresh weights."""
        options = dict(found["options"])
        if "text_encoder" in signature(cls).parameters:
            options["text_encoder"] = text_encoder
        if "plans" in found:
            return cls(Plans.from_json(found["plans"]), **options)
        return cls(described_tasks(found), **options)

    def with_plans(self, plans: AnyPlans) -> Encoder:
        """The same weights for other plans: training either trains both.

        Raises:
            TypeError: it is not conditioned on plans.
            ValueError: a weight's shape depends on the plans; such a class overrides this.
        """
        if self.plans is None:
            told = "is conditioned on descriptions"
            raise TypeError(f"with_plans is for policies with plans, {type(self).__name__} {told}")
        described = {"plans": as_plans(plans).to_json(), "options": self.config}
        with torch.random.fork_rng(devices=[]):
            made = type(self).from_description(described, self.text_encoder)
        try:
            return with_weights_of(self, made)
        except RuntimeError as error:
            which = str(error).partition("\n\t")[2].strip() or str(error)
            raise ValueError(f"plans: weights of {type(self).__name__} are those of its own plans: {which}") from error


class Policy(Prepared):
    """A module that acts, and knows what it was made of.

    A subclass splits its work into :meth:`prepare` and :meth:`act`, which returns ``out_keys``, the action first.

    Attributes:
        config: the options that make it again, as JSON; :meth:`describe` adds what :meth:`from_description` needs.
        plans, tasks, plan_options: as for :class:`Prepared`.
        row_by_row: whether a row's action is the same to the last bit whatever the other rows are: not of networks.
        draws: whether its actions, without exploration, depend on random numbers drawn before, for other episodes too.
        acts_in: the layout of its actions, where it is not that of its tasks, see
            :class:`~lw_torchrl.modules.TransferredActor`.

    Example:
        Your own policy, here one that knows nothing of its task. In ``POLICIES`` the command line trains and evaluates
        it, ``train --method Blind``. For another way of conditioning alone an :class:`Encoder` is less work.

        >>> import lw_torchrl as lw, torch
        >>> from lw_torchrl.modules import POLICIES
        >>> class Blind(lw.Policy):
        ...     def __init__(self, tasks, width=8):
        ...         super().__init__()
        ...         self.tasks, self.config = tuple(tasks), {"width": width}
        ...         self.in_keys, self.out_keys = ["observation"], ["action"]
        ...         self.net = torch.nn.Sequential(torch.nn.Linear(39, width), torch.nn.Linear(width, 4))
        ...     def prepare(self, tensordict):
        ...         return tuple(self.read(tensordict))
        ...     def act(self, observation):
        ...         return (self.net(observation),)
        ...     def describe(self):
        ...         return super().describe() | {"tasks": list(self.tasks)}
        ...     @classmethod
        ...     def from_description(cls, found, text_encoder=None):
        ...         return cls(found["tasks"], **found["options"])
        >>> POLICIES["Blind"] = Blind
        >>> lw.evaluate(Blind(["reach"]), tasks="reach", episodes_per_task=1, seed=1_000, max_steps=5).mean_success
        0.0
        >>> del POLICIES["Blind"]

    Source: the contract that ``torchrl.objectives`` and :func:`lw_torchrl.evaluate` rely on.
    """

    row_by_row: ClassVar[bool] = False
    draws: bool = False
    acts_in: Layout | None = None

    @property
    def spec(self) -> Composite:
        """Of the action, which losses ask for: (A,) float32, Meta-World's 4, in [-1, 1]."""
        spec = Composite()
        spec[self.out_keys_source[0]] = Bounded(-1.0, 1.0, (self.layout.action_size,))
        return spec

    def act(self, *prepared: Any, **_: Any) -> tuple[Tensor, ...]:  # any signature overrides it
        """From what :meth:`prepare` gives to a tensor for each of ``out_keys``; it can be vmapped over parameters."""
        raise NotImplementedError(f"{type(self).__name__} must override act")

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return write(tensordict, self, self.act(*self.prepare(tensordict)))

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        """Take statistics of observations (R, 39) float32 with weights (R,) of sum 1, in place; by default none."""

    def describe(self) -> dict[str, Any]:
        """All that :meth:`from_description` needs to make it again, but its weights, as JSON."""
        return {**kind_of(self), "options": self.config}

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> Policy:
        """Make what :meth:`describe` described, with fresh weights."""
        return cls(**found["options"])

    def with_evaluator(self, evaluator: Any) -> Policy:
        """The same weights, with the conditions answered by an evaluator; :class:`TypeError` if it reads none."""
        what = f"with_evaluator is for PlanConditionedActor and ScriptedSkillActor, {type(self).__name__} has none"
        raise TypeError(f"{what}; evaluate(..., evaluator=) answers any policy's conditions")

    def with_plans(self, plans: AnyPlans) -> Policy:
        """The same weights under other plans; :class:`TypeError` if it is not conditioned on plans."""
        raise TypeError(f"with_plans is for policies with plans, {type(self).__name__} has none")


def described_tasks(found: Mapping[str, Any]) -> list[str | Task]:
    """The tasks of a description that :meth:`Encoder.describe` gave."""
    own = {name: Task.from_json(name, row) for name, row in found["own_tasks"].items()}
    return [own.get(name, name) for name in found["tasks"]]


def kind_of(module: Prepared) -> dict[str, Any]:
    """How a description names a module's class; of one that is not ours also the module that has it."""
    kind = type(module)
    own = {} if kind.__module__.startswith("lw_torchrl.") else {"module": kind.__module__}
    return {"kind": kind.__name__, **own}


def decided(action: Tensor, layout: Layout, closes_above: float | None = None) -> Tensor:
    """Actions (..., A) of a layout with an effort of -1 or 1: closing above ``closes_above``, the layout's if None."""
    at, action = layout.effort, action.clone()
    bound = layout.closes_above if closes_above is None else closes_above
    action[..., at] = torch.where(action[..., at] * layout.closes > bound, 1.0, -1.0) * layout.closes
    return action


def plans_of(actor: Any) -> Plans | None:
    """The plans that an actor carries out, be it a :class:`Policy` or any module with ``plans``."""
    return getattr(actor, "plans", None)


def transform_of(actor: Any, plans: Plans | None) -> Transform | None:
    """What must run before an actor: what it asks for itself, or else the answers to the queries of ``plans``."""
    own = actor.transform() if isinstance(actor, Policy) else None
    parts = own.transforms if isinstance(own, Compose) else [own]
    if plans is None or any(isinstance(part, QAFTransform) for part in parts):
        return own
    return QAFTransform(plans) if own is None else Compose(QAFTransform(plans), own)
