"""QueryProgram exported, compiled and under vmap answers as it does in eager mode."""

import shutil

import pytest
import torch
from states import all_tasks, random_states
from tensordict import TensorDict

from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.tasks import task_id


class Asked(torch.nn.Module):
    """A module, since that is what can be exported."""

    def __init__(self, program):
        super().__init__()
        self.program = program

    def forward(self, states, ids):
        return self.program(states, ids), self.program.logits(states, ids)


def agrees_with_eager(asked, program, states, ids):
    truth, logits = asked(states, ids)
    assert torch.equal(truth, program(states, ids))
    assert torch.equal(logits > 0, truth)
    torch.testing.assert_close(logits, program.logits(states, ids), atol=1e-4, rtol=1e-5)
    with pytest.raises(RuntimeError, match="tasks without queries"):
        asked(states, torch.full_like(ids, 50))
    with pytest.raises(RuntimeError, match="finite numbers"):
        asked(states / 0.0, ids)


def test_an_exported_program_answers_and_the_eager_one_still_does():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    exported = torch.export.export(Asked(program), (states, ids)).module()
    agrees_with_eager(exported, program, states, ids)
    fresh = QueryProgram(queries)
    assert torch.equal(fresh(states, ids), program(states, ids))


def test_a_compiled_program_answers_as_the_eager_one():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    agrees_with_eager(torch.compile(Asked(program), fullgraph=True, backend="aot_eager"), program, states, ids)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
@pytest.mark.filterwarnings("ignore:.*script_method. is deprecated:DeprecationWarning")
def test_inductor_answers_on_the_thresholds_too():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    states = states.clone()
    states[::3, 3] = 0.75
    states[::3, 4:7] = states[::3, 0:3]
    states[::3, 4] -= 0.04
    agrees_with_eager(torch.compile(Asked(program), fullgraph=True), program, states, ids)


@pytest.mark.parametrize("soft", [False, True])
def test_an_ensemble_may_have_tables_for_each_member(soft):
    program = QueryProgram({"push": ["gripper near puck", "gripper open"]})
    states = torch.from_numpy(random_states("push", n=20))
    ids = torch.full((20,), task_id("push"))
    members = TensorDict.from_modules(program, QueryProgram(program.queries), as_module=True)

    def ask(member):
        with member.to_module(program):
            return program.logits(states, ids) if soft else program(states, ids)

    answers = torch.vmap(ask)(members)
    expected = program.logits(states, ids) if soft else program(states, ids)
    assert torch.equal(answers, expected.expand(2, 20, 2))


def test_each_state_by_vmap_answers_as_the_batch():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    assert torch.equal(torch.vmap(program)(states[:50], ids[:50]), program(states[:50], ids[:50]))
    slopes = torch.func.grad(lambda given: program.logits(given, ids[:50]).sum())(states[:50])
    given = states[:50].clone().requires_grad_()
    program.logits(given, ids[:50]).sum().backward()
    assert torch.equal(slopes, given.grad)
