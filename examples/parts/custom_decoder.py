"""A custom decoder: any module that maps latent and features to an action. A saved policy contains the decoder."""

import torch

from lw_torchrl import PlanConditionedActor, load_actor, load_plans, save_actor


class Decoder(torch.nn.Sequential):
    def __init__(self, width: int = 64) -> None:
        super().__init__(torch.nn.LazyLinear(width), torch.nn.GELU(), torch.nn.Linear(width, 4), torch.nn.Tanh())
        self.config = {"width": width}  # arguments to rebuild the module from a file


save_actor(PlanConditionedActor(load_plans("MT10"), decoder=Decoder(width=32)), "custom_decoder.safetensors")
print(load_actor("custom_decoder.safetensors", parts=[Decoder]).decoder)
