"""What is sent to a chat model: the prompt, and before it how to answer."""

from __future__ import annotations

from collections.abc import Mapping

from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.structured import write_structured
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.planners.prompts import plan_prompt, prompt_examples


def chat_messages(
    task: Task,
    format: str,
    *,
    plans: Plans | Mapping[str, ConditionalPlan] | None = None,
    vocabulary: bool = False,
    constrain: bool = False,
) -> list[dict[str, str]]:
    """The messages that ask for a plan.

    A prompt ends where a model that completes texts would go on; a chat model is told so by the system message.
    Where it is held to a schema, that shows the last example as JSON.

    Example:
        >>> from lw_torchrl.language.tasks import TASKS
        >>> [message["role"] for message in chat_messages(TASKS["drawer-open"], "chain_py")]
        ['system', 'user']
    """
    if constrain:
        example = prompt_examples(task, plans)[-1]
        how = (
            f"You write plans for a robot arm. Answer with the plan for `{task.name}` alone, as JSON. The plans that "
            f"you are shown are in another form; this is the one for `{example.task}` as JSON:\n"
            + write_structured(example, PLAN_FORMATS[format].style)
        )
    else:
        how = (
            f"You write plans for a robot arm. Answer with the plan for `{task.name}` alone, the whole of it, in the "
            "form of the plans that you are shown: no other tasks, and nothing before or after it."
        )
    prompt = plan_prompt(task, format, plans=plans, vocabulary=vocabulary)
    return [{"role": "system", "content": how}, {"role": "user", "content": prompt}]
