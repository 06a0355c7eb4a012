"""OpenAIPlanner: plans of a model behind an OpenAI-compatible server."""

from __future__ import annotations

import json
from collections.abc import Generator, Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from hashlib import sha256
from multiprocessing.pool import ThreadPool
from pathlib import Path
from threading import Event
from typing import Any, Literal

from lw_torchrl._util.checks import Count, Natural, Positive, Scale, check_choice, check_value, counted, shown, typed
from lw_torchrl._util.files import AnyPath, read_text
from lw_torchrl._util.progress import Progress
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.skills import Skills
from lw_torchrl.language.tasks import TASKS, Task, TaskList, Tasks, get_task, named_tasks
from lw_torchrl.planners.answer_files import (
    Answer,
    AnswerCache,
    Answers,
    answer_path,
    folder_name,
    read_reply,
    write_answer,
    write_settings,
)
from lw_torchrl.planners.chat import ChatClient, PlannerError, Reply, server_address
from lw_torchrl.planners.prompts import Question, chat_messages, example_plans, plan_schema

_OWN_FIELDS = {"max_completion_tokens", "max_tokens", "messages", "model", "n", "response_format", "seed", "stream"}
_OWN_FIELDS |= {"temperature"}
_SETTINGS = ("model", "constrain", "free_skills", "vocabulary", "temperature", "max_tokens", "seed", "options")


class OpenAIPlanner:
    """A planner that asks a model behind an OpenAI-compatible server: OpenAI's, vLLM, Ollama, llama.cpp's.

    The key is read from the environment variable OPENAI_API_KEY; your own server needs none. Each answer is cached
    under everything that determines it (:meth:`request`), and is not requested again.

    Args:
        model: the model's name at the server.
        base_url: the server's address, "http://127.0.0.1:8000/v1"; None for OPENAI_BASE_URL, or OpenAI's server.
        constrain: restrict the model to a JSON Schema of the task's plans (:func:`plan_schema`); it answers in JSON.
        free_skills: with ``constrain``, allow skills in any words, not only the scripted ones.
        skills: the scripted skills to choose from; None for the shipped ones.
        plans, vocabulary: see :func:`plan_prompt`.
        temperature: None for the server's default.
        max_tokens: maximum tokens of an answer; reasoning models need more.
        seed: attempt k is sent ``seed + k``; None sends none.
        options: further fields of the request, ``{"top_p": 0.9}``.
        name: the folder for the answers; None for the model's name, with "-constrained" if it is constrained.
        cache: the folder of cached answers.
        concurrency: questions at once.
        retries: retries after a rate limit, or an error of the server or the connection; ``openai`` chooses the wait.
        timeout: seconds for one try, from the request to the end of the answer.

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
            raise TypeError(f"model must be a model's name, got {shown(model)}")
        if free_skills and not constrain:
            raise ValueError("free_skills needs constrain; without it, skills are in any words")
        self.model, self.base_url, self.address = model, base_url, server_address(base_url)
        self.constrain, self.free_skills, self.skills, self.vocabulary = constrain, free_skills, skills, vocabulary
        self.examples = None if plans is None else as_plans(plans)
        self.temperature = None if temperature is None else float(temperature)  # 1 and 1.0 are one request
        self.max_tokens, self.seed = max_tokens, seed
        try:
            self.options = json.loads(json.dumps(dict(options or {}), allow_nan=False)) or None
        except (TypeError, ValueError, RecursionError) as error:
            raise TypeError(f"options must be fields of a request in JSON, got {shown(options)}") from error
        if own := sorted(_OWN_FIELDS & set(self.options or ())):
            others = ", ".join(sorted(_OWN_FIELDS))
            raise ValueError(f"options must not set {', '.join(own)} (reserved: {others})")
        self.name = folder_name(name or (f"{model}-constrained" if constrain else model))
        self.cache = AnswerCache(cache)
        self.concurrency, self.retries, self.timeout = concurrency, retries, timeout

    def __repr__(self) -> str:
        return f"OpenAIPlanner({self.model!r}, base_url={self.address!r}, constrain={self.constrain})"

    def request(self, task: Task, format: str, attempt: int = 0) -> dict[str, Any]:
        """Return everything that determines an answer, as JSON."""
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
        """Return everything but the question that determines the answers, as JSON."""
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
        recorded: bool = False,
        progress: bool = True,
    ) -> Answers:
        """Ask for plans, several at a time.

        Args:
            tasks, format, attempts, out: see :meth:`Planner.plans`. The JSON of a constrained model is written beside
                its answer, and the settings to ``out/<name>/settings.json``.
            recorded: read the answers that are in ``out``, and ask only for the others.
            progress: show a progress bar.

        Raises:
            PlannerError: an answer is missing. The others are cached; the same call asks for the missing ones.
            ImportError: the extra ``[llm]`` is needed, and not installed.
            ValueError: no scripted skill suits a task, or the folder has answers of other settings.
        """
        check_choice("format", format, PLAN_FORMATS)
        count = check_value("attempts", attempts, Count)
        each = [(task, attempt) for task in named_tasks(tasks).values() for attempt in range(count)]
        questions = [Question(task, attempt, self.request(task, format, attempt)) for task, attempt in each]
        return self._answers(questions, format, self.name, out, progress, "read" if recorded else "replace")

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
        """Report to the model how its plans performed, and ask for a better answer to each.

        Args:
            answers: answers in one format.
            facts: a report on each, as :func:`~lw_torchrl.planners.repairing.plan_facts` writes it.
            tasks: where tasks' names are looked up.
            out: as for :meth:`plans`; the folder's name ends in ``-round<round>``. Another answer of this round in it
                is a :class:`ValueError`.
            progress: show a progress bar.
        """
        before, reports = list(answers), list(facts)
        formats = {answer.format for answer in before}
        if len(formats) != 1 or len(reports) != len(before):
            got = f"{counted(len(before), 'answer')} of {', '.join(sorted(formats)) or 'none'} and {len(reports)} facts"
            raise ValueError(f"answers must be of one format, each with its facts, got {got}")
        (format,) = formats
        questions = []
        for answer, report in zip(before, reports, strict=True):
            task = get_task(answer.task, tasks)
            request = self.request(task, format, answer.attempt)
            request["messages"] += [{"role": "assistant", "content": answer.raw}, {"role": "user", "content": report}]
            questions.append(Question(task, answer.attempt, request))
        name = f"{self.name}-round{check_value('round', round, Count)}"
        return self._answers(questions, format, name, out, progress, "refuse")

    def _answers(
        self,
        questions: list[Question],
        format: str,
        name: str,
        out: AnyPath | None,
        progress: bool,
        existing: Literal["read", "replace", "refuse"],
    ) -> Answers:
        """Answer questions from ``out``, the cache and the server, in this order."""
        answers: list[Answer] = []
        missing: list[Question] = []
        written = 0
        for question in questions:
            reply = self.cache.read(question.request)
            answer = None if reply is None else self._read(reply, question, format)
            path = answer_path(out or "", name, format, question.task.name, question.attempt)
            if out is not None and existing != "replace" and path.is_file():
                written += 1
                text = read_text(path, ValueError)
                if answer is None or answer.text != text:
                    if existing == "refuse":
                        what = f"{str(path)!r} holds an answer to another question; it is not replaced"
                        raise ValueError(f"out: {what}: give the new answers another name (--name) or out")
                    answer = read_reply(Reply(text), question.task, format, question.attempt, self.skills)
            if answer is None:
                missing.append(question)
            else:
                answers.append(replace(answer, cached=True))
        if out is not None:
            write_settings(Path(out) / folder_name(name), self.settings(), reading=written == len(questions))
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
            others = f" {counted(len(errors) - 1, 'other question')} failed, too." if len(errors) > 1 else ""
            kept = f"{len(answers)} of {counted(len(questions), 'answer')} are kept in {str(self.cache.folder)!r}"
            message = f"{errors[0]}{others} {kept}; repeat the call to ask for the others."
            raise PlannerError(message, fatal=errors[0].fatal)
        return Answers(answers)

    def _read(self, reply: Reply, question: Question, format: str) -> Answer:
        return read_reply(reply, question.task, format, question.attempt, self.skills, question.request["schema"])

    def _ask(self, questions: list[Question]) -> Generator[tuple[Question, Reply | PlannerError], None, None]:
        """Yield each question with its reply or error, in the order in which they arrive; stop at a fatal error."""
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
            self.cache.write(question.request, reply)
            return question, reply

        with (
            closing(ChatClient(self.model, self.base_url, self.timeout, self.retries)) as client,
            ThreadPool(min(self.concurrency, len(questions))) as pool,  # of daemons, which Ctrl-C does not wait for
        ):
            try:
                yield from ((asked, result) for asked, result in pool.imap_unordered(ask, questions) if result)
            finally:
                stopped.set()
