"""Plans from language models: how they are asked for, and who answers.

How answers fare needs the simulator: :mod:`~lw_torchrl.planners.checking`.
"""

from lw_torchrl.planners.answer_files import FilePlanner, Planner, answer_path, folder_name, write_answer
from lw_torchrl.planners.answers import Answer, Answers, PlannerError, Tokens
from lw_torchrl.planners.openai_planner import OpenAIPlanner
from lw_torchrl.planners.prompts import plan_prompt, plan_schema, prompt_examples

__all__ = [
    "Answer", "Answers", "FilePlanner", "OpenAIPlanner", "Planner", "PlannerError", "Tokens", "answer_path",
    "folder_name", "plan_prompt", "plan_schema", "prompt_examples", "write_answer",
]  # fmt: skip
