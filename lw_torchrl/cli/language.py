"""Commands about words: tasks, skills, plans and queries are listed, and a query is answered in a state."""

from collections.abc import Iterable
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._checks import check_int, counted
from lw_torchrl.cli import options
from lw_torchrl.cli.output import Columns, Output, Row
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.nearest import nearest_query, nearest_skill
from lw_torchrl.language.tasks import check_task, resolve_tasks


def tasks(
    names: Positional[options.Names] = (),  # MT10, MT50, or names of tasks; all there are if none is given
    /,
    task_file: options.TaskFile = None,
    json: options.Json = False,
) -> Output:
    """List tasks: their descriptions, and the objects that queries can name.

    Example: lw-torchrl tasks MT10
    """
    known = options.read_tasks(task_file, names)
    rows = [
        {"task": name, "mt10": name in lw.MT10, "description": known[name].description}
        | {"objects": [{"name": one.name, "ours": one.ours} for one in known[name].objects[1:]]}
        for name in resolve_tasks(options.one_or_many(names) or list(known), tasks=known)
    ]

    def objects(row: Row) -> str:
        return ", ".join(one["name"] + (" (ours)" if one["ours"] else "") for one in row["objects"])

    columns: Columns = {"task": "task", "MT10": "mt10", "description": "description"}
    columns = {**columns, "objects beside the gripper": objects}
    return Output(json).table("tasks", rows, columns, counted(len(rows), "task"))


def skills(
    task: Positional[Annotated[str | None, arg(metavar="[TASK]")]] = None,  # only those that this task can use
    /,
    nearest: str | None = None,  # a text; the closest skill is shown
    skill_file: options.SkillFile = None,
    task_file: options.TaskFile = None,
    json: options.Json = False,
) -> Output:
    """List the scripted skills, or find the one closest to a text.

    Example: lw-torchrl skills push --nearest "grab the puck"
    """
    known = options.read_tasks(task_file, () if task is None else (task,))
    table = options.read_skills(skill_file, known)
    definition = None if task is None else known[check_task(task, known)]
    output = Output(json)
    if nearest is not None:
        skill, score = nearest_skill(nearest, definition, table)
        found = {"skill": skill.text, "similarity": score}
        return output.show("nearest", found, f"{skill.text}   (similarity {score:.2f})")
    rows = []
    for skill in table.values():
        if definition is not None and not skill.suits(definition):
            continue
        shown = skill if definition is None else skill.for_task(definition)
        numbers = {"offset": shown.offset, "gain": shown.gain, "gripper": shown.gripper}
        rows.append({"skill": skill.text, "target": shown.target, "moved": shown.moved, **numbers})
    columns: Columns = {
        "skill": "skill",
        "target": "target",
        "moved": lambda row: "" if row["moved"] == GRIPPER else row["moved"],
        "offset, m": lambda row: _numbers(row["offset"]),
        "gain": lambda row: _numbers(row["gain"][:1] if len({*row["gain"]}) == 1 else row["gain"]),
        "gripper": lambda row: f"{row['gripper']:g}",
    }
    return output.table("skills", rows, columns, counted(len(rows), "scripted skill"))


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:g}" for value in values)


def plans(
    names: Positional[options.Names] = (),  # MT10, MT50, or names of tasks
    /,
    plans: options.PlanSources = ("MT50",),
    skill_set: Literal["own", "MT10"] = "own",  # of shipped plans: with scripted skills of their own, or MT10's words
    task_file: options.TaskFile = None,
    json: options.Json = False,
) -> Output:
    """Show plans: the whole text of those named, or a list of all.

    Example: lw-torchrl plans drawer-open
    """
    known = options.read_tasks(task_file, names)
    loaded = options.read_plans(plans, known, skill_set)
    chosen = resolve_tasks(options.one_or_many(names), tasks=known) if names else tuple(loaded)
    loaded.require(chosen)
    output = Output(json)
    rows: list[dict[str, Any]] = []
    for name in chosen:
        steps = [{"condition": str(step.condition), "skill": step.skill} for step in loaded[name].steps]
        rows.append({"task": name, "steps": steps, "text": str(loaded[name])})
    if names:
        return output.show("plans", rows, "\n".join(row["text"] for row in rows))
    columns: Columns = {
        "task": "task",
        "steps": lambda row: len(row["steps"]),
        "skills": lambda row: "; ".join(dict.fromkeys(step["skill"] for step in row["steps"])),
    }
    return output.table("plans", rows, columns, counted(len(rows), "plan"))


def queries(
    task: Positional[Annotated[str, arg(metavar="TASK")]],  # a task's name
    text: Positional[options.Text] = None,  # any words; what the query answering function makes of them is shown
    /,
    by: Literal["edit", "embedding"] = "edit",  # closest in spelling, or in meaning, which wants the extra [text]
    task_file: options.TaskFile = None,
    json: options.Json = False,
) -> Output:
    """List a task's base queries, or find the one closest to a text.

    Example: lw-torchrl queries push "the gripper touches the puck"
    """
    known = options.read_tasks(task_file, (task,))
    definition = known[check_task(task, known)]
    if text is not None:
        found = nearest_query(text, definition, by=by)
        nearest = {"query": str(found.query), "similarity": found.score}
        return Output(json).show("nearest", nearest, f"{found.query}   (similarity {found.score:.2f})")
    published = set(lw.supported_queries(definition, published_only=True))
    listed = [{"query": query, "ours": query not in published} for query in lw.supported_queries(definition)]
    lines = [f"{one['query']}{'   (ours)' if one['ours'] else ''}" for one in listed]
    ending = f"\n{len(listed)} base queries; each may be negated, and joined to others by 'and'"
    return Output(json).show("queries", listed, "\n".join([*lines, ending]))


def query(
    task: Positional[Annotated[str, arg(metavar="TASK")]],  # a task's name
    text: Positional[options.Text] = None,  # the query; without one, all supported queries that hold are listed
    /,
    step: int = 0,  # how many steps the expert does first, at most an episode's
    seed: int = 0,  # of the episode
    episode: int = 0,  # its index
    task_file: options.TaskFile = None,
    json: options.Json = False,
) -> Output:
    """Answer a query on a state of a task: the state after so many steps of the scripted expert.

    Example: lw-torchrl query pick-place "Is the gripper open and not above the puck?" --step 40
    """
    from lw_torchrl.suites.suite import find_suite

    known = options.read_tasks(task_file, (task,))
    (name,) = options.simulated("task", [check_task(task, known)], known)
    definition = known[name]
    asked = lw.supported_queries(definition) if text is None else [text]
    listed = [lw.parse_query(one, definition) for one in asked]
    suite = find_suite(name)
    if check_int("step", step, minimum=0) > suite.max_steps:
        raise ValueError(f"step must be at most {suite.max_steps}, got {step}")
    from torchrl.envs import EnvBase, TransformedEnv

    from lw_torchrl.data.missing_episodes import suite_expert

    env: EnvBase = lw.LanguageWorldEnv(name, seed=seed)
    expert = suite_expert(suite, (name,)) if step else None
    if isinstance(expert, lw.ScriptedSkillActor):
        env = TransformedEnv(env, expert.transform())
    state = env.reset(episode=episode)
    if expert is not None:
        state = env.rollout(step, expert, auto_reset=False, tensordict=state)[:, -1]["next"]
    truths = lw.QueryProgram({definition: listed})(state["observation"], state["task_id"])[0].tolist()
    env.close()
    output = Output(json)
    positions = {place: at.tolist() for place, at in definition.positions(state["observation"][0]).items()}
    lines = [f"the {place:24} at {' '.join(f'{x:7.3f}' for x in at)} m" for place, at in positions.items()]
    output.show("positions", positions, "\n".join(lines))
    opening = state["observation"][0, suite.layout.opening].item()
    output.show("opening", opening, f"the gripper's opening       {opening:7.3f}\n")
    answers = [{"query": str(found), "holds": truth} for found, truth in zip(listed, truths, strict=True)]
    said = [one["query"] for one in answers if one["holds"]]
    if text is not None:
        said = [f"{'yes' if one['holds'] else 'no'}: {one['query']}" for one in answers]
    return output.show("queries", answers, "\n".join(said))
