"""Tables of tasks, skills and suites can be sent to another process, and cannot be changed."""

import pickle

import pytest

import lw_torchrl as lw
from lw_torchrl.language.skills import load_skills
from lw_torchrl.suites import load_suite

TABLES = {
    "tasks": lambda: lw.TASKS,
    "skills": load_skills,
    "tasks of a suite": lambda: load_suite("fetch").tasks,
    "skills of a suite": lambda: load_suite("metaworld").skills,
}


@pytest.mark.parametrize("name", TABLES)
def test_tasks_are_pickled_and_read_only(name):
    table = TABLES[name]()
    assert pickle.loads(pickle.dumps(table)) == table
    with pytest.raises(TypeError, match="does not support item assignment"):
        table["new"] = table[min(table)]


@pytest.mark.parametrize("name", ["metaworld", "fetch"])
def test_suite_is_pickled(name):
    suite = load_suite(name)
    sent = pickle.loads(pickle.dumps(suite))
    assert (sent.tasks, sent.skills, sent.layout) == (suite.tasks, suite.skills, suite.layout)
    assert sent.plans.fingerprint == suite.plans.fingerprint
