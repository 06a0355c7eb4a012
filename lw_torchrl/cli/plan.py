"""The commands ``lw-torchrl plan ...``: request plans from language models, parse the plans and repair them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

import lw_torchrl as lw
from lw_torchrl._util.checks import Count, Natural, Positive, Probability, Scale, check_choice
from lw_torchrl._util.files import read_text
from lw_torchrl._util.text import counted, printable
from lw_torchrl.cli import options
from lw_torchrl.cli.options import Columns, Flag, Maybe, Output, Row
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.outline import outline
from lw_torchrl.language.plans import PlanError, Plans
from lw_torchrl.language.tasks import Task, check_task
from lw_torchrl.suites.suite import load_suite

if TYPE_CHECKING:
    from lw_torchrl.language.canonical import CanonicalReport
    from lw_torchrl.language.plan_decoding import DecodedPlan

_FORMATS = "basic, chain or goal, followed by _py, _py_md or _md"
_PLANNER_OPTIONS = (
    "model", "base_url", "constrain", "free_skills", "vocabulary", "temperature", "max_tokens", "seed", "name",
    "concurrency", "timeout", "cache",
)  # fmt: skip
_SOURCES = f"{options.PLANS}; also a suite, or answers written by `plan generate` (FORMAT/TASK-ATTEMPT.py)"
Format = Annotated[str, arg(help=f"plan format: {_FORMATS}")]


@dataclass(kw_only=True)
class Prompt:
    """Print the prompt that asks a language model for a plan. Plans for three other tasks serve as examples.

    Example: lw-torchrl plan prompt drawer-open --format chain_py
    """

    task: options.TaskName
    format: Format = "chain_py"
    vocabulary: Flag = False  # also list the objects of the task and the supported queries
    plans: Annotated[options.PlanSources, arg(help=f"plans to use as examples: {options.PLANS}")] = ("MT10",)
    task_file: options.TaskFile = None

    def run(self) -> None:
        from lw_torchrl.planners.prompts import plan_prompt

        known = options.read_tasks(self.task_file, (self.task,))
        plans = options.read_plans(self.plans, known)
        print(plan_prompt(self.task, self.format, plans=plans, vocabulary=self.vocabulary, tasks=known), end="")


@dataclass(kw_only=True)
class _Model:
    """The options of the commands that use a language model."""

    tasks: options.TaskNames
    model: str  # name of the model on the server
    base_url: Maybe[str] = None  # address of the server (default: OPENAI_BASE_URL, or OpenAI's address)
    attempts: Count = 1  # number of answers to request for each prompt
    constrain: Flag = False  # force answers to follow a JSON schema, so that every plan is executable
    free_skills: Flag = False  # with --constrain, also allow skills that are not scripted
    vocabulary: Flag = False  # also list the objects of the task and the supported queries in prompts
    temperature: Maybe[Scale] = None  # sampling temperature (default: the server's)
    max_tokens: Count = 1024  # maximum tokens per answer (reasoning models need more)
    seed: Maybe[Natural] = None  # seed of the first attempt; attempt k uses SEED + k (default: no seed)
    name: Maybe[str] = None  # folder name for the answers (default: the model's name)
    plans: Annotated[options.PlanSources, arg(help=f"plans to use as examples: {options.PLANS}")] = ("MT10",)
    skill_file: options.SkillFile = None
    task_file: options.TaskFile = None
    concurrency: Count = 4  # number of simultaneous requests
    timeout: Positive = 300.0  # timeout of a request, in seconds, including the whole answer
    cache: Path = Path("runs/answers")  # folder in which all answers are cached
    out: Path = Path("runs/plans")  # output folder; answers are OUT/NAME/FORMAT/TASK-ATTEMPT.py or .md
    json: options.Json = False

    def planner(self) -> tuple[lw.OpenAIPlanner, list[Task], Mapping[str, Task]]:
        """Return the planner, the selected tasks, and a dict of all tasks by name."""
        known = options.read_tasks(self.task_file, self.tasks)
        own = {name: getattr(self, name) for name in _PLANNER_OPTIONS}
        skills = options.read_skills(self.skill_file, known) if self.skill_file else None
        planner = lw.OpenAIPlanner(skills=skills, plans=options.read_plans(self.plans, known), **own)
        return planner, [known[name] for name in options.select_tasks(self.tasks, known)], known


@dataclass(kw_only=True)
class Generate(_Model):
    """Ask a language model for plans, and report how many answers are valid plans.

    The server must be OpenAI-compatible: OpenAI, vLLM (http://127.0.0.1:8000/v1), Ollama (http://127.0.0.1:11434/v1)
    or llama.cpp (http://127.0.0.1:8080/v1). The API key is read from OPENAI_API_KEY; a local server needs no key.
    Answers are cached: re-running the command requests only the missing ones.

    Example: lw-torchrl plan generate MT10 --model llama3.1 --base-url http://127.0.0.1:11434/v1 --attempts 4
    """

    format: Annotated[tuple[str, ...], arg(help=f'plan formats: {_FORMATS}; or "all"')] = ("chain_py",)

    def run(self) -> Output:
        planner, tasks, _ = self.planner()
        formats = [*PLAN_FORMATS] if self.format == ("all",) else self.format
        for format in formats:
            check_choice("--format", format, PLAN_FORMATS)
        rows, notes, tokens = [], [], 0
        for format in formats:
            answers = planner.plans(tasks, format=format, attempts=self.attempts, out=self.out)
            tokens += answers.tokens.total
            notes += [note for answer in answers for note in answer.notes]
            for task in dict.fromkeys(answer.task for answer in answers):
                of_task = [answer for answer in answers if answer.task == task]
                rows.append({"task": task, "format": format, **_counts(of_task)})
        output = Output(self.json)
        title = f"{planner.model} at {planner.address}"
        output.table("answers", rows, {key.replace("_", " "): key for row in rows[:1] for key in row}, title)
        output.notes(notes)
        output.show("tokens", tokens)
        folder = self.out / planner.name
        return output.show("folder", folder, f"{tokens} tokens; written to {folder}")


def _counts(answers: Sequence[lw.planners.Answer]) -> dict[str, int]:
    plans = [answer.decoded for answer in answers if answer.decoded.plan is not None]
    return {
        "answers": len(answers),
        "plans": len(plans),
        "all_scripted": sum(decoded.all_scripted for decoded in plans),
        "asked_now": sum(not answer.cached for answer in answers),
        "tokens_read": sum(answer.tokens.prompt for answer in answers),
        "tokens_written": sum(answer.tokens.completion for answer in answers),
    }


@dataclass(kw_only=True)
class Repair(_Model):
    """Run a language model's plans with scripted skills, report failures to the model, and ask for repaired plans.

    The report lists the plan step in which the robot got stuck, conditions that never held, distances that stayed too
    large, and text that could not be parsed. Answers of round k are written to OUT/NAME-roundk. Answers that `plan
    generate` cached with the same options are reused. To resume an interrupted repair, run the same command again.

    Example: lw-torchrl plan repair MT10 --model llama3.1 --base-url http://127.0.0.1:11434/v1 --rounds 3
    """

    format: Format = "chain_py"
    rounds: Count = 3  # maximum number of repair rounds
    enough: Probability = 0.8  # success rate above which a plan is not repaired
    episodes: Count = 10  # number of episodes in which each plan is run
    episode_seed: Natural = 0  # random seed of the episodes (use a different one for evaluation)

    def run(self) -> Output:
        planner, tasks, known = self.planner()
        check_choice("--format", self.format, PLAN_FORMATS)
        from lw_torchrl.planners.repairing import repair_plans

        options.use_one_thread()
        first = planner.plans(tasks, format=self.format, attempts=self.attempts, out=self.out)
        how: dict[str, Any] = {"rounds": self.rounds, "enough": self.enough, "episodes": self.episodes}
        repairs = repair_plans(planner, first, tasks=known, out=self.out, seed=self.episode_seed, **how)
        rows = []
        for repair in repairs:
            answer, success = repair.answers[0], [check.success for check in repair.checks]
            rows.append({"task": answer.task, "attempt": answer.attempt, "success": success})

        def after(number: int) -> Callable[[Row], str]:
            return lambda row: f"{row['success'][number]:.0%}" if number < len(row["success"]) else ""

        rounds = {f"round {k}" if k else "first": after(k) for k in range(self.rounds + 1)}
        columns: Columns = {"task": "task", "attempt": "attempt", **rounds}
        output = Output(self.json)
        output.table("plans", rows, columns, f"success rate, scripted skills, {planner.model}, format {self.format}")
        output.notes(note for repair in repairs for answer in repair.answers for note in answer.notes)
        requested = sum(not answer.cached for answer in first)
        print(f"{counted(len(first), 'first answer')}, {requested} requested now")
        last_round = max(len(repair.checks) for repair in repairs) - 1
        folders = [self.out / planner.name, *(self.out / f"{planner.name}-round{k}" for k in range(1, last_round + 1))]
        return output.show("folders", folders, f"written to {', '.join(map(str, folders))}")


@dataclass(kw_only=True)
class Read:
    """Show, step by step, how plans and programs are parsed; --out saves the parsed plans.

    The steps are nested below the conditions that they share. A program may be Python, JSON, YAML or prose.

    If a plan chooses a correct step in less than three quarters of typical states, its conditions are completed and
    missing steps are added. A plan without any motion is replaced by the fallback plan: grasp the first object and move
    it to the goal.

    Example: lw-torchrl plan read my-plans/coffee-pull.plan

    Example: lw-torchrl plan read push.py

    Example: lw-torchrl plan read runs/plans/llama3.1/chain_py/*.py --out my-plans
    """

    sources: Positional[Annotated[tuple[str, ...], options.REQUIRED, arg(metavar="SOURCES", help=_SOURCES)]]
    task: Maybe[str] = None  # show only the plan for this task (default for an answer: the task in the file name)
    format: Maybe[str] = None  # plan format of an answer (default: the folder's name, or detected from the content)
    out: Maybe[Path] = None  # folder in which to save the first plan of each task, as parsed, in a .plan file
    scripted: Flag = False  # replace each skill with the nearest scripted skill (`evaluate scripted` requires this)
    task_file: options.TaskFile = None
    json: options.Json = False

    def run(self) -> Output:
        from lw_torchrl.language.canonical import explain_canonical

        plans = list[lw.ConditionalPlan]()
        output, rows, summaries = Output(self.json), list[Row](), list[Row]()
        for source in self.sources:
            for plan, decoded in self._plans(source):
                report = explain_canonical(plan)
                where = {"task": plan.task, "source": report.source}
                tree = _tree(report.notes(), report, None if self.scripted else decoded)
                rows += [{**where, **row} for row in tree if "written" in row]
                notes = [] if decoded is None else [str(note) for note in decoded.notes]
                summaries.append({**where, "notes": notes})
                plans.append(plan)
                if not self.json:
                    output.table("", tree, _COLUMNS, f"{source}: {', '.join(where.values())}")
                    print(*(f"{printable(note)}\n" for note in notes), sep="")
        output.show("read", rows).show("plans", summaries)
        if self.out is not None:
            first = {plan.task: plan for plan in reversed(plans)}
            output.show("files", lw.save_plans(Plans(first), self.out), f"{counted(len(first), 'plan')} in {self.out}")
        return output

    def _plans(self, source: str) -> list[tuple[lw.ConditionalPlan, DecodedPlan | None]]:
        """Return the plans in a source; with --task, only that task's plan. Each plan is paired with the
        :class:`DecodedPlan` if it was decoded from a language model's answer, otherwise with None."""
        file = Path(source)
        if file.is_file() and (options.is_answer(file) or (self.scripted and file.suffix == ".plan")):
            return self._decoded(file)
        if file.exists() or source in ("MT10", "MT50"):
            known = options.tasks_of_plans(file, self.task, self.task_file)
            plans = options.read_plans([source], known)
        else:
            suite = load_suite(source)
            known, plans = suite.tasks, Plans(suite.plans or {})
        if self.task is None:
            return [(plan, None) for plan in plans.values()]
        check_task(self.task, known)
        plans.require([self.task])
        return [(plans[self.task], None)]

    def _decoded(self, file: Path) -> list[tuple[lw.ConditionalPlan, DecodedPlan | None]]:
        """Decode a language model's answer and return a list with its plan.

        If the answer has no plan, print the reason and return an empty list, or raise a PlanError if ``file`` is the
        only source.
        """
        from lw_torchrl.language.plan_decoding import decode_plan

        format, folder = self.format, file.absolute().parent.name
        known = options.tasks_of_plans(file, self.task, self.task_file)
        if format is None and folder in PLAN_FORMATS:
            format = folder
        text = read_text(file, ValueError)
        decoded = decode_plan(text, self.task or options.task_of_answer(file, text, known), format, tasks=known)
        if self.scripted and decoded.plan is not None and decoded.scripted is None:
            raise PlanError(f"{file}: --scripted: no scripted skill has a text similar enough to a step's skill")
        if decoded.plan is not None:
            return [((decoded.scripted if self.scripted else None) or decoded.plan, decoded)]
        if len(self.sources) == 1:
            notes = "".join(f"; {note}" for note in decoded.notes[:10] if note.text != decoded.reason)
            raise PlanError(f"{file}: no plan can be read: {decoded.reason}{notes}")
        print(f"{file}: no plan can be read: {printable(decoded.reason)}")
        print(*(f"{printable(str(note))}\n" for note in decoded.notes), sep="", end="")
        return []


_COLUMNS: Columns = {
    "plan": lambda row: "  " * row["depth"] + (row["head"] if "head" in row else row["written"] or row["skill"]),
    "verb": lambda row: row.get("verb"),
    "object": lambda row: row.get("moved"),
    "target": lambda row: row.get("target"),
    "note": lambda row: "" if row.get("dropped") is None else f"left out: {row['dropped']}",
}


def _tree(notes: Sequence[Row], report: CanonicalReport, decoded: DecodedPlan | None) -> list[Row]:
    """Return the rows of a plan's tree: branch heads, and steps as in :meth:`CanonicalReport.notes`.

    The row of a step also has the step's ``line`` in the text, the ``path`` of heads above the step, and the reason why
    the step was ``dropped``, or None. At the end come the clauses that did not become steps, and then the steps that
    replace the plan's steps.
    """
    from lw_torchrl.language.canonical import SOURCES

    count = len(report.written.steps)
    decoded_steps = () if decoded is None else decoded.steps
    at: list[int | None] = [step.line for step in decoded_steps if not step.dropped] or [None] * count
    own = [
        {**row, "line": line, "dropped": None if row["skill"] else "no motion of an object is recognized"}
        for row, line in zip(notes[:count], at, strict=True)
    ]
    tree = _branches(own, report.written)
    nothing: Row = {**dict.fromkeys(notes[0]), "seen": False, "depth": 0, "path": []}
    absent = [step for step in decoded_steps if step.dropped]
    tree += [{**nothing, "written": step.written_skill, "line": step.line, "dropped": step.dropped} for step in absent]
    if report.source != "plan":
        tree.append({"depth": 0, "head": f"{SOURCES[report.source]}; policies on canonical plans see:"})
        tree += _branches([{**row, "line": None, "dropped": None} for row in notes[count:]], report.plan, 1)
    return tree


def _branches(rows: Sequence[Row], plan: lw.ConditionalPlan, depth: int = 0) -> list[Row]:
    """Arrange the rows of a plan's steps by their conditions."""
    tree, path = list[Row](), list[str]()
    for line in outline([step.condition for step in plan.steps]):
        del path[line.depth :]
        if line.head:
            path.append(str(line))
            tree.append({"depth": depth + line.depth, "head": str(line)})
        else:
            tree.append({**rows[line.steps[0]], "depth": depth + line.depth, "path": [*path]})
    return tree
