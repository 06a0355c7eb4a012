"""SkillMixer: a module that mixes the latents of skills by attention."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from lw_torchrl._util.checks import Count, Natural, typed
from lw_torchrl._util.keys import Keys, dispatched, read, write
from lw_torchrl.language.task_index import PlanTables, as_plans, one_per_row, pick
from lw_torchrl.language.text import TextEncoder, encoded
from lw_torchrl.modules.parts import MLP, Part, Width, in_mode_of, materialize, probe

if TYPE_CHECKING:
    from lw_torchrl.language.plans import AnyPlans, Plans


def unit_scale(vectors: Tensor) -> Tensor:
    """Rescale vectors (n, E) to an RMS of 1, because a new network can hardly distinguish smaller vectors."""
    vectors = vectors.to(torch.float32)
    return vectors / vectors.square().mean(-1, keepdim=True).sqrt().clamp(min=1e-6)


class SkillEncoder(MLP):
    """An MLP that maps skill vectors (K, E) to skill latents (K, D).

    Args:
        latent_size: D, the size of a latent.
        width, depth: units per hidden layer and number of hidden layers; a sequence of widths sets both.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> lw.modules.SkillEncoder(latent_size=32)(torch.rand(5, 384)).shape
        torch.Size([5, 32])
    """

    @typed
    def __init__(self, latent_size: Count = 64, *, width: Width = 128, depth: Natural = 1) -> None:
        super().__init__(latent_size, width=width, depth=depth)
        self.config = {"latent_size": latent_size, "width": width, "depth": depth}


class SkillMixer(Part):
    """A module that encodes each skill's text to a latent, and mixes the latents by attention over the plan's steps.

    For plan steps with roles (see :func:`~lw_torchrl.canonical_plans`), the module encodes the role's verb and manner
    instead of the text.

    Reads ``skill_weights`` (B, S) float32 and ``task_id`` (B,) int64; writes ``skill_latent`` (B, D) float32.

    Args:
        plans: the plans whose skills are mixed.
        encoder: a module that maps K skill vectors (K, E) float32 to latents (K, D); None for :class:`SkillEncoder`.
        text_encoder: a function that maps n texts to vectors (n, E) float32; None for the shipped sentence encoder.
        in_keys, out_keys: replacements for the default keys, in the order above; nested keys are allowed.

    Raises:
        ImportError: a skill text has no precomputed embedding, and the extra ``[text]`` is not installed.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> mixer = lw.modules.SkillMixer(plans, torch.nn.Linear(384, 16))
        >>> weights = torch.ones(2, plans.num_steps) / plans.num_steps
        >>> mixer(skill_weights=weights, task_id=torch.full((2,), lw.task_id("reach"))).shape
        torch.Size([2, 16])

    Source: paper section 'Plan Conditioning'.
    """

    _options = ("plans", "encoder")
    index: Tensor
    vectors: Tensor

    @typed
    def __init__(
        self,
        plans: AnyPlans,
        encoder: nn.Module | None = None,
        *,
        text_encoder: TextEncoder | None = None,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        super().__init__(("skill_weights", "task_id"), ("skill_latent",), in_keys, out_keys)
        self.plans, self.text_encoder = as_plans(plans), text_encoder
        self.tables = PlanTables(self.plans)
        if self.plans.has_roles:
            index, vectors = _vectors_of_roles(self.plans, self.tables)
        else:
            index, vectors = self.tables.skill_index, encoded(self.plans.skills, text_encoder)
        # The tables are computed from the plans, so the state_dict does not need them.
        self.register_buffer("index", index, persistent=False)  # (T, S) int64
        self.register_buffer("vectors", unit_scale(vectors), persistent=False)  # (K, E) float32
        self.encoder = SkillEncoder() if encoder is None else encoder
        materialize(self.encoder, self.vectors)
        if (weight := next(self.encoder.parameters(), None)) is not None:  # the encoder may be on a GPU
            self.index, self.vectors = self.index.to(weight.device), self.vectors.to(weight)
        self.latent_size = probe(self.encoder, self.vectors).shape[-1]

    @property
    def text_vectors(self) -> Tensor | None:
        """The embeddings (K, E) float32 of the skill texts; None if the module encodes roles instead."""
        return None if self.plans.has_roles else self.vectors

    def with_plans(self, plans: AnyPlans) -> Self:
        """Return a mixer for another set of plans that shares the networks: training one also trains the other."""
        other = type(self)(**{**self.config, "plans": plans, "text_encoder": self.text_encoder})
        return in_mode_of(self, other.to(self.index.device))

    def latents(self) -> Tensor:
        """Return the latents (K, D) of the distinct skills."""
        return self.encoder(self.vectors)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        weights, task_id = read(tensordict, self.in_keys)
        latents, rows = self.latents(), self.tables.rows(one_per_row(task_id, weights))
        # One matrix product over the K skills is faster than gathering a latent for each step (B, S, D).
        zeros = weights.new_zeros((*weights.shape[:-1], len(latents)))
        per_skill = zeros.scatter_add(-1, pick(self.index, rows), weights).to(latents.dtype)
        return write(tensordict, self, [per_skill @ latents])


def _vectors_of_roles(plans: Plans, tables: PlanTables) -> tuple[Tensor, Tensor]:
    """Return the index (T, S) int64 of each plan step's vector, and the distinct vectors (K, E) float32."""
    from lw_torchrl.language.roles import role_vectors

    index, numbers = torch.zeros_like(tables.skill_index), dict[tuple[float, ...], int]()
    for task, plan in sorted(plans.items()):
        for step, vector in enumerate(role_vectors([step.role for step in plan.steps if step.role is not None])):
            index[tables.index.row(task), step] = numbers.setdefault(tuple(vector), len(numbers))
    return index, torch.tensor([*numbers])
