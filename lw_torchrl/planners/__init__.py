"""Plans from language models: prompts, requests to a server, and answers.

:mod:`~lw_torchrl.planners.repairing` checks plans in the simulator and requests revised plans.
"""

from lw_torchrl.planners.answer_files import (
    Answer,
    Answers,
    FilePlanner,
    Planner,
    PlannerError,
    Tokens,
    answer_path,
    folder_name,
    write_answer,
)
from lw_torchrl.planners.openai_planner import OpenAIPlanner
from lw_torchrl.planners.prompts import plan_prompt, plan_schema, prompt_examples

__all__ = [
    "Answer", "Answers", "FilePlanner", "OpenAIPlanner", "Planner", "PlannerError", "Tokens", "answer_path",
    "folder_name", "plan_prompt", "plan_schema", "prompt_examples", "write_answer",
]  # fmt: skip
