"""QueryEvaluatorTrainer: a StateQueryEvaluator learns what the query answering function answers."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict
from hashlib import blake2b
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn

from lw_torchrl._checks import checked_but, differences
from lw_torchrl._progress import Progress
from lw_torchrl._state_tree import check_optimizer_state, join
from lw_torchrl._versions import warn_of_other_versions
from lw_torchrl.modules.clause_evaluator import ClauseEvaluator, Clauses
from lw_torchrl.modules.state_query_evaluator import StateQueryEvaluator
from lw_torchrl.training.evaluator_files import check_evaluator_can_be_saved, open_evaluator, write_evaluator
from lw_torchrl.training.interrupts import interrupts_between_steps
from lw_torchrl.training.labelled_queries import LabelledQueries, QueryEvaluatorConfig
from lw_torchrl.training.policy_checks import copy_weights, first_line
from lw_torchrl.training.recent_losses import READ_EVERY, RecentLosses
from lw_torchrl.training.training_state import OneWriter


class QueryEvaluatorTrainer:
    """Trains an evaluator on the answers of the query answering function to all base queries of tasks.

    A minibatch has equally many of each predicate and truth, as far as there are any; within these, pairs of a state
    and a clause are drawn alike. An evaluator that reads texts is asked half of the clauses negated. A step's minibatch
    hangs on the seed and the step alone.

    Args:
        evaluator: it is trained in place; its plans do not matter.
        data: what is asked, and what of it is held out.
        config: how to train, the one that the data were made with.
        checkpoint: a file to write checkpoints to, which :func:`load_evaluator` reads. If it is there already, training
            carries on from it, bit for bit.
        progress: show a progress bar.

    Warns:
        UserWarning: the checkpoint was written under another version of torch or another package that bits hang on: it
            goes on, but not bit for bit.

    Raises:
        TypeError: the evaluator is no :class:`StateQueryEvaluator`.
        ValueError: the checkpoint is damaged, or of another evaluator, configuration or data; or, in :meth:`train`, the
            loss is no number.

    Example:
        >>> import lw_torchrl as lw, tempfile
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=2, root=root + "/demos", max_steps=80)
        ...     replay = lw.LanguageWorldExperienceReplay(root + "/demos", label="executed")
        ...     config = lw.training.QueryEvaluatorConfig(steps=200, batch_size=64, held_out_pairs=0.0)
        ...     data = lw.training.LabelledQueries(replay, config)
        ...     evaluator = lw.StateQueryEvaluator(lw.load_plans("MT10"))
        ...     lw.training.QueryEvaluatorTrainer(evaluator, data, config).train() < 0.65
        True
    """

    trains: ClassVar[type[ClauseEvaluator]] = StateQueryEvaluator

    @checked_but("evaluator")
    def __init__(
        self,
        evaluator: ClauseEvaluator,
        data: LabelledQueries,
        config: QueryEvaluatorConfig | None = None,
        *,
        checkpoint: str | os.PathLike[str] | None = None,
        progress: bool = True,
    ) -> None:
        if not isinstance(evaluator, self.trains):
            raise TypeError(f"evaluator must be of class {self.trains.__name__}, got {type(evaluator).__name__}")
        self.evaluator, self.config, self.progress = evaluator, config or QueryEvaluatorConfig(), progress
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self._writer = OneWriter(self.checkpoint)
        self._gather(data)
        trained = (weight for weight in evaluator.parameters() if weight.requires_grad)
        self.optimizer = torch.optim.AdamW(
            trained, lr=float(self.config.learning_rate), weight_decay=self.config.weight_decay
        )
        for group in self.optimizer.param_groups:
            group["initial_lr"] = group["lr"]
        self.done = 0
        self._losses = RecentLosses(("the loss",), self.config.learning_rate)
        self._described = json.loads(json.dumps({"training": asdict(self.config), "data": data.describe()}))
        self._described["data"]["labels"] = self._digest
        if self.checkpoint is not None:
            check_evaluator_can_be_saved(evaluator)
            if self.checkpoint.exists():
                self._load(self.checkpoint)

    def _gather(self, data: LabelledQueries) -> None:
        """Rows and clauses of all tasks in one list each, and the pairs of both by predicate and truth."""
        asked = data.parts["training"]
        if not asked:
            raise ValueError("data must have states and queries to train on, all are held out")
        self._observation = torch.cat([one.observation for one in asked])
        self._clauses, self._vectors = self.evaluator.code(
            [(one.task, clause) for one in asked for clause in one.clauses]
        )
        self._negatable = len(self._clauses.predicate) // 2 if self._vectors is not None else 0
        names = [clause.predicate for one in asked for clause in one.clauses]
        number = {name: place for place, name in enumerate(sorted({*names}))}
        kind = torch.tensor([number[name] for name in names])
        groups: list[list[Tensor]] = [[] for _ in range(2 * len(number))]
        row = first = 0
        for one in asked:
            of = kind[first : first + len(one.clauses)]
            for place in of.unique().tolist():
                columns = (of == place).nonzero()[:, 0]
                for truth in (0, 1):
                    at = (one.truth[:, columns] == bool(truth)).nonzero()
                    pairs = torch.stack((at[:, 0] + row, columns[at[:, 1]] + first), -1)
                    groups[2 * place + truth].append(pairs.int())
            row, first = row + len(one.observation), first + len(one.clauses)
        parts = [(torch.cat(found), place % 2) for place, found in enumerate(groups) if found]
        parts = [(found, truth) for found, truth in parts if len(found)]
        self._pairs = torch.cat([found for found, _ in parts])
        self._sizes = torch.tensor([len(found) for found, _ in parts])
        self._starts = self._sizes.cumsum(0) - self._sizes
        self._truths = torch.tensor([bool(truth) for _, truth in parts])
        digest = blake2b(digest_size=8)
        for tensor in (self._observation, self._pairs, self._sizes):
            digest.update(tensor.contiguous().numpy().tobytes())
        self._digest = digest.hexdigest()

    def _load(self, path: Path) -> None:
        archive = open_evaluator(path)
        ours = {"evaluator": json.loads(json.dumps(self.evaluator.describe())), **self._described}
        for part, wanted in ours.items():
            if (found := archive.description.get(part)) != wanted:
                differ = differences(found if isinstance(found, dict) else {}, wanted)
                raise ValueError(
                    f"checkpoint: {str(path)!r} is of another {part}, which differs in {', '.join(differ[:8])}; choose "
                    "another file, or delete it to start again"
                )
        warn_of_other_versions(path, archive.description.get("versions"))
        try:
            state = join(archive.description.get("state"), archive.tensors("training"))
            if not isinstance(state, dict) or set(state) != {"step", "optimizer"}:
                raise ValueError("a training state has step and optimizer")
            if type(state["step"]) is not int or not 0 <= state["step"] <= self.config.steps:
                raise ValueError(f"step must be from 0 to {self.config.steps}")
            check_optimizer_state(state["optimizer"], self.optimizer, state["step"])
            copy_weights(archive.tensors("weights"), self.evaluator.state_dict(keep_vars=True))
            self.optimizer.load_state_dict(state["optimizer"])
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"checkpoint: {str(path)!r} does not fit, it is damaged ({first_line(error)})") from error
        self.done = state["step"]

    def save(self) -> None:
        """Write the checkpoint, if there is to be one."""
        if self.checkpoint is not None:
            state = {"step": self.done, "optimizer": self.optimizer.state_dict()}
            write_evaluator(self.evaluator, self.checkpoint, self._described, state)
            self._writer.know()

    def _draw(self) -> tuple[Tensor, Clauses, Tensor]:
        """Observation (B, 39) float32, clauses (B, 1) and their truth (B, 1) float32."""
        size = self.config.batch_size
        generator = torch.Generator().manual_seed((self.config.seed * 1_000_003 + self.done) % 2**63)
        group = (torch.arange(size) + self.done * size) % len(self._sizes)
        place = (torch.rand(size, generator=generator, dtype=torch.float64) * self._sizes[group]).long()
        row, clause = self._pairs[self._starts[group] + place].long().unbind(-1)
        truth = self._truths[group]
        if self._negatable:
            negated = torch.rand(size, generator=generator) < 0.5
            clause, truth = clause + negated * self._negatable, truth ^ negated
        return self._observation[row], self._clauses.pick(clause[:, None]), truth[:, None].float()

    def _loss(self) -> Tensor:
        """Of the step's minibatch, () float32."""
        observation, clauses, truth = self._draw()
        logits = self.evaluator.network(observation, clauses, self._vectors)
        return nn.functional.binary_cross_entropy_with_logits(logits, truth)

    def step(self) -> Tensor:
        """Train on one minibatch and return its loss, () float32."""
        rate = 0.5 * self.config.learning_rate * (1.0 + math.cos(math.pi * self.done / self.config.steps))
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        loss = self._loss()
        self._losses.check(loss.detach(), self.done)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.done += 1
        return loss.detach()

    def train(self) -> float:
        """Train to the last step, from wherever training stands; Ctrl-C ends it between two steps, with a checkpoint.

        Returns:
            The mean loss over the last 100 steps made; NaN if there were none left to make.
        """
        self._losses.clear()
        self.evaluator.train()
        total = self.config.steps
        bar = Progress("training the evaluator", total, "step", initial=self.done, show=self.progress)
        with self._writer.alone(), bar, interrupts_between_steps() as interrupt:
            while self.done < total and not interrupt.asked:
                self._losses.add(self.step())
                bar.update()
                if self.done % READ_EVERY == 0:
                    bar.note(loss=f"{self._losses.read(self.done).mean():.4f}")
                if self.done % self.config.checkpoint_every == 0 or self.done == total:
                    self.save()
            if interrupt.asked:
                self.save()
        self.evaluator.eval()
        return self._losses.read(self.done).mean().item()
