"""A policy for a robot without Python's help: queries and actor as one exported program, for any number of rows.

python examples/export_policy.py policy.safetensors policy.pt2
python examples/export_policy.py policy.safetensors policy.pt2 --aot   # compiled ahead of time, half a minute
"""

import argparse

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn

import lw_torchrl as lw
from lw_torchrl.modules import transform_of


class Deployed(nn.Module):
    """observation (B, 39) float32 and task_id (B,) int64 to the action (B, 4) float32."""

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor, self.reads = actor, transform_of(actor)

    def forward(self, observation: torch.Tensor, task_id: torch.Tensor) -> torch.Tensor:
        state = TensorDict({"observation": observation, "task_id": task_id}, [observation.shape[0]])
        return self.actor(state if self.reads is None else self.reads(state))["action"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="a file that lw-torchrl train wrote")
    parser.add_argument("program", help="where the program goes, .pt2")
    parser.add_argument("--aot", action="store_true", help="compile it with AOTInductor, which C++ can load")
    args = parser.parse_args()

    actor = lw.load_actor(args.policy)
    module = Deployed(actor).eval()
    task = lw.task_id(actor.tasks[0])
    example = torch.zeros(8, 39), torch.full((8,), task)
    rows = torch.export.Dim("rows", min=1, max=4096)
    with torch.no_grad():
        program = torch.export.export(module, example, dynamic_shapes={"observation": {0: rows}, "task_id": {0: rows}})
        if args.aot:
            torch._inductor.aoti_compile_and_package(program, package_path=args.program)
            run = torch._inductor.aoti_load_package(args.program)
        else:
            torch.export.save(program, args.program)
            run = torch.export.load(args.program).module()
        for number in (1, 7, 64):
            state = torch.rand(number, 39), torch.full((number,), task)
            away = (run(*state) - module(*state)).abs().max().item()
            print(f"{number:3} rows: at most {away:.1e} away from the policy in Python")
    print(f"{args.program}: {', '.join(actor.tasks)}")


if __name__ == "__main__":
    main()
