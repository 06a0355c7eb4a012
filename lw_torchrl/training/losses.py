"""Offline losses by name, with the critics and advantages that they need; ``lw-torchrl train --loss`` uses them."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import CQLLoss, IQLLoss, LossModule, TD3BCLoss

from lw_torchrl._checks import check_choice
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.critics import PlanConditionedQValue, PlanConditionedValue
from lw_torchrl.objectives import AdvantageWeightedLoss, ExpectileValueLoss, standardize_by_task
from lw_torchrl.training.normalization import fit_normalization
from lw_torchrl.training.offline import OfflineConfig, OfflineTrainer

GAMMA, N_STEPS = 0.99, 10
"""The discount of a step, and the number of steps that a value's target looks ahead."""
DISTRIBUTIONS = {"advantage": None, "iql": "normal", "td3-bc": None, "cql": "tanh_normal"}
"""The losses by name, and the distribution of actions that the actor needs."""
_CHUNK = 20_000  # rows whose advantages are computed together


def make_loss(name: str, actor: TensorDictModuleBase, plans: Plans, replay: TensorDictReplayBuffer) -> LossModule:
    """Return the loss of that name for an actor, with plan-conditioned critics normalised to the buffer's rows.

    The actor has the distribution in :data:`DISTRIBUTIONS`. "advantage" reads the column ``advantage``; for the others
    the buffer looks :data:`N_STEPS` ahead with the discount :data:`GAMMA`.

    Source: Kostrikov et al., "Implicit Q-Learning"; Fujimoto and Gu, "A Minimalist Approach to Offline Reinforcement
    Learning"; Kumar et al., "Conservative Q-Learning".
    """
    check_choice("loss", name, DISTRIBUTIONS)
    if name == "advantage":
        return AdvantageWeightedLoss(actor, beta=2.0, loss_function="l1")
    qvalue = PlanConditionedQValue(plans)
    fit_normalization(qvalue, replay)
    pair: dict[str, Any] = {"num_qvalue_nets": 2, "loss_function": "l2"}
    if name == "iql":
        value = PlanConditionedValue(plans)
        fit_normalization(value, replay)
        loss: LossModule = IQLLoss(actor, qvalue, value, expectile=0.7, temperature=3.0, **pair)
    elif name == "td3-bc":
        loss = TD3BCLoss(actor, qvalue, bounds=(-1.0, 1.0), delay_actor=True, **pair)
    else:
        loss = CQLLoss(actor, qvalue, loss_function="l2", num_random=1)
    loss.make_value_estimator(gamma=GAMMA)
    return loss


def learn_advantages(
    plans: Plans, replay: TensorDictReplayBuffer, config: OfflineConfig, device: torch.device, **options: Any
) -> Tensor:
    """Train a value by expectile regression and return each row's advantage, standardised by task, (R, 1) float32.

    The buffer's rows look :data:`N_STEPS` ahead with the discount :data:`GAMMA`.
    """
    value = PlanConditionedValue(plans, ensemble=2).to(device)
    loss = ExpectileValueLoss(value, expectile=0.7).make_value_estimator(gamma=GAMMA)
    OfflineTrainer(loss, replay, config, **options).train()
    starts = range(0, len(replay), _CHUNK)
    chunks = [replay[start : min(start + _CHUNK, len(replay))].to(device) for start in starts]
    advantage = torch.cat([loss.advantage(chunk).cpu() for chunk in chunks])
    return standardize_by_task(advantage, torch.cat([chunk["task_id"].cpu() for chunk in chunks]))
