"""Policies that act in a dataset, trained ones and any module or function; what is refused."""

from __future__ import annotations

import pytest
import torch
from collecting import PLANS, SEED, STEPS, collect, interrupt_after, same_rows, trained, tree
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase

import lw_torchrl as lw
from lw_torchrl.data import Behaviour, DatasetError
from lw_torchrl.data.collection_policy import policy_fingerprint
from lw_torchrl.data.dataset import load_rows, read_metadata
from lw_torchrl.modules.policy import with_plans


@pytest.mark.parametrize("kind", ["plan", "description"])
def test_a_policy_acts_as_in_an_evaluation(tmp_path, kind):
    actor = trained(kind).train()
    options = dict(noise_scale=0.1, gripper_noise_factor=1.0, noise_hold=1)
    made = collect(tmp_path / "demos", policy=actor, behaviour="tiny", num_envs=3, **options)
    assert actor.training, "it is left as it was"
    result = lw.evaluate(
        actor,
        tasks=("push", "reach"),
        episodes_per_task=3,
        seed=SEED,
        noise_scale=0.1,
        max_steps=STEPS,
        record_actions=True,
        progress=False,
    )
    rows = load_rows(made)
    for info, episode in zip(made.episodes, result.episodes, strict=True):
        assert (info.task, info.episode) == (episode.task, episode.episode)
        assert torch.equal(rows["action"][info.start : info.start + info.length], episode.actions)
    assert made.config.behaviour == "tiny"


def test_a_policy_with_a_distribution_acts_without_exploring(tmp_path):
    actor = trained().stochastic("tanh_normal").train()
    one = collect(tmp_path / "one", policy=actor, behaviour="tiny")
    torch.manual_seed(99)
    assert tree(collect(tmp_path / "other", policy=actor, behaviour="tiny", num_envs=2).root) == tree(one.root)
    still = collect(tmp_path / "still", policy=actor, behaviour="tiny", noise_scale=0.0)
    state = TensorDict({"observation": load_rows(still)["observation"][:64].clone()}, [64])
    state["task_id"] = load_rows(still)["task_id"][:64].clone()
    with torch.no_grad(), lw_deterministic():
        actor.eval()(lw.QAFTransform(PLANS)(state))
    assert torch.allclose(state["action"], load_rows(still)["action"][:64], atol=1e-5)


def lw_deterministic():
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    return set_exploration_type(ExplorationType.DETERMINISTIC)


def test_an_interrupted_collection_of_a_policy_goes_on_with_the_same_alone(tmp_path, monkeypatch):
    root, actor = tmp_path / "demos", trained()
    whole = collect(tmp_path / "whole", policy=actor, behaviour="tiny")
    with monkeypatch.context() as patch:
        interrupt_after(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            collect(root, policy=actor, behaviour="tiny", num_envs=2)
    before = tree(root)
    for other in (trained(seed=1), trained(squash=False)):
        with pytest.raises(DatasetError, match=r"another configuration \(policy.fingerprint \('\w+', now '\w+'\)"):
            collect(root, policy=other, behaviour="tiny")
    with torch.no_grad():
        next(actor.parameters()).add_(1e-3)
    with pytest.raises(DatasetError, match=r"policy.fingerprint"):
        collect(root, policy=actor, behaviour="tiny")
    with torch.no_grad():
        next(actor.parameters()).copy_(next(trained().parameters()))
    with pytest.raises(DatasetError, match=r"policy.name \('tiny', now 'other'\)"):
        collect(root, policy=actor, behaviour="other")
    assert tree(root) == before
    assert tree(collect(root, policy=actor, behaviour="tiny").root) == tree(whole.root)


def nan(policy):
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.fill_(torch.nan)
    return policy


class Odd(TensorDictModuleBase):
    """Writes another action than it should."""

    def __init__(self, wrong):
        super().__init__()
        self.wrong = wrong
        self.in_keys, self.out_keys = ["observation"], ["deed" if wrong == "key" else "action"]

    def forward(self, tensordict):
        dtype = torch.float64 if self.wrong == "dtype" else torch.float32
        action = tensordict["observation"][..., : 3 if self.wrong == "shape" else 4].to(dtype)
        return tensordict.set(self.out_keys[0], action)


@pytest.mark.parametrize(
    ("policy", "options", "error", "message"),
    [
        (trained(), dict(behaviour=None), ValueError, "behaviour must name the policy"),
        (trained(), dict(behaviour="noisy"), ValueError, "name 'noisy' is reserved"),
        ("random", dict(behaviour="expert"), ValueError, "name 'expert' is reserved"),
        (Behaviour("wrong", right=0.9), dict(behaviour=None), ValueError, "name 'wrong' is reserved"),
        (Behaviour("mine", "policy"), {}, ValueError, "give the policy itself"),
        ("raondm", {}, ValueError, "policy must be one of 'expert'.*did you mean 'random'"),
        (lambda state: state, {}, ValueError, "must write 'action'"),
        (lambda state: state, dict(behaviour=None), ValueError, "behaviour must name the policy"),
        (trained("description"), dict(tasks=("push", "drawer-open")), ValueError, "not made for drawer-open"),
        (nan(trained()), {}, ValueError, "NaN"),
        (Odd("key"), {}, ValueError, "must write 'action'"),
        (
            lambda state: state["observation"],
            {},
            TypeError,
            "must return the TensorDict that it is given, got a Tensor",
        ),
        (Odd("dtype"), {}, ValueError, "must be float32"),
        (Odd("shape"), {}, ValueError, r"must be float32 of shape \(2, 4\), got torch.float32 of shape \(2, 3\)"),
        (lw.ScriptedSkillActor(PLANS, "random"), {}, ValueError, "would depend on num_envs and on interruptions"),
        (lw.modules.ActorEnsemble([lw.ScriptedSkillActor(PLANS, "random")]), {}, ValueError, "draws in the order"),
    ],
)
def test_what_is_refused(tmp_path, policy, options, error, message):
    with pytest.raises(error, match=message):
        collect(tmp_path / "demos", policy=policy, num_envs=2, **{"behaviour": "mine", **options})
    assert not (tmp_path / "demos" / "metadata.json").exists()


def test_a_module_and_a_function_act_as_the_same_policy_does(tmp_path):
    """A TensorDictModule of any network, a function, and a module with plans, which is shown their answers."""

    class Scaled(torch.nn.Module):  # no sum of products, whose last bit may depend on the number of rows
        def __init__(self):
            super().__init__()
            self.weight = torch.nn.Parameter(torch.tensor([1.0, -2.0, 3.0, 0.5]))

        def forward(self, observation):
            return (observation[..., :4] * self.weight).clamp(-1.0, 1.0)

    network = Scaled()
    module = TensorDictModule(network, in_keys=["observation"], out_keys=["action"])

    def function(tensordict):
        return tensordict.set("action", network(tensordict["observation"]))

    by_module = collect(tmp_path / "module", policy=module, behaviour="mine")
    assert same_rows(by_module, collect(tmp_path / "function", policy=function, behaviour="mine", num_envs=2))
    rows = load_rows(by_module)
    torch.testing.assert_close(rows["unclipped_action"], network(rows["observation"]).detach())
    assert by_module.config.policy.fingerprint == policy_fingerprint(module)
    assert read_metadata(tmp_path / "function").config.policy == Behaviour("mine", "policy")
    network.weight.data *= 2
    with pytest.raises(DatasetError, match="another configuration"):
        collect(tmp_path / "module", policy=module, behaviour="mine")

    class Planned(TensorDictModule):
        plans = PLANS

    shown = lambda observation, qaf: observation[..., :4].tanh() * qaf[..., :1]  # noqa: E731
    planned = Planned(shown, in_keys=["observation", "qaf"], out_keys=["action"])
    made = collect(tmp_path / "planned", policy=planned, behaviour="planned")
    rows = lw.QAFTransform(PLANS)(load_rows(made).select("observation", "task_id", "expert_action").clone())
    torch.testing.assert_close(rows["expert_action"], rows["observation"][:, :4].tanh() * rows["qaf"][:, :1])


def test_a_fingerprint_is_of_all_that_a_policy_does():
    base = policy_fingerprint(trained())
    assert policy_fingerprint(trained()) == base
    others = [
        trained(seed=1),
        trained(squash=False),
        trained(features=lw.modules.ObservationFeatures("raw")),
        trained("description"),
    ]
    others.append(
        with_plans(trained(), {**PLANS, "reach": PLANS["reach"].__class__("reach", PLANS["reach"].steps[:1])})
    )
    others.append(trained(text_encoder=lambda texts: torch.randn(len(texts), 384, generator=torch.Generator())))
    found = [base, *map(policy_fingerprint, others)]
    assert len(set(found)) == len(found)
    assert policy_fingerprint(trained().bfloat16()) != base
