"""Episodes in a recording: logged data is read back exactly, and errors name the wrong column."""

import numpy as np
import pytest
import torch
from cases import read_cases
from recordings import PLAN, STEPS, Recording, make_objects, make_rollout, record

from lw_torchrl.language.outline import short_condition
from lw_torchrl.language.queries import parse_query
from lw_torchrl.record import RerunLogger
from lw_torchrl.record.page import EVENLY, NONE_HOLDS
from lw_torchrl.record.recorded_episode import NO_STEP, RecordedEpisode
from lw_torchrl.record.scene import ROBOT_EYE, name_offsets
from lw_torchrl.record.tabs import Tabs

ROWS = [f"/e1/{i}_" + short_condition(step.condition).replace(" ", "_") for i, step in enumerate(PLAN.steps, 1)]


def test_an_episode_is_read_back_exactly(tmp_path):
    rollout = make_rollout()
    recording = record(tmp_path / "a.rrd", rollout)
    points = {
        f"objects/{name}".replace("'", "\\'").replace(" ", "\\ "): at for name, at in make_objects(rollout).items()
    }
    for name, position in {**points, "goal": rollout["observation"][:, 36:39]}.items():
        shown = recording.array(f"/push/scene/{name}", "Points3D:positions")[:, 0]
        np.testing.assert_array_equal(shown, position.numpy())
    hand = recording.array("/push/scene/gripper", "Transform3D:translation")[:, 0]
    np.testing.assert_array_equal(hand, rollout["observation"][:, :3].numpy())
    curves = {"action": rollout["action"], "skill_weights": rollout["skill_weights"][:, :2]}
    for name, values in {**curves, "reward": rollout["next", "reward"]}.items():
        np.testing.assert_array_equal(recording.array(f"/push/{name}", "Scalars:scalars"), values.double())
    for i, row in enumerate(ROWS):
        assert recording.states(row, 20) == ["true" if held else "false" for held in rollout["qaf"][:, i]]
    assert recording.states("/e1/0_verdict", 20, first=1) == ["not yet"] * 10 + ["success"] * 10
    assert recording.times("/push/action", "Scalars:scalars") == list(range(20))
    assert recording.times("/push/reward", "Scalars:scalars") == list(range(1, 21))
    seconds = recording.times("/push/action", "Scalars:scalars", "time")
    assert [int(second) for second in seconds[:3]] == [0, 12_500_000, 25_000_000]
    lanes = {"0_verdict", "0b_plan_step", *(row[4:] for row in ROWS), "gripper"}
    assert {entity[4:] for entity in recording.entities() if entity.startswith("/e1/")} == lanes
    opening = ["open" if width > 0.75 else "closed" for width in rollout["observation"][:, 3].tolist()]
    assert recording.states("/e1/gripper", 20) == opening


def test_the_plan_follows_the_cursor(tmp_path):
    rollout = make_rollout()
    rollout["qaf"][:2, :2] = torch.tensor([[True, False], [False, True]])
    rollout["skill_weights"] = torch.softmax(rollout["qaf"] * 10.0 - 5.0, -1)
    rollout["skill_weights"][:, 2] = 0.0
    recording = record(tmp_path / "a.rrd", rollout)
    steps = recording.times("/push/plan", "TextDocument:text")
    texts = [row[0] for row in recording.values("/push/plan", "TextDocument:text")]
    qaf = rollout["qaf"][:, :2].tolist()
    # There is a text at each change, and nowhere else.
    assert steps == [t for t in range(20) if t == 0 or qaf[t] != qaf[t - 1]]
    head, indent = f"if {short_condition(PLAN.steps[0].condition)}", "\u2003\u2003"
    first, second = (f"{i}.  {skill}" for i, (_, skill) in enumerate(STEPS, 1))
    # The active step and the branches above it are bold.
    assert texts[0].split("  \n") == [f"**{head}**", f"{indent}**✓  → {first}**", "else", f"{indent}✗  {second}"]
    assert texts[1].split("  \n") == [head, f"{indent}✗  {first}", "**else**", f"{indent}**✓  → {second}**"]
    (full,) = recording.values("/push/conditions", "TextDocument:text")[0]
    assert full.startswith(f"1.  if {STEPS[0][0]}  \n{indent}{STEPS[0][1]}")


def test_the_active_step_has_a_lane(tmp_path):
    rollout = make_rollout()
    recording = record(tmp_path / "a.rrd", rollout)
    names = [f"{i} {skill}" for i, (_, skill) in enumerate(STEPS, 1)]
    assert recording.values("/push/skill_weights", "SeriesLines:names") == [names]
    states = Tabs.read(recording.reader).pages["push"].states
    assert [states[state][0] for state in ("0", "1", NONE_HOLDS, EVENLY)] == [*names, NONE_HOLDS, EVENLY]
    for row, state in enumerate(recording.states("/e1/0b_plan_step", 20)):
        weights, truth = rollout["skill_weights"][row, :2], rollout["qaf"][row, :2]
        even = EVENLY if truth.any() else NONE_HOLDS
        assert state == (even if weights[0] == weights[1] else str(int(weights.argmax())))
    rollout["skill_weights"] = torch.nn.functional.one_hot(torch.arange(20) % 2, 3).float()
    recording = record(tmp_path / "b.rrd", rollout)
    assert recording.states("/e1/0b_plan_step", 20) == ["0", "1"] * 10
    assert "/push/skill_weights" not in recording.entities(), "one-hot weights need no curve"


def test_wrong_answers_of_a_learned_evaluator_are_marked(tmp_path):
    rollout = make_rollout()
    rollout["qaf_logits"] = torch.where(rollout["qaf"], 3.0, -3.0)
    rollout["qaf_logits"][5:, 0] *= -1
    recording = record(tmp_path / "a.rrd", rollout)
    exact = ["true" if true else "false" for true in rollout["qaf"][:, 0]]
    wrong = {"true": "true, answered false", "false": "false, answered true"}
    assert recording.states(ROWS[0], 20) == exact[:5] + [wrong[true] for true in exact[5:]]
    texts = [row[0] for row in recording.values("/push/plan", "TextDocument:text")]
    steps = recording.times("/push/plan", "TextDocument:text")
    assert ["(evaluator:" in text for text in texts] == [step >= 5 for step in steps]


def test_fingers_follow_the_grippers_opening(tmp_path):
    rollout = make_rollout(2)
    rollout["observation"][:, 3] = torch.tensor([0.0, 1.0])
    centers = record(tmp_path / "a.rrd", rollout).array("/push/scene/gripper/fingers", "Boxes3D:centers")
    apart = centers[:, 0, 1] - centers[:, 1, 1]
    assert apart[1] - apart[0] == pytest.approx(0.1)


def test_missing_columns_are_left_out(tmp_path):
    rollout = make_rollout(5).select("observation", "action")
    rollout["observation"][:, 36:39] = 0.0
    recording = record(tmp_path / "a.rrd", rollout, plan=None, objects={})
    roots = {entity.split("/")[2] for entity in recording.entities() if entity.startswith("/push/")}
    assert roots == {"scene", "action", "verdict"}
    assert not any("goal" in entity for entity in recording.entities())
    gripper = recording.array("/push/scene/objects/robot\\'s\\ gripper", "Points3D:positions")[:, 0]
    np.testing.assert_array_equal(gripper, rollout["observation"][:, :3].numpy())


def test_without_a_plan_every_column_is_numbered(tmp_path):
    recording = record(tmp_path / "a.rrd", make_rollout(5), plan=None)
    assert recording.values("/push/skill_weights", "SeriesLines:names") == [["1", "2", "3"]]
    assert "/e1/3_condition" in recording.entities()
    rollout = make_rollout(5).exclude("skill_weights")
    rollout["qaf"] = torch.zeros(5, 3, dtype=torch.bool)
    recording = record(tmp_path / "b.rrd", rollout, plan=None)
    assert recording.values("/e1/0b_plan_step", "StateChange:state") == [[NONE_HOLDS], [""]]


def test_active_step_has_the_largest_weight_or_the_first_true_condition():
    rollout = make_rollout(3, columns=2)
    rollout["skill_weights"] = torch.tensor([[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]])
    assert RecordedEpisode.from_rollout(rollout, {}, PLAN).active.tolist() == [0, NO_STEP, 1]
    rollout["qaf"] = torch.tensor([[True, True], [False, True], [False, False]])
    without = RecordedEpisode.from_rollout(rollout.exclude("skill_weights"), {}, PLAN)
    assert without.active.tolist() == [0, 1, NO_STEP]
    assert RecordedEpisode.from_rollout(rollout.exclude("skill_weights", "qaf"), {}, PLAN).active is None


def test_episodes_have_different_names(tmp_path):
    rollouts = {None: make_rollout(5, seed=1), "best so far": make_rollout(7, seed=2)}
    with RerunLogger(tmp_path / "a.rrd") as logger:
        names = [logger.log_episode(each, task="push", objects={}, name=name) for name, each in rollouts.items()]
        for wrong in ("push", "metrics", " "):
            with pytest.raises(ValueError, match="name"):
                logger.log_episode(rollouts[None], task="push", objects={}, name=wrong)
    assert names == ["push", "best so far"]
    for root, rollout in zip(("/push", "/best\\ so\\ far"), rollouts.values(), strict=True):
        action = Recording(tmp_path / "a.rrd").array(f"{root}/action", "Scalars:scalars")
        np.testing.assert_array_equal(action, rollout["action"].double())


@pytest.mark.parametrize(("task", "text", "short"), read_cases("record/shortened.toml")["cases"])
def test_conditions_are_shortened(task, text, short):
    assert short_condition(parse_query(text, task)) == short
    assert short_condition("free-form text") == "free-form text"


def test_names_of_objects_at_one_position_do_not_overlap():
    place = np.full((5, 3), 0.1, np.float32)
    offsets = name_offsets({"puck": place, "goal": place, "wall": place + 0.5}, ROBOT_EYE)
    assert [name for name, offset in offsets.items() if offset.any()] == ["goal"]
    assert np.linalg.norm(offsets["goal"]) > 0.03


def test_the_policys_pictures_are_shown_next_to_the_scene(tmp_path):
    rollout = make_rollout()
    held = torch.arange(20) // 5  # a picture for five steps each
    rollout["pixels"] = (held * 60).to(torch.uint8)[:, None, None, None].expand(20, 32, 64, 3)
    recording = record(tmp_path / "a.rrd", rollout)
    assert recording.times("/push/seen", "EncodedImage:blob") == [0, 5, 10, 15]
    pictures = recording.images("/push/seen")
    assert [picture.shape for picture in pictures] == [(32, 64, 3)] * 4
    assert [round(float(picture.mean()), -1) for picture in pictures] == [0, 60, 120, 180]
    views = [value for (_, field), value in recording.blueprint().items() if field == "display_name"]
    assert ["Policy input"] in views
