"""A planner that requests plans from a model behind an OpenAI-compatible server."""

from __future__ import annotations

import json
from collections.abc import Generator, Iterable, Mapping
from contextlib import closing, suppress
from dataclasses import asdict, replace
from hashlib import sha256
from multiprocessing.pool import ThreadPool
from pathlib import Path
from threading import Event
from typing import Any

from lw_torchrl._util.checks import Count, Natural, Positive, Scale, check_value, shown, typed
from lw_torchrl._util.files import AnyPath, expanded, read_json, write_json
from lw_torchrl._util.progress import Progress
from lw_torchrl._util.text import counted
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import TASKS, Task, TaskList, Tasks, get_task, named_tasks
from lw_torchrl.planners.answer_files import (
    Answer,
    Answers,
    PlannerError,
    Reply,
    Tokens,
    folder_name,
    read_reply,
    write_answer,
    write_settings,
)
from lw_torchrl.planners.chat_client import ChatClient, server_address
from lw_torchrl.planners.prompts import Question, chat_messages, example_plans, plan_schema

_OWN_FIELDS = {"max_completion_tokens", "max_tokens", "messages", "model", "n", "response_format", "seed", "stream"}
_OWN_FIELDS |= {"temperature"}
_SETTINGS = ("model", "constrain", "free_skills", "vocabulary", "temperature", "max_tokens", "seed", "options")
_CACHE_VERSION = 1


class OpenAIPlanner:
    """A planner that requests plans from an OpenAI-compatible server: OpenAI, vLLM, Ollama or llama.cpp.

    The API key is read from the environment variable OPENAI_API_KEY; a local server needs no key. Each answer is cached
    under a hash of everything that determines it (:meth:`request`), and is not requested again.

    Args:
        model: the name of the model on the server.
        base_url: the server's address, such as "http://127.0.0.1:8000/v1"; None for OPENAI_BASE_URL or OpenAI's server.
        constrain: constrain the model's answers to JSON that follows the task's :func:`plan_schema`.
        free_skills: with ``constrain``, allow free-form skills as well as scripted skills.
        skills: the scripted skills to choose from; None for the shipped skills.
        plans, vocabulary: see :func:`plan_prompt`.
        temperature: the sampling temperature; None for the server's default.
        max_tokens: maximum number of tokens per answer; reasoning models need more.
        seed: the random seed. Attempt k is requested with ``seed + k``; None sends no seed.
        options: further fields of the request, such as ``{"top_p": 0.9}``.
        name: the name of the answers' folder; None for the model's name, plus "-constrained" with ``constrain``.
        cache: the folder for cached answers.
        concurrency: maximum number of simultaneous requests.
        retries: maximum retries after a rate limit, a server error or a connection error; ``openai`` sets the delays.
        timeout: maximum seconds per try, from the request to the end of the answer.

    Example:
        >>> OpenAIPlanner("meta-llama/Llama-3.1-8B", base_url="http://127.0.0.1:8000/v1", constrain=True).name
        'meta-llama_Llama-3.1-8B-constrained'

    Source: paper section 'LLM Experiments'.
    """

    @typed
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
            raise ValueError(f"model must be the name of a model, got {shown(model)}")
        if free_skills and not constrain:
            raise ValueError("free_skills=True needs constrain=True; without constrain, skills are always free-form")
        self.model, self.base_url, self.address = model, base_url, server_address(base_url)
        self.constrain, self.free_skills, self.skills, self.vocabulary = constrain, free_skills, skills, vocabulary
        self.examples = None if plans is None else as_plans(plans)
        self.temperature = None if temperature is None else float(temperature)  # 1 and 1.0 must give the same request
        self.max_tokens, self.seed = max_tokens, seed
        try:
            self.options = json.loads(json.dumps(dict(options or {}), allow_nan=False)) or None
        except (TypeError, ValueError, RecursionError) as error:
            raise TypeError(f"options must be a mapping of JSON values, got {shown(options)}") from error
        if own := sorted(_OWN_FIELDS & set(self.options or ())):
            raise ValueError(f"options must not set {', '.join(own)} (reserved: {', '.join(sorted(_OWN_FIELDS))})")
        self.name = folder_name(name or (f"{model}-constrained" if constrain else model))
        self.cache = Path(cache)
        self.concurrency, self.retries, self.timeout = concurrency, retries, timeout

    def __repr__(self) -> str:
        return f"OpenAIPlanner({self.model!r}, base_url={self.address!r}, constrain={self.constrain})"

    def request(self, task: Task, format: str, attempt: int = 0) -> dict[str, Any]:
        """Return everything that determines an answer, as a JSON object."""
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
        """Return the settings that determine the answers, apart from tasks and format, as a JSON object."""
        skills = None if self.skills is None else sha256("\n".join(sorted(self.skills)).encode()).hexdigest()[:32]
        settings = {"server": self.address, "skills": skills, "plans": example_plans(self.examples).fingerprint}
        return settings | {name: getattr(self, name) for name in _SETTINGS}

    def plans(
        self,
        tasks: TaskList,
        *,
        format: str = "chain_py",
        attempts: int = 1,
        out: AnyPath | None = None,
        progress: bool = True,
    ) -> Answers:
        """Request plans for tasks, with several simultaneous requests.

        Args:
            tasks, format, attempts, out: see :meth:`Planner.plans`. A constrained model's JSON is written next to the
                answer, and the settings to ``out/<name>/settings.json``.
            progress: show a progress bar.

        Raises:
            PlannerError: an answer is missing. All other answers are cached; repeat the call for the missing answers.
            ImportError: a request needs the extra ``[llm]``, which is not installed.
            ValueError: a task has no scripted skill, or the folder has answers with different settings.
        """
        count = check_value("attempts", attempts, Count)
        each = [(task, attempt) for task in named_tasks(tasks).values() for attempt in range(count)]
        questions = [Question(task, attempt, self.request(task, format, attempt)) for task, attempt in each]
        return self._answers(questions, format, self.name, out, progress)

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
        """Report to the model how its plans performed, and request a revision of each plan.

        Args:
            answers: the answers to revise, all in one format.
            facts: a report on each answer, as written by :func:`~lw_torchrl.planners.repairing.plan_facts`.
            round: the number of the round, starting at 1.
            tasks: the known tasks by name, as returned by :func:`~lw_torchrl.load_tasks`.
            out: as for :meth:`plans`, but with ``-round<round>`` appended to the folder's name.
            progress: show a progress bar.
        """
        before, reports = list(answers), list(facts)
        formats = {answer.format for answer in before}
        if len(formats) != 1 or len(reports) != len(before):
            what = f"{len(before)} answers in {', '.join(sorted(formats)) or 'no format'}, and {len(reports)} reports"
            raise ValueError(f"answers must have one format, and facts one report per answer, got {what}")
        (format,) = formats
        questions = []
        for answer, report in zip(before, reports, strict=True):
            task = get_task(answer.task, tasks)
            request = self.request(task, format, answer.attempt)
            request["messages"] += [{"role": "assistant", "content": answer.raw}, {"role": "user", "content": report}]
            questions.append(Question(task, answer.attempt, request))
        name = f"{self.name}-round{check_value('round', round, Count)}"
        return self._answers(questions, format, name, out, progress)

    def _answers(
        self, questions: list[Question], format: str, name: str, out: AnyPath | None, progress: bool
    ) -> Answers:
        """Answer questions from the cache, and request the missing answers from the server."""
        answers: list[Answer] = []
        missing: list[Question] = []
        for question in questions:
            if (reply := self._cached(question.request)) is None:
                missing.append(question)
            else:
                answers.append(replace(self._read(reply, question, format), cached=True))
        if out is not None:
            write_settings(expanded(out) / folder_name(name), self.settings())
            for answer in answers:
                write_answer(out, name, answer)
        errors: list[PlannerError] = []
        bar = Progress("asking", len(questions), "answer", initial=len(answers), show=progress)
        with bar, closing(self._ask(missing)) as replies:
            for question, result in replies:
                if isinstance(result, PlannerError):
                    errors.append(result)
                    continue
                answers.append(self._read(result, question, format))
                if out is not None:
                    write_answer(out, name, answers[-1])
                bar.update()
        if errors:
            kept = f"{len(answers)} of {counted(len(questions), 'answer')} are cached in {str(self.cache)!r}"
            message = f"{errors[0]} {kept}; repeat the call to request the missing answers."
            raise PlannerError(message, fatal=errors[0].fatal)
        return Answers(answers)

    def _read(self, reply: Reply, question: Question, format: str) -> Answer:
        return read_reply(reply, question.task, format, question.attempt, self.skills, question.request["schema"])

    def cache_path(self, request: Mapping[str, Any]) -> Path:
        """Return the path of the cached reply to a request. The path contains a hash of the request."""
        key = sha256(json.dumps([_CACHE_VERSION, request], sort_keys=True).encode()).hexdigest()
        return self.cache / key[:2] / f"{key}.json"

    def _cached(self, request: Mapping[str, Any]) -> Reply | None:
        """Return the cached reply to a request; None if the file is missing or corrupted."""
        with suppress(FileNotFoundError, ValueError, KeyError, TypeError):
            answer = read_json(self.cache_path(request), "the cached answer")["answer"]
            reply = Reply(**{**answer, "tokens": Tokens(**answer["tokens"]), "notes": tuple(answer["notes"])})
            return reply if reply.is_answer else None
        return None

    def _ask(self, questions: list[Question]) -> Generator[tuple[Question, Reply | PlannerError], None, None]:
        """Yield each question with its reply or error, in order of arrival; stop at a fatal error."""
        if not questions:
            return
        stopped = Event()

        def ask(question: Question) -> tuple[Question, Reply | PlannerError | None]:
            if stopped.is_set():
                return question, None
            try:
                reply = client.ask(question.request, str(question))
            except PlannerError as error:
                if error.fatal:
                    stopped.set()
                return question, error
            if reply.is_answer:
                write_json(self.cache_path(question.request), {"request": question.request, "answer": asdict(reply)})
            return question, reply

        with (
            closing(ChatClient(self.model, self.base_url, self.timeout, self.retries)) as client,
            ThreadPool(min(self.concurrency, len(questions))) as pool,  # daemon threads, so that Ctrl-C does not wait
        ):
            try:
                yield from ((question, result) for question, result in pool.imap_unordered(ask, questions) if result)
            finally:
                stopped.set()
