"""How an offline run learns: the values, the advantages, and the policy by one of the losses."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.objectives import CQLLoss, IQLLoss, LossModule, TD3BCLoss

from lw_torchrl._files import held
from lw_torchrl._tensor_archive import ArchiveError, TensorArchive, write_archive
from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.evaluation import EvaluationResult, evaluate
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules import DescriptorEncoder, PlanEncoder, QValue, Value
from lw_torchrl.modules.encoder import Encoder
from lw_torchrl.modules.policy import METHODS, Policy, make_policy
from lw_torchrl.objectives import AdvantageWeightedLoss, ExpectileValueLoss, standardize_by_task
from lw_torchrl.paper.execution import EVALUATION_SEED, RESULTS, load_result
from lw_torchrl.paper.mixtures import TASK_SETS
from lw_torchrl.paper.offline_recipes import OfflineRecipe
from lw_torchrl.paper.offline_runs import SEEN_BY, Advantages, Learned, OfflineRun
from lw_torchrl.training.behavioral_cloning import bc_loss
from lw_torchrl.training.envelope import check_description, check_same_description
from lw_torchrl.training.files import describe_data, load_actor, save_actor
from lw_torchrl.training.offline import OfflineConfig, OfflineTrainer
from lw_torchrl.transforms import QAFTransform

_CHUNK = 20_000  # rows whose advantages are taken at once
_FORMAT = {"format": "lw_torchrl.advantages", "version": 1}


def _encoder(condition: str, plans: Plans, noise: float = 0.0) -> Encoder:
    """What a critic sees, as actors of the same condition see it."""
    if METHODS[condition].policy == "PlanConditionedActor":
        return PlanEncoder(plans, feature_noise=noise)
    return DescriptorEncoder(tuple(plans), feature_noise=noise, **METHODS[condition].options)


def _value_loss(one: Advantages, plans: Plans) -> ExpectileValueLoss:
    value = Value(
        _encoder(one.critic, plans, noise=0.02), ensemble=2, width=one.recipe.width, depth=one.recipe.critic_depth
    )
    loss = ExpectileValueLoss(value, expectile=one.recipe.expectile)
    return loss.make_value_estimator(gamma=one.recipe.gamma)


def _q(run: OfflineRun, plans: Plans) -> QValue:
    return QValue(_encoder(run.critic, plans), width=run.recipe.width, depth=run.recipe.critic_depth)


def _advantage(actor: Policy, run: OfflineRun, plans: Plans) -> LossModule:
    recipe = run.recipe
    return AdvantageWeightedLoss(actor, beta=recipe.beta, max_weight=recipe.max_weight, loss_function=recipe.distance)


def _bc(actor: Policy, run: OfflineRun, plans: Plans) -> LossModule:
    return bc_loss(actor, run.recipe.distance)


def _iql(actor: Policy, run: OfflineRun, plans: Plans) -> LossModule:
    value = Value(_encoder(run.critic, plans), width=run.recipe.width, depth=run.recipe.critic_depth)
    options: dict[str, Any] = {"expectile": run.recipe.expectile, "temperature": run.recipe.temperature}
    return IQLLoss(actor, _q(run, plans), value, num_qvalue_nets=2, loss_function="l2", **options)


def _td3_bc(actor: Policy, run: OfflineRun, plans: Plans) -> LossModule:
    options: dict[str, Any] = {"bounds": (-1.0, 1.0), "alpha": run.recipe.alpha, "delay_actor": True}
    return TD3BCLoss(actor, _q(run, plans), num_qvalue_nets=2, loss_function="l2", **options)


def _cql(actor: Policy, run: OfflineRun, plans: Plans) -> LossModule:
    # TorchRL makes rows of the actions that it draws: one or ten, each soft maximum is of three actions.
    options: dict[str, Any] = {"min_q_weight": run.recipe.cql_weight, "num_random": 1}
    return CQLLoss(actor, _q(run, plans), loss_function="l2", **options)


LOSSES: Mapping[str, tuple[Callable[[Policy, OfflineRun, Plans], LossModule], str | None]] = {
    "advantage": (_advantage, None),
    "bc": (_bc, None),
    "iql": (_iql, "normal"),
    "td3-bc": (_td3_bc, None),
    "cql": (_cql, "tanh_normal"),
}
"""By name: what makes the loss, and the distribution that its actor needs."""


def _replay(one: Learned, plans: Plans, out: Path, **options: Any) -> LanguageWorldExperienceReplay:
    return LanguageWorldExperienceReplay(
        [out / dataset.folder for dataset in one.datasets],
        label="executed",
        terminate_on_success=True,
        reward=one.recipe.reward,
        sampler=TaskBalancedSampler(),
        transform=QAFTransform(plans),
        **options,
    )


def _ahead(recipe: OfflineRecipe) -> dict[str, Any]:
    return {"n_steps": recipe.n_steps, "gamma": recipe.gamma if recipe.n_steps > 1 else None}


def make_advantages(one: Advantages, plans: Plans, out: Path, progress: bool) -> dict[str, Tensor]:
    """The advantages of a mixture's rows, learned once and kept in ``advantages.zip``.

    Returns:
        ``advantage``, (R, 1) float32, standardised by task.

    Raises:
        ValueError: ``out`` holds those of another configuration.
    """
    file = out / one.folder / "advantages.zip"
    described = _FORMAT | {"run": one.describe(plans)}
    with held(file, "out", wait=True):
        if not file.is_file():
            for dataset in one.datasets:
                dataset.make(out, progress)
            own = one.own_plans(plans)
            torch.manual_seed(one.seed)
            loss = _value_loss(one, own)
            replay = _replay(one, own, out, **_ahead(one.recipe))
            config = _config(one, one.recipe.value_steps)
            checkpoint = file.with_name("checkpoint.zip")
            title = f"value by {SEEN_BY[one.critic]}, {one.mixture}"
            OfflineTrainer(loss, replay, config, checkpoint=checkpoint, progress=progress, title=title).train()
            starts = range(0, len(replay), _CHUNK)
            chunks = [replay[start : min(start + _CHUNK, len(replay))] for start in starts]
            found = standardize_by_task(
                torch.cat([loss.advantage(chunk) for chunk in chunks]),
                torch.cat([chunk["task_id"] for chunk in chunks]),
            )
            write_archive(file, described, {"advantages": {"advantage": found}})
            checkpoint.unlink()
    try:
        archive = TensorArchive(file)
        advantages = archive.tensors("advantages")
    except ArchiveError as error:
        raise ValueError(f"out: {str(file)!r} is damaged ({error}); delete it, and they are learned again") from error
    check_same_description(file, archive.description, described)
    return advantages


def _config(one: Learned, steps: int) -> OfflineConfig:
    return OfflineConfig(steps=steps, batch_size=one.recipe.batch_size, seed=one.seed)


def train_offline(run: OfflineRun, plans: Plans, out: Path, progress: bool = True) -> Policy:
    """The policy of a run, kept in ``policy.zip``; while it is trained there is a checkpoint beside it."""
    folder, described, own = out / run.folder, run.describe(plans), run.own_plans(plans)
    file, checkpoint = folder / "policy.zip", folder / "checkpoint.zip"
    if file.is_file():
        check_description(file, {"run": described})
        checkpoint.unlink(missing_ok=True)
        return load_actor(file)
    recipe = run.recipe
    make_loss, distribution = LOSSES[run.how.loss]
    learns_values = run.how.critic and run.advantages is None
    replay = _replay(run, own, out, keep=run.how.keep, **(_ahead(recipe) if learns_values else {}))
    if (advantages := run.advantages) is not None:
        replay.add_column("advantage", make_advantages(advantages, plans, out, progress)["advantage"])
    torch.manual_seed(run.seed)
    options: dict[str, Any] = {"width": recipe.width, "depth": recipe.depth, "feature_noise": recipe.feature_noise}
    actor = make_policy(run.actor, own, distribution=distribution, **options)
    loss = make_loss(actor, run, own)
    if learns_values:
        loss.make_value_estimator(gamma=recipe.gamma)
    config = _config(run, recipe.steps)
    OfflineTrainer(loss, replay, config, checkpoint=checkpoint, progress=progress, title=run.label).train()
    save_actor(actor, file, data=describe_data(replay), run=described)
    checkpoint.unlink(missing_ok=True)  # another process did the same run, where files cannot be locked
    return actor.eval()


def execute_offline(run: OfflineRun, plans: Plans, out: Path, *, progress: bool = True) -> EvaluationResult:
    """Do a run, or what is left of it; its result is written last, to ``out/run.folder/results.json``.

    Args:
        run: what to do.
        plans: a plan for each of its tasks.
        out: the experiments' folder.
        progress: show progress bars.

    Returns:
        The evaluation of the last step's policy on seeds that no data has, action noise 0.1; ``config["run"]`` says
        what was done, and ``config["seconds"]`` how long this call took.

    Raises:
        ValueError: ``out`` holds the same run of another configuration.
    """
    if (done := load_result(run, plans, out)) is not None:
        return done
    with held(out / run.folder, "out", folder=True, wait=True):
        return load_result(run, plans, out) or _execute(run, plans, out, progress)


def _execute(run: OfflineRun, plans: Plans, out: Path, progress: bool) -> EvaluationResult:
    started = time.perf_counter()
    for dataset in run.datasets:
        dataset.make(out, progress)
    policy = train_offline(run, plans, out, progress)
    result = evaluate(
        policy,
        tasks=TASK_SETS[run.tasks],
        episodes_per_task=run.episodes,
        seed=EVALUATION_SEED + run.seed,
        noise_scale=0.1,
        stop_at_success=True,
        max_steps=run.max_steps,
        progress=progress,
    )
    spent = {"run": run.describe(plans), "seconds": round(time.perf_counter() - started, 1)}
    result = replace(result, config=result.config | spent)
    result.save(out / run.folder / RESULTS)
    return result
