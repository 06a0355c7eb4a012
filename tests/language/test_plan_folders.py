"""Folders of .plan files: saved whole or not at all, and loaded as they were."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_texts import DRAWER, HEAD, conditional_plans, plan

from lw_torchrl.language.plan_files import load_plans, save_plans
from lw_torchrl.language.plans import PlanError, Plans, parse_plan
from lw_torchrl.language.tasks import MT50


@settings(max_examples=25, deadline=None)
@given(st.sets(st.sampled_from(MT50), min_size=1, max_size=4).flatmap(
    lambda tasks: st.tuples(*(conditional_plans(task) for task in sorted(tasks)))
))  # fmt: skip
def test_saved_plans_load_as_the_same_plans(tmp_path_factory, given):
    folder = tmp_path_factory.mktemp("plans") / "new" / "folder"
    try:
        written = save_plans(Plans(given), folder)
    except UnicodeEncodeError:
        # A lone surrogate is no text of a file; nothing half-written stays.
        assert all(load_plans(path) for path in folder.iterdir())
        return
    assert [path.name for path in written] == [f"{plan.task}.plan" for plan in given]
    assert load_plans(folder) == Plans(given)
    assert load_plans(str(folder)) == Plans(given)
    assert load_plans(written[0]) == Plans(given[:1])


def test_saving_replaces_the_plans_it_names_alone(tmp_path):
    save_plans(Plans([plan(), parse_plan(DRAWER)]), tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    other = plan("push", ("gripper closed", "wait"))
    save_plans({"push": other}, tmp_path)
    assert load_plans(tmp_path) == {"push": other, "drawer-open": parse_plan(DRAWER)}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drawer-open.plan", "notes.txt", "push.plan"]


@pytest.mark.parametrize("wrong", [None, "push", [plan()], plan(), {"reach": plan()}, {}])
def test_saving_something_else_writes_nothing(tmp_path, wrong):
    with pytest.raises((TypeError, PlanError)):
        save_plans(wrong, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_missing_folder_or_file_says_what_there_is(tmp_path):
    for missing in (tmp_path / "absent", str(tmp_path / "absent.plan"), "MT5"):
        with pytest.raises(FileNotFoundError, match="'MT10' and 'MT50' name the shipped plans") as caught:
            load_plans(missing)
        assert str(missing) in str(caught.value)


def test_a_folder_without_plans_is_an_error(tmp_path):
    (tmp_path / "push.txt").write_text(HEAD)
    with pytest.raises(FileNotFoundError, match=r"holds no \.plan files"):
        load_plans(tmp_path)


def test_a_file_named_after_another_task_is_an_error(tmp_path):
    (tmp_path / "reach.plan").write_text(HEAD)
    with pytest.raises(PlanError, match=r"reach\.plan, line 1: this is a plan for 'push', expected one for 'reach'"):
        load_plans(tmp_path)


def test_a_file_of_another_name_is_for_the_task_that_its_plan_says(tmp_path):
    (tmp_path / "mine.plan").write_text(HEAD)
    assert list(load_plans(tmp_path / "mine.plan")) == list(load_plans(tmp_path)) == ["push"]
    (tmp_path / "push.plan").write_text(HEAD)
    with pytest.raises(PlanError, match=r"^push\.plan: a second plan for 'push'; mine\.plan holds one"):
        load_plans(tmp_path)


def test_one_bad_file_names_itself_and_its_line(tmp_path):
    save_plans(Plans([plan(), parse_plan(DRAWER)]), tmp_path)
    (tmp_path / "reach.plan").write_text(HEAD.replace("push(robot)", "reach(robot)").replace("is open", "is opne"))
    with pytest.raises(PlanError, match=r"^reach\.plan, line 2: .*at 'opne'"):
        load_plans(tmp_path)


@pytest.mark.parametrize("encode", [lambda t: t.encode("utf-8-sig"), lambda t: t.replace("\n", "\r\n").encode()])
def test_a_file_from_another_editor_loads(tmp_path, encode):
    (tmp_path / "push.plan").write_bytes(encode(HEAD))
    assert load_plans(tmp_path) == Plans([plan()])
