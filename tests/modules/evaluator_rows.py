"""What every evaluator of clauses does with rows."""

import torch

import lw_torchrl as lw


def assert_a_logit_for_each_step(evaluator, found):
    """Of 64 rows, as many as evaluation's blocks have, whatever their order and shape; padding beyond a plan's end."""
    logits = evaluator(found.clone())["qaf_logits"]
    assert logits.shape == (64, evaluator.plans.num_steps)
    assert logits.dtype == torch.float32
    for row, task in enumerate(found["task_id"].tolist()):
        steps = len(evaluator.plans[lw.MT50[task]].steps)
        assert (logits[row, :steps].abs() <= 31).all()
        assert (logits[row, steps:] == -1e4).all()
    order = torch.randperm(64, generator=torch.Generator().manual_seed(1))
    assert torch.equal(evaluator(found[order])["qaf_logits"], logits[order])
    assert torch.equal(evaluator(found.reshape(4, 16))["qaf_logits"].reshape(64, -1), logits)
