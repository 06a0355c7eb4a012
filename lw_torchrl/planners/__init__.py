"""Plans from language models: how they are asked for."""

from lw_torchrl.planners.prompts import plan_prompt, prompt_examples

__all__ = ["plan_prompt", "prompt_examples"]
