"""attribute_failures finds planted faults, and reports undecided causes as undecided."""

import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

import lw_torchrl as lw
from lw_torchrl.evaluation import attribute_failures
from lw_torchrl.evaluation.diagnose.attribution import decide
from lw_torchrl.evaluation.diagnose.failure import Finding
from lw_torchrl.evaluation.diagnose.replacements import Control, Scripts, attended, chosen
from lw_torchrl.evaluation.diagnose.states import Motion, last_stay_start, stall_step
from lw_torchrl.record.rollouts import simulate_again
from lw_torchrl.transforms.qaf import plan_program

TASK, SEED, STEPS = "drawer-open", 7, 70
PLANS = lw.Plans({TASK: lw.load_plans("MT10")[TASK]})
PROGRAM = plan_program(PLANS)
PAIRS = [(str(step.condition), step.skill) for step in PLANS[TASK].steps]
ALIGNED = "almost vertically aligned with the drawer handle"
NEAR = "near the drawer handle"
CONDITIONS = (f"gripper is not {ALIGNED}", f"gripper is {ALIGNED} and gripper is not {NEAR}", f"gripper is {NEAR}")
REFERENCE = {TASK: lw.ConditionalPlan.from_pairs(TASK, [*zip(CONDITIONS, [skill for _, skill in PAIRS], strict=True)])}
DECISIONS = tomllib.loads(Path(__file__).with_name("decisions.toml").read_text("utf-8"))
RUN = {"seed": SEED, "max_steps": STEPS, "progress": False, "num_threads": 1}


def evaluated(actor, episodes=1, **options):
    how = {"tasks": TASK, "stop_at_success": True, "attribute": True, **RUN, **options}
    return lw.evaluate(actor, episodes_per_task=episodes, **how)


def faulty_skill(step=1):
    table = dict(lw.load_skills())
    text = PLANS[TASK].steps[step].skill
    x, y, z = table[text].offset
    table[text] = replace(table[text], offset=(x + 0.1, y, z))
    return lw.ScriptedSkillActor(PLANS, skills=table)


def faulty_plans():
    """A plan that never goes down to the handle."""
    return plans_of([PAIRS[0], (PAIRS[1][0], PAIRS[0][1]), PAIRS[2]])


def plans_of(pairs):
    return lw.Plans({TASK: lw.ConditionalPlan.from_pairs(TASK, pairs)})


def wrong_answers(tensordict):
    answers = tensordict.get("qaf").clone()
    answers[..., 1] ^= True
    return tensordict.set("qaf", answers)


class WrongEvaluator(lw.QueryEvaluator):
    """The same wrong answers, by an evaluator inside a policy."""

    def logits(self, observation, task_id):
        answers = PROGRAM(observation, task_id)
        answers[..., 1] ^= True
        return 10.0 * answers.float() - 5.0


@pytest.fixture(scope="module")
def skill_failures():
    """The failures of two episodes, run together."""
    return evaluated(faulty_skill(), episodes=2, reference=REFERENCE).failures


@pytest.fixture(scope="module")
def plan_failure():
    [failure] = evaluated(lw.ScriptedSkillActor(faulty_plans()), reference=REFERENCE).failures
    return failure


def test_a_faulty_skill_is_found_with_its_step(skill_failures):
    failure = skill_failures[0]
    assert (failure.cause, failure.also, failure.step) == ("skill", None, 1)
    assert failure.counterfactuals == {"no noise": False, "policy": True, "skill": True}
    skill = "lower the gripper around the drawer handle"
    assert (failure.finding.kind, failure.finding.values["skill"]) == ("distant step", skill)
    assert "step 2, 'lower the gripper around the drawer handle', was active" in failure.why.lower()
    assert failure.replaced == "skill"
    assert failure.shares == {"nothing": 0.0, "no noise": 0.0, "policy": 1.0, "skill": 1.0}
    assert 0 <= failure.at < STEPS


class Weak(lw.ScriptedSkillActor):
    """A policy whose hand hardly rises or sinks, in all steps or in one."""

    def __init__(self, plans, step=None):
        super().__init__(plans)
        self.step = step

    def forward(self, tensordict):
        action = super().forward(tensordict).get("action").clone()
        weak = True if self.step is None else tensordict.get("skill_weights")[:, self.step] > 0.5
        action[:, 2] = torch.where(torch.as_tensor(weak), 0.05 * action[:, 2], action[:, 2])
        return tensordict.set("action", action)

    def with_plans(self, plans):
        return Weak(plans, self.step)


@pytest.mark.parametrize(("step", "cause"), [(None, "actuation"), (1, "skill")])
def test_a_motion_that_is_wrong_in_all_steps_is_not_a_skills_fault(step, cause):
    """Only one step moves far on that axis, so a script in that step repairs either fault."""
    plans = lw.Plans({"plate-slide-side": lw.load_plans("MT50")["plate-slide-side"]})
    [failure] = evaluated(Weak(plans, step), tasks="plate-slide-side").failures
    assert failure.cause == cause
    assert failure.counterfactuals[cause] is True
    assert failure.finding.kind == ("policy's action" if step is None else "distant step")


def motion(fault, steps=(0, 1), spread=0.05):
    """Return 60 states of a policy that acts as ``fault`` of the right action in the given plan steps."""
    wanted = torch.randn(60, 3, generator=torch.Generator().manual_seed(0)).clamp(-1.0, 1.0)
    noise = spread * torch.randn(60, 3, generator=torch.Generator().manual_seed(1))
    active = (torch.arange(60) >= 30).long()
    here = torch.isin(active, torch.tensor(steps)).unsqueeze(-1)
    return Motion(wanted, torch.where(here, fault(wanted), wanted) + noise, active)


FAULTY = {
    "scaled": lambda action: action * torch.tensor([-1.0, 1.0, 1.0]),
    "shifted": lambda action: action + torch.tensor([0.0, 0.4, 0.0]),
    "constant": torch.zeros_like,
    "delayed by 3": lambda action: torch.cat((action[:1].expand(3, -1), action[:-3])),
    "turned": lambda action: action.roll(1, 1),
}


@pytest.mark.parametrize("shape", FAULTY)
@pytest.mark.parametrize("spread", [0.0, 0.05])
def test_the_shape_of_a_fault_and_the_steps_that_have_it_are_measured(shape, spread):
    in_all = motion(FAULTY[shape], spread=spread)
    in_one = motion(FAULTY[shape], steps=(1,), spread=spread)
    assert (in_all.extent()[::2], in_one.extent()) == ((True, shape), (False, 1, shape))
    if not spread:
        assert in_all.extent(exact=True)[0] is True
        assert in_one.extent(exact=True) == (False, 1, shape)


def test_a_fault_that_would_not_show_elsewhere_may_be_in_all_steps():
    wanted = torch.rand(60, 1) + 0.2
    wanted[30:] = 0.0
    assert Motion(wanted, -wanted, (torch.arange(60) >= 30).long()).extent() == (None, 0, "scaled")
    assert Motion(wanted, -wanted, torch.zeros(60)).extent()[0] is None, "there are no other steps"
    assert Motion(wanted[:3], wanted[:3], torch.zeros(3)).extent()[0] is None, "too few states"


def test_noise_is_told_from_a_fault():
    """Noise has no shape, and its error is the same in all plan steps."""
    generator = torch.Generator().manual_seed(2)
    assert motion(lambda action: action + torch.randn(60, 3, generator=generator)).extent()[2] == "irregular"


def test_a_faulty_plan_is_found_with_its_step(plan_failure):
    failure = plan_failure
    assert (failure.cause, failure.step) == ("plan", 1)
    assert failure.counterfactuals == {"no noise": False, "plan": True}  # its skills are the scripts: none is replaced
    assert (failure.finding.kind, failure.finding.values["step"]) == ("plan departs", 1)
    assert failure.finding.values["states"] > 0.5 * failure.finding.values["of"]


def test_wrong_answers_are_found_with_their_condition():
    [failure] = evaluated(lw.ScriptedSkillActor(PLANS), evaluator=wrong_answers, reference=REFERENCE).failures
    assert (failure.cause, failure.step) == ("query", 1)
    assert failure.counterfactuals["query"] is True
    condition = str(PLANS[TASK].steps[1].condition)
    values = {"step": 1, "condition": condition, "states": STEPS, "of": STEPS, "first": 0}
    assert failure.finding == Finding("wrong answers", values)
    assert failure.why.startswith(f"'{condition}' (step 2) was answered wrongly in {STEPS} of {STEPS} states")
    assert failure.evidence["answers_wrong"] == 1.0


def test_two_faults_at_once_are_both_found():
    [failure] = evaluated(faulty_skill(), evaluator=wrong_answers).failures
    assert (failure.cause, failure.also) == ("query", "skill")
    assert failure.counterfactuals == {"query": False, "query + skill": True}, "the answers are a cause for certain"
    assert "With the true answers the episode fails, and with scripted skills as well it succeeds" in failure.why


def test_an_episode_that_lacks_only_time_is_out_of_time():
    [failure] = evaluated(lw.ScriptedSkillActor(PLANS), max_steps=45).failures
    assert (failure.cause, failure.counterfactuals["time"], failure.at) == ("out of time", True, 44)


def test_an_episode_that_no_replacement_repairs_is_undecided():
    [failure] = evaluated(lw.ScriptedSkillActor(faulty_plans())).failures
    tried = {"no noise": False, "time": False}
    assert (failure.cause, failure.also, failure.counterfactuals) == ("undecided", None, tried)
    assert failure.mended is None


def test_a_gap_in_the_plan_is_not_a_skills_fault():
    """Where no condition holds, networks attend to all steps: scripts instead of them would hide the gap."""
    [failure] = evaluated(still(plans_of(PAIRS[1:]))).failures
    assert (failure.cause, failure.evidence["no_condition_late"]) == ("undecided", 1.0)


class Still(lw.PlanConditionedActor):
    """A policy whose hand does not move."""

    def forward(self, tensordict):
        tensordict = super().forward(tensordict)
        return tensordict.set("action", torch.zeros_like(tensordict["action"]))


def still(plans=PLANS, **options):
    torch.manual_seed(0)
    return Still(plans, decoder=lw.modules.MLPDecoder(width=8, depth=1), **options)


ENSEMBLE = pytest.param(lambda actor: lw.modules.ActorEnsemble([actor, still()]), marks=pytest.mark.slow)


@pytest.mark.parametrize("wrapped", [lambda actor: actor, ENSEMBLE])
def test_a_networks_skills_are_replaced_and_its_mode_stays(wrapped):
    actor = wrapped(still()).train()
    actor.get_submodule(next(name for name, _ in actor.named_modules() if name)).eval()
    modes = [module.training for module in actor.modules()]
    [failure] = evaluated(actor).failures
    tried = {"no noise": False, "policy": True, "gripper": False, "actuation": True}
    assert (failure.cause, failure.counterfactuals) == ("actuation", tried), "its hand rests in every step"
    assert [module.training for module in actor.modules()] == modes


@pytest.mark.parametrize(("is_canonical", "max_steps"), [(False, 100), (True, 80)])
def test_a_plan_that_is_not_understood_is_never_called_sound(is_canonical, max_steps):
    pairs = [("gripper is not near the drawer handle", "dance a waltz"), ("gripper is near the drawer handle", "bow")]
    plans = lw.canonical_plans(plans_of(pairs)) if is_canonical else plans_of(pairs)
    actor = still(plans, text_encoder=lambda texts: torch.ones(len(texts), 3))
    [failure] = evaluated(actor, max_steps=max_steps).failures
    assert failure.succeeds_at is not None
    assert "(Meta-World's expert in 2 steps without a scripted skill) the same episode succeeds" in failure.why
    unsound = ", and the expert does not follow the plan, so this does not show that the plan is sound"
    ending = "; the generic plan succeeds" if is_canonical else unsound
    assert failure.why.endswith(f" The plan's steps are not understood{ending}.")


def test_an_evaluator_inside_a_policy_is_replaced_by_exact_answers():
    actor = TensorDictSequential(WrongEvaluator(PLANS), still())
    state = lw.QAFTransform(PLANS)(rollout().exclude("next"))
    state["true_observation"] = state["observation"].clone()
    exact = lw.PlanConditionedActor(PLANS)(state.copy())["skill_weights"]
    control = {answer: Control(actor, Scripts(PLANS, {}), answer=answer)(state.copy()) for answer in (True, False)}
    assert torch.allclose(control[True]["skill_weights"], exact)
    assert not torch.allclose(control[False]["skill_weights"], exact)
    assert torch.equal(control[True]["measured", "answered"], state["qaf"].float())
    assert not torch.equal(control[False]["measured", "answered"] > 0.5, state["qaf"])
    [failure] = evaluated(actor).failures
    assert (failure.cause, failure.also) == ("query", "skill")


def test_a_policy_that_cannot_follow_the_reference_causes_a_warning():
    class Fixed(lw.ScriptedSkillActor):
        def with_plans(self, plans):
            raise ValueError("the plans are fixed")

    with pytest.warns(UserWarning, match="the policy cannot follow the reference.*the plans are fixed"):
        [failure] = evaluated(Fixed(faulty_plans()), reference=REFERENCE, max_steps=20).failures
    assert "plan" not in failure.counterfactuals


class Completing(lw.ScriptedSkillActor):
    """A policy that adds a step to each plan that it is given."""

    def with_plans(self, plans):
        pairs = [(str(step.condition), step.skill) for step in lw.Plans(plans)[TASK].steps]
        return Completing(plans_of([*pairs, pairs[0]]), skills=self._skills)


def test_a_policy_may_complete_the_reference():
    [failure] = evaluated(Completing(faulty_plans(), skills=faulty_skill(step=2)._skills), reference=REFERENCE).failures
    assert {failure.cause, failure.also} == {"plan", "skill"}
    assert len(failure.mended.plan.steps) == failure.mended.steps["skill_weights"].shape[1] == 4


def test_failures_do_not_depend_on_the_number_of_environments(skill_failures):
    assert evaluated(faulty_skill(), episodes=2, reference=REFERENCE, num_envs=1).failures == skill_failures
    assert [failure.episode for failure in skill_failures] == [0, 1]


@pytest.mark.parametrize("name", DECISIONS)
def test_the_replacement_that_fixes_most_decides(name):
    cause, shares = DECISIONS[name]
    assert decide([name for name in shares if name != "nothing"], {"nothing": 0.0, **shares})[0] == cause


def test_two_parts_are_blamed_if_only_both_help():
    assert decide(["query + skill", "plan + skill"], {}) == ("query", "skill", "query + skill")
    assert decide(["time", "plan + skill"], {}) == ("out of time", None, "time")


def test_the_active_step_has_most_attention():
    weights = torch.tensor([[0.4999, 0.5, 0.0001], [1 / 3] * 3, [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]])
    assert attended(weights, torch.arange(3) < torch.tensor([[3], [3], [2], [1]])).tolist() == [1, -1, -1, 0]
    answers = torch.tensor([[False, True, True], [False, False, False], [False, False, True]])
    assert chosen(answers, 3).tolist() == [1, 2, 2]


def test_a_step_stalls_where_the_hand_stands_still():
    observation = torch.zeros(60, 39)
    observation[:, 0] = torch.cat((torch.arange(25) * 0.02, torch.full((35,), 0.5)))  # at rest from state 25 on
    active = torch.cat((torch.zeros(20), torch.ones(40))).long()
    plain = SimpleNamespace(steps=TensorDict(observation=observation, batch_size=[60]))
    seen = SimpleNamespace(active=active, plan=PLANS[TASK], plain=plain)
    assert stall_step(seen, 1) == 25
    assert stall_step(seen, 0) == 0, "it moves all the time"


def test_a_stay_may_be_interrupted_briefly():
    states = torch.zeros(100, dtype=torch.bool)
    states[[3, 40, 60, 61, 80]] = True
    assert (last_stay_start(states), last_stay_start(torch.zeros(5, dtype=torch.bool))) == (40, 4)


def rollout(steps=3, **changed):
    ids = {"task_id": torch.full((steps,), lw.task_id(TASK)), "episode": torch.zeros(steps, dtype=torch.int64)}
    success = {"success": torch.zeros(steps, 1, dtype=torch.bool)}
    rollout = TensorDict({"observation": torch.zeros(steps, 39), **ids, "next": success}, [steps])
    for key, value in changed.items():
        rollout = rollout.exclude(key) if value is None else rollout.set(key, value)
    return rollout


@pytest.mark.parametrize(
    ("rollouts", "message"),
    [
        ([rollout(observation=None)], "observation"),
        ([rollout(episode=None)], "episode"),
        ([rollout(episode=torch.tensor([0, 0, 1]))], r"rollouts\[0\] must hold one episode"),
        ([rollout(task_id=torch.zeros(3, dtype=torch.int64))], r"rollouts\[0\] must hold one episode of"),
        ([rollout(), rollout()], r"rollouts\[1\] repeats episode 0"),
        ([rollout()[0]], r"rollouts\[0\] must be a finished episode"),
    ],
)
def test_wrong_rollouts_are_refused(rollouts, message):
    with pytest.raises(ValueError, match=message):
        attribute_failures(rollouts, PLANS, actor=faulty_skill(), seed=0)


def test_without_failed_episodes_there_are_no_failures():
    assert attribute_failures([], PLANS, actor=faulty_skill(), seed=0) == []
    result = evaluated(lw.ScriptedSkillActor(PLANS))
    assert (result.failures, result.success_once) == ((), {TASK: 1.0})


def test_the_repaired_episode_is_kept_and_can_be_simulated_again(plan_failure):
    mended = plan_failure.mended
    assert (mended.by, mended.plan) == ("plan", REFERENCE[TASK])
    success = mended.steps["next", "success"].flatten().tolist()
    assert success == [False] * (len(success) - 1) + [True]
    assert mended.steps["qaf"].shape == mended.steps["skill_weights"].shape == (len(success), 3)
    shown = [mended.steps[key].numpy() for key in ("action", "observation")]
    assert simulate_again(TASK, SEED, 0, *shown) is not None, "bit for bit"
    assert "mended" not in plan_failure.to_json()


def test_plans_with_memory_are_diagnosed():
    first, skill = PAIRS[0]
    plans = plans_of([(f"not once ({first})", skill), (f"once ({first})", skill)])
    [failure] = evaluated(lw.ScriptedSkillActor(plans)).failures
    assert failure.evidence["answers_wrong"] == 0.0  # the latches are those of the episode
    assert failure.evidence["no_condition_late"] == 0.0
