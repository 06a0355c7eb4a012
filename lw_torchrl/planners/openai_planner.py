"""OpenAIPlanner: plans of any model behind an OpenAI-compatible server."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

from lw_torchrl._checks import Count, Natural, Positive, Scale, check_choice, check_int, checked, counted, shown
from lw_torchrl._files import AnyPath
from lw_torchrl._progress import Progress
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import TASKS, Task, TaskList, Tasks, get_task, named_tasks
from lw_torchrl.planners.answer_files import AnswerCache, folder_name, recorded_answer, settle_folder, write_answer
from lw_torchrl.planners.answers import Answer, Answers, Reply, read_reply, storable, unanswered
from lw_torchrl.planners.chat_server import ChatServer, Dialect, ask_at_once, server_address
from lw_torchrl.planners.prompts import Question, chat_messages, example_plans, plan_schema, request_options

_SETTINGS = ("model", "constrain", "free_skills", "vocabulary", "temperature", "max_tokens", "seed", "options")


class OpenAIPlanner:
    """Asks a model behind an OpenAI-compatible server: OpenAI's own, vLLM, Ollama, llama.cpp's.

    The key comes from the environment variable OPENAI_API_KEY alone; a server of your own needs none. Every answer is
    kept in ``cache`` under all that determines it (:meth:`request`). What is there is not asked for again.

    Args:
        model: the model's name at the server.
        base_url: the server, "http://127.0.0.1:8000/v1"; None for what OPENAI_BASE_URL says, or OpenAI's.
        constrain: hold the model to a schema of the task's plans (:func:`plan_schema`): it answers in JSON.
        free_skills: with ``constrain``, skills in any words instead of the scripted ones.
        skills: the scripted skills to choose from; None for the shipped ones.
        plans: the plans that prompts show examples of; None for the hand-written ones of MT10.
        vocabulary: prompts also say which things the task has, and what can be asked about them.
        temperature: None for the server's own.
        max_tokens: of an answer, at most; models that think first need more.
        seed: attempt k is sent ``seed + k``; None sends none.
        options: further fields of the request, ``{"top_p": 0.9}``.
        name: of the folder for its answers; None for the model's, with "-constrained" if it is.
        cache: the folder where answers are kept.
        concurrency: questions at once.
        retries: how often a question is asked again after a rate limit or a fault of the server or the connection.
            The wait doubles from half a second to 8, or is what the server says, up to two minutes.
        timeout: seconds that each try may take as a whole, from the connection to the answer's last byte.

    Example:
        >>> planner = OpenAIPlanner("meta-llama/Llama-3.1-8B", base_url="http://127.0.0.1:8000/v1", constrain=True)
        >>> planner
        OpenAIPlanner('meta-llama/Llama-3.1-8B', base_url='http://127.0.0.1:8000/v1', constrain=True)
        >>> planner.name
        'meta-llama_Llama-3.1-8B-constrained'

    Source: paper section 'LLM Experiments'.
    """

    @checked
    def __init__(
        self,
        model: str,
        *,
        base_url: str | None = None,
        constrain: bool = False,
        free_skills: bool = False,
        skills: Skills | None = None,
        plans: AnyPlans | None = None,
        vocabulary: bool = False,
        temperature: Scale | None = None,
        max_tokens: Count = 1024,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
        name: str | None = None,
        cache: AnyPath = "runs/answers",
        concurrency: Count = 4,
        retries: Natural = 6,
        timeout: Positive = 300.0,
    ) -> None:
        if not model.strip():
            raise TypeError(f"model must be a model's name, got {shown(model)}")
        if storable(model) != model:
            raise ValueError(f"model must be a name that UTF-8 can hold, in one line, got {shown(model)}")
        if free_skills and not constrain:
            raise ValueError("free_skills=True is for constrain alone: without, skills are in any words")
        self.model, self.base_url, self.constrain, self.free_skills = model, base_url, constrain, free_skills
        self.skills, self.vocabulary = skills, vocabulary
        self.examples = None if plans is None else as_plans(plans)
        self.address = server_address(base_url)
        self.temperature = None if temperature is None else float(temperature)
        self.max_tokens, self.seed = int(max_tokens), None if seed is None else int(seed)
        self.options = request_options(options)
        self.name = folder_name(name or (f"{model}-constrained" if constrain else model))
        self.cache = AnswerCache(cache)
        self.concurrency, self.retries, self.timeout = int(concurrency), int(retries), float(timeout)
        self._dialect: Dialect | None = None

    def __repr__(self) -> str:
        return f"OpenAIPlanner({self.model!r}, base_url={self.address!r}, constrain={self.constrain})"

    def request(self, task: Task, format: str, attempt: int = 0) -> dict[str, Any]:
        """All that determines an answer, as JSON has it."""
        schema = plan_schema(task, format, skills=self.skills, free_skills=self.free_skills) if self.constrain else None
        return {
            "server": self.address,
            "model": self.model,
            "messages": chat_messages(task, format, self.examples, self.vocabulary, self.constrain),
            "schema": schema,
            "max_tokens": self.max_tokens,
            "temperature": self.temperature,
            "seed": None if self.seed is None else self.seed + attempt,
            "options": self.options,
            "attempt": attempt,
        }

    def settings(self) -> dict[str, Any]:
        """What determines all its answers beside the question, as JSON has it."""
        skills = None if self.skills is None else sha256("\n".join(sorted(self.skills)).encode()).hexdigest()[:32]
        found = {"server": self.address, "skills": skills, "plans": example_plans(self.examples).fingerprint}
        return found | {name: getattr(self, name) for name in _SETTINGS}

    def plans(
        self,
        tasks: TaskList,
        *,
        format: str = "chain_py",
        attempts: int = 1,
        out: AnyPath | None = None,
        recorded: bool = False,
        progress: bool = True,
    ) -> Answers:
        """Ask for plans; several questions at a time.

        Args:
            tasks, format, attempts: as for :meth:`Planner.plans`.
            out: a folder; each answer is written to ``out/<name>/<format>/<task>-<attempt>.<ext>`` as it comes, the
                JSON of a constrained one beside it, and in ``out/<name>/settings.json`` what determines them all.
            recorded: take the answers that ``out`` has as they are, and ask only for the others.
            progress: show how many have come.

        Raises:
            PlannerError: an answer did not come. Those that came are kept; called again it asks for the others.
            ImportError: something is to be asked, and the extra ``[llm]`` is absent.
            ValueError: no scripted skill suits a task, or the folder has answers of other settings.
        """
        check_choice("format", format, PLAN_FORMATS)
        count = check_int("attempts", attempts, minimum=1)
        each = [(task, attempt) for task in named_tasks(tasks).values() for attempt in range(count)]
        questions = [Question(task, attempt, self.request(task, format, attempt)) for task, attempt in each]
        return self._answers(questions, format, self.name, out, progress, "taken" if recorded else "replaced")

    def revise(
        self,
        answers: Iterable[Answer],
        facts: Iterable[str],
        *,
        round: int = 1,
        tasks: Tasks = TASKS,
        out: AnyPath | None = None,
        progress: bool = True,
    ) -> Answers:
        """Tell the model what became of its answers, and ask for another in the place of each.

        Args:
            answers: of one format.
            facts: for each, what became of it, as :func:`~lw_torchrl.planners.repairing.plan_facts` says it.
            round: of several; the name of the folder ends with it.
            tasks: where the tasks' names are looked up.
            out: a folder; answers are written to ``out/<name>-round<round>/<format>/<task>-<attempt>.<ext>``.
            progress: as for :meth:`plans`, as are the errors; ``out`` with another answer is a ValueError.
        """
        before, told = list(answers), list(facts)
        formats = {answer.format for answer in before}
        if len(formats) != 1 or len(told) != len(before):
            got = f"{counted(len(before), 'answer')} of {', '.join(sorted(formats)) or 'none'} and {len(told)} facts"
            raise ValueError(f"answers must be of one format, each with its facts, got {got}")
        (format,) = formats
        questions = []
        for answer, fact in zip(before, told, strict=True):
            task = get_task(answer.task, tasks)
            request = self.request(task, format, answer.attempt)
            request["messages"] += [{"role": "assistant", "content": answer.raw}, {"role": "user", "content": fact}]
            questions.append(Question(task, answer.attempt, request))
        name = f"{self.name}-round{check_int('round', round, minimum=1)}"
        return self._answers(questions, format, name, out, progress, "refused")

    def _answers(
        self,
        questions: Iterable[Question],
        format: str,
        name: str,
        out: AnyPath | None,
        progress: bool,
        recorded: Literal["taken", "replaced", "refused"],
    ) -> Answers:
        found: list[Answer] = []
        kept: list[tuple[Question, Reply]] = []
        missing: dict[str, tuple[Question, str]] = {}
        for question in questions:
            try:
                reply, note = self.cache.read(question.request), ""
            except ValueError as error:
                reply, note = None, f"it was asked for again, since {error}"
            if out is not None and recorded != "replaced":
                there = recorded_answer(out, name, question, format, reply, self.skills)
                if there is not None and recorded == "taken":
                    found.append(there)
                    continue
                if there is not None and (reply is None or self._read(reply, question, format).text != there.text):
                    what = f"the answer to another question, {question}, is in {str(Path(out) / name)!r} already"
                    raise ValueError(f"out: {what}; it is not replaced: give the new ones another name (--name) or out")
            if reply is None:
                missing[str(question)] = question, note
            else:
                kept.append((question, reply))
        if out is not None:
            settle_folder(Path(out) / folder_name(name), self.settings(), reading=not kept and not missing)

        def take(question: Question, reply: Reply, cached: bool, note: str = "") -> None:
            answer = self._read(reply, question, format)
            answer = replace(answer, cached=cached, notes=(note, *answer.notes) if note else answer.notes)
            if out is not None:
                write_answer(out, name, answer)
            found.append(answer)

        total, errors = len(found) + len(kept) + len(missing), []
        with Progress("asking", total, "answer", initial=total - len(missing), show=progress) as bar:
            for question, reply in kept:
                take(question, reply, cached=True)
            with closing(self._ask([question for question, _ in missing.values()])) as replies:
                for question, came in replies:
                    if isinstance(came, Exception):
                        errors.append(came)
                    else:
                        take(question, came, cached=False, note=missing[str(question)][1])
                        bar.update()
        if errors:
            raise unanswered(errors, len(found), total, self.cache.folder)
        return Answers(found)

    def _read(self, reply: Reply, question: Question, format: str) -> Answer:
        return read_reply(reply, question.task, format, question.attempt, self.skills, question.request["schema"])

    def _ask(self, questions: list[Question]) -> Generator[tuple[Question, Reply | Exception], None, None]:
        if not questions:
            return
        with ChatServer(self.model, self.base_url, self.timeout, self.retries, self._dialect) as server:

            def ask(question: Question) -> Reply:
                reply = server.ask(question.request, str(question))
                try:
                    self.cache.write(question.request, reply)
                except ValueError as error:
                    return replace(reply, notes=(*reply.notes, str(error)))
                return reply

            yield from ask_at_once(ask, questions, self.concurrency)
            self._dialect = server.dialect
