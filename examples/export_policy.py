"""Export a policy to run it without Python: condition checks and actor become one program for any batch size.

python examples/export_policy.py policy.safetensors policy.pt2
python examples/export_policy.py policy.safetensors policy.pt2 --aot   # compile ahead of time, in half a minute
"""

import argparse

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn

import lw_torchrl as lw
from lw_torchrl.modules import transform_of


class Deployed(nn.Module):
    """A module that maps observation (B, 39) float32 and task_id (B,) int64 to the action (B, 4) float32."""

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor, self.reads = actor, transform_of(actor)

    def forward(self, observation: torch.Tensor, task_id: torch.Tensor) -> torch.Tensor:
        state = TensorDict({"observation": observation, "task_id": task_id}, [observation.shape[0]])
        return self.actor(state if self.reads is None else self.reads(state))["action"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="policy file, written by lw-torchrl train")
    parser.add_argument("program", help="file to write the program to, .pt2")
    parser.add_argument("--aot", action="store_true", help="compile the program with AOTInductor, for use in C++")
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
            print(f"{number:3} rows: actions differ by at most {away:.1e} from the policy in Python")
    print(f"{args.program}: {', '.join(actor.tasks)}")


if __name__ == "__main__":
    main()
