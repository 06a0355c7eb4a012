"""Deployment: queries and actor as one graph, compiled or exported, of any number of rows."""

import shutil

import pytest
import small_actors
import torch
from small_actors import ACTORS, PLANS
from tensordict import TensorDict
from torch import nn

import lw_torchrl as lw

pytestmark = pytest.mark.filterwarnings("ignore:.*Function.* should not be instantiated")  # by TorchRL's tanh
SHARED = [name for name in ACTORS if name not in ("one-hot", "fallback")]
NAMES = [name if name in ("plan", "scripted") else pytest.param(name, marks=pytest.mark.slow) for name in SHARED]
OURS = [each for name, each in zip(SHARED, NAMES, strict=True) if name != "evaluator"]  # a sequence of TorchRL's


class Deployed(nn.Module):
    """A policy with its queries, from observation and task to the action."""

    def __init__(self, actor):
        super().__init__()
        self.actor, self.queries = actor, lw.QAFTransform(lw.modules.plans_of(actor) or PLANS)

    def forward(self, observation, task_id):
        state = TensorDict({"observation": observation, "task_id": task_id}, [observation.shape[0]])
        return self.actor(self.queries(state))["action"]


def exported(module):
    rows = torch.export.Dim("rows", min=1, max=4096)
    return torch.export.export(module, make_rows(7), dynamic_shapes={"observation": {0: rows}, "task_id": {0: rows}})


def make_rows(rows):
    state = small_actors.make_rows(rows, seed=rows, answered=False)
    return state["observation"], state["task_id"]


@pytest.mark.parametrize("name", NAMES)
def test_exported_and_compiled_policy_gives_the_same_bits_for_any_number_of_rows(name):
    torch._dynamo.reset()  # all share one forward, which is compiled eight times at most
    module = Deployed(ACTORS[name]().eval())
    run = exported(module).module()
    compiled = torch.compile(module, fullgraph=True, backend="eager", dynamic=True)
    for number in (2, 7, 64):
        with torch.no_grad():
            expected = module(*make_rows(number))
            assert torch.equal(run(*make_rows(number)), expected), number
            assert torch.equal(compiled(*make_rows(number)), expected), number
    observation, ids = make_rows(7)
    with pytest.raises(RuntimeError, match="task_id contains tasks"):
        run(observation, torch.full_like(ids, lw.task_id("soccer")))


@pytest.mark.parametrize("name", OURS)
def test_bare_actor_is_exported_by_name_and_by_position(name):
    actor = ACTORS[name]().eval()
    queries = lw.QAFTransform(lw.modules.plans_of(actor) or PLANS)
    read = queries(TensorDict(dict(zip(("observation", "task_id"), make_rows(7), strict=True)), [7]))
    read = read.select(*actor.in_keys)
    written = actor(read.clone())
    by_name = torch.export.export(actor, args=(), kwargs=read.to_dict()).module()(**read.to_dict())
    tensors = tuple(read[key] for key in actor.in_keys)
    any_rows = (tuple({0: torch.export.Dim("rows")} for _ in tensors),)
    by_place = torch.export.export(actor, tensors, dynamic_shapes=any_rows).module()
    fewer = by_place(*(tensor[:3] for tensor in tensors))
    for output, rows in ((by_name, 7), (by_place(*tensors), 7), (fewer, 3)):
        output = output if isinstance(output, tuple) else (output,)
        expected = actor(read[:rows].clone()) if rows < 7 else written
        assert all(torch.equal(one, expected[key]) for one, key in zip(output, actor.out_keys, strict=True))


@pytest.mark.slow
@pytest.mark.skipif(not (shutil.which("c++") or shutil.which("g++")), reason="needs a C++ compiler")
@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning", "ignore:.*torch.jit:DeprecationWarning")  # PyTorch's own
@pytest.mark.parametrize("name", ["plan", "description"])
def test_ahead_of_time_compiled_policy_differs_only_by_rounding(name, tmp_path):
    """Compiled kernels are fused, so sums are made in another order: the last bits differ."""
    module = Deployed(ACTORS[name]().eval())
    with torch.no_grad():
        path = torch._inductor.aoti_compile_and_package(exported(module), package_path=str(tmp_path / "policy.pt2"))
        run = torch._inductor.aoti_load_package(path)
        for number in (1, 7, 64, 500):
            assert (run(*make_rows(number)) - module(*make_rows(number))).abs().max() <= 1e-6, number
    observation, ids = make_rows(7)
    for wrong in ("soccer", "basketball", "assembly"):
        with pytest.raises(RuntimeError):
            run(observation, torch.full_like(ids, lw.task_id(wrong)))
    observation[3, 5] = torch.nan
    with pytest.raises(RuntimeError):
        run(observation, ids)
