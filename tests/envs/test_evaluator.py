"""TorchRL's Evaluator with our environment and actor, in a thread and in a process."""

from __future__ import annotations

import pytest
import torch
from torchrl.collectors import Evaluator
from worker_envs import make_actor, make_push_reach

pytestmark = [
    pytest.mark.filterwarnings(
        "ignore:Nested TransformedEnvs",  # it wraps the environment that it is given
        "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning",
        "ignore:No explicit `?device",
    )
]
OPTIONS = {"auto_register_policy_transforms": False, "traj_format": "padded"}


def factory(env=None):
    return make_actor()


def look(found):
    steps = found["next", "reward"].shape[1]
    return {
        "episodes": [*zip(found["task_id"][:, 0].tolist(), found["episode"][:, 0].tolist(), strict=True)],
        "steps": steps,
        "moved": found["action"].abs().sum().item(),
    }


@pytest.mark.parametrize("backend", ["thread", pytest.param("process", marks=pytest.mark.slow)])
def test_it_runs_whole_episodes_of_each_task_with_the_weights_it_is_given(backend):
    options = {"num_trajectories": 4, "max_steps": 5, "frames_per_batch": 10, "metrics_fn": look}
    actor = make_actor()
    if backend == "thread":
        evaluator = Evaluator(make_push_reach(), make_actor(), collector_kwargs=OPTIONS, **options)
    else:
        options |= {"policy_factory": factory, "backend": backend, "collector_kwargs": {"traj_format": "padded"}}
        evaluator = Evaluator(make_push_reach, **options)
    first = evaluator.evaluate(actor)
    with torch.no_grad():
        for p in actor.parameters():
            p.zero_()
    assert evaluator.trigger_eval(actor)
    second = evaluator.wait(120)
    evaluator.shutdown()
    for found in (first, second):
        assert found["eval/num_episodes"] == 4
        assert found["eval/steps"] == found["eval/episode_length"] == 5
        assert len({task for task, _ in found["eval/episodes"]}) == 2
        assert len(set(found["eval/episodes"])) == 4
    assert first["eval/moved"] > 0
    assert second["eval/moved"] == 0
    assert not set(first["eval/episodes"]) & set(second["eval/episodes"]), (
        "other episodes each time, unlike lw.evaluate"
    )
