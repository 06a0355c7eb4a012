"""attribute_failures finds failures that do not recur, and distinguishes wrong observations from wrong actions."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from benchmarks import planted
from benchmarks.planted import Altered, Jammed, Sensor, fingers, moved_thing, scaled
from lw_torchrl.evaluation import attribute_failures
from lw_torchrl.evaluation.diagnose.failure import Finding
from lw_torchrl.evaluation.diagnose.reruns import difference

TASK, SEED = "drawer-open", 7
PLANS = lw.Plans({TASK: lw.load_plans("MT10")[TASK]})
RUN = {"seed": SEED, "max_steps": 70, "num_threads": 1, "progress": False}
RECORDED = ["observation", "task_id", "qaf", "skill_weights"]


def scripted():
    return lw.ScriptedSkillActor(PLANS)


def run(actor, **options):
    """Return a list of one episode."""
    episodes = []
    options = {"tasks": TASK, "also_record": RECORDED, "on_episode": episodes.append, **RUN, **options}
    lw.evaluate(actor, episodes_per_task=1, stop_at_success=True, **options)
    return episodes


def test_an_episode_that_was_cut_before_its_success_is_not_reproducible():
    [episode] = run(scripted())
    assert episode.first_success > 30
    [failure] = attribute_failures([episode._replace(steps=episode.steps[:30])], PLANS, actor=scripted(), **RUN)
    assert (failure.cause, failure.step, failure.counterfactuals) == ("not reproducible", None, {})
    assert failure.finding == Finding("other length", {"at": 29, "given": 30, "again": episode.first_success})
    assert failure.succeeds_at == episode.first_success
    assert f"the rollout has 30 steps, the re-run {episode.first_success}" in failure.why
    assert failure.shares["nothing"] == 1.0


@pytest.mark.parametrize("options", [{"evaluator": Jammed(1.0, 1.0, 0.1, 1.0)}, {"noise_scale": 1.0}])
def test_a_failure_by_another_environment_or_noise_is_not_reproducible(options):
    [failure] = attribute_failures(run(scripted(), **options), PLANS, actor=scripted(), **RUN)
    assert failure.cause == "not reproducible"
    assert (failure.finding.kind, failure.finding.values["at"]) == ("other actions", 0)
    assert failure.mended is None


def rollout(states, actions):
    steps = torch.tensor(states)[:, None].expand(-1, 39)
    return TensorDict(observation=steps, action=torch.tensor(actions)[:, None].expand(-1, 4), batch_size=[len(states)])


def test_the_first_difference_between_two_runs_is_found():
    again = rollout([0.0, 1.0, 2.0], [0.5, 0.5, 0.5])
    assert difference(again, again) is None
    assert difference(again[:2], again) == Finding("other length", {"at": 1, "given": 2, "again": 3})
    environment = difference(rollout([0.0, 1.0, 3.0], [0.5, 0.5, 0.5]), again)
    assert environment == Finding("other states", {"at": 2, "before": 1, "size": 1.0})
    actions = difference(rollout([0.0, 1.0, 3.0], [0.5, 0.2, 0.5]), again)
    assert (actions.kind, actions.values) == ("other actions", {"at": 1, "size": pytest.approx(0.3)})
    assert "the executed actions, from step 1 on, by 0.3 at that step" in actions.text
    states = difference(rollout([0.0, 3.0], [0.5, 0.5]).exclude("action"), again)
    assert states == Finding("unknown actions", {"at": 1})
    assert "holds no actions" in states.text


@pytest.mark.parametrize("inside", [True, False])
def test_a_wrong_observation_is_found(inside):
    actor = Altered(scripted(), shown=moved_thing(0.1, 0.0)) if inside else scripted()
    evaluator = None if inside else Sensor(PLANS, 0.1)
    [failure] = attribute_failures(run(actor, evaluator=evaluator), PLANS, actor=actor, evaluator=evaluator, **RUN)
    assert failure.cause == failure.mended.by == "perception"
    assert failure.counterfactuals["perception"] is True
    assert failure.finding.kind == "wrong observation"
    assert failure.finding.values["error"] == pytest.approx(0.1, abs=1e-3)
    assert "was off by up to 0.1" in failure.why
    assert not any(module._forward_pre_hooks for module in actor.modules()), "no hook stays on the policy"


@pytest.mark.parametrize(
    ("task", "done", "cause"),
    [
        ("push", fingers(-1.0), "gripper"),
        pytest.param("drawer-open", scaled(-1.0, 1.0, 1.0, 1.0), "actuation", marks=pytest.mark.slow),
        pytest.param("push", scaled(0.05, 0.05, 0.05, 0.0), "actuation", marks=pytest.mark.slow),
    ],
)
def test_the_wrong_part_of_the_action_is_found(task, done, cause):
    plans = lw.Plans({task: lw.load_plans("MT10")[task]})
    actor = Altered(lw.ScriptedSkillActor(plans), done=done)
    [failure] = attribute_failures(run(actor, tasks=task), plans, actor=actor, **RUN)
    assert failure.cause == cause
    assert "this fixes 100% of the task's failed episodes" in failure.why
    assert "a plain re-run 0%" in failure.why


def test_a_wrapper_that_is_a_function_is_seen():
    policy = scripted()

    def mirrored(tensordict):
        tensordict = policy(tensordict)
        return tensordict.set("action", tensordict["action"] * torch.tensor([-1.0, 1.0, 1.0, 1.0]))

    [failure] = attribute_failures(run(mirrored, plans=PLANS), PLANS, actor=mirrored, **RUN)
    assert (failure.cause, failure.replaced) == ("actuation", "wrapper")
    assert (failure.finding.kind, failure.finding.values["shape"]) == ("wrapped action", "scaled")


def test_a_simulator_that_executes_other_actions_is_found():
    simulator = Jammed(change=planted.turned(90.0))
    episodes = run(scripted(), evaluator=simulator)
    [failure] = attribute_failures(episodes, PLANS, actor=scripted(), evaluator=simulator, **RUN)
    assert (failure.cause, failure.replaced, failure.finding.kind) == ("actuation", "wrapper", "executed action")


@pytest.mark.parametrize("told", [False, True])
def test_other_physics_is_found(told):
    engine = planted.OtherPhysics(planted.slack)
    episodes = run(scripted(), engine=engine)
    [failure] = attribute_failures(episodes, PLANS, actor=scripted(), engine=engine if told else None, **RUN)
    assert (failure.cause, failure.replaced) == ("environment differs", "environment" if told else None)
    assert told or failure.finding.kind == "other first state"


def test_a_first_state_of_another_seed_is_another_environment():
    [episode] = run(scripted(), max_steps=20)
    [failure] = attribute_failures([episode], PLANS, actor=scripted(), **{**RUN, "seed": SEED + 1, "max_steps": 20})
    assert (failure.cause, failure.at) == ("environment differs", 0)
    assert "check that seed, suite and engine are those of the rollout" in failure.why


@pytest.mark.slow
def test_noise_is_blamed_for_what_noise_does():
    [failure] = attribute_failures(run(scripted(), noise_scale=1.0), PLANS, actor=scripted(), **RUN, noise_scale=1.0)
    assert (failure.cause, failure.counterfactuals["no noise"]) == ("noise", True)


def test_a_failure_of_a_policy_without_plans_has_no_step():
    torch.manual_seed(0)
    decoder = lw.modules.MLPDecoder(width=8, depth=1)
    actor = lw.modules.DescriptorConditionedActor(TASK, condition="one-hot", decoder=decoder)
    [failure] = attribute_failures(run(actor, plans=PLANS, also_record=RECORDED[:3]), PLANS, actor=actor, **RUN)
    assert failure.cause in ("actuation", "policy")
    assert failure.step is None
    assert "skill" not in failure.counterfactuals
    assert failure.finding is None or "step" not in failure.finding.values
