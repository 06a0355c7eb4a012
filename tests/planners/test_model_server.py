"""serve_model: what it refuses; and, where the extra [serve] is installed, prompt to robot with a real model."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys

import pytest
from commands import fails

import lw_torchrl as lw
from benchmarks.plan_comparison import compare_plans
from lw_torchrl.planners import model_server
from lw_torchrl.planners.model_server import serve_model

TASKS = [*lw.MT10]


def test_without_the_extra_it_is_named(monkeypatch):
    monkeypatch.setattr(model_server, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install 'lw_torchrl\[serve\]'"):
        serve_model()


def test_what_is_no_model_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.gguf' does not exist"):
        serve_model(tmp_path / "none.gguf")
    (tmp_path / "llama.gguf").write_bytes(b"PK\x03\x04")
    with pytest.raises(ValueError, match=r"model must be one of 'llama.gguf', got 'lama.gguf'; did you mean"):
        serve_model(tmp_path / "lama.gguf")
    with pytest.raises(ValueError, match="must be a GGUF file"):
        serve_model(tmp_path / "llama.gguf")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"port": -1}, "port must be at least 0"),
        ({"context": 10}, "context must be at least 512"),
        ({"threads": 0}, "threads must be at least 1"),
    ],
)
def test_numbers_that_are_too_small_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        serve_model(**options)


def test_serve_looks_at_the_file_before_it_says_that_it_loads(capsys, tmp_path):
    assert "does not exist" in fails(capsys, "plan", "serve", tmp_path / "nope.gguf")


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """The name and the address of the small model, served by the command."""
    pytest.importorskip("llama_cpp", reason="the extra [serve] is not installed: pip install 'lw_torchrl[serve]'")
    log = (tmp_path_factory.mktemp("served") / "log").open("w+")
    command = [sys.executable, "-m", "lw_torchrl", "plan", "serve", "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
    try:
        for line in process.stdout:
            if found := re.match(r"(\S+) is served at (\S+);", line):
                yield found[1], found[2]
                break
        else:
            log.seek(0)
            raise AssertionError(f"no server: {log.read()[-2000:]}")
        process.send_signal(signal.SIGINT)
        process.wait(30)
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        log.close()


@pytest.mark.slow
def test_from_the_prompt_to_the_robot_with_a_real_model(served, tmp_path):
    name, address = served
    options = {"base_url": address, "constrain": True, "seed": 0, "concurrency": 1, "cache": tmp_path / "cache"}
    planner = lw.OpenAIPlanner(name, **options)
    answers = planner.plans(TASKS, format="basic_py", out=tmp_path / "plans")
    assert [answer.task for answer in answers] == TASKS
    for answer in answers:
        assert answer.decoded.plan is not None, answer.raw
        assert answer.decoded.all_scripted, answer.raw
        assert not answer.decoded.notes, answer.decoded.notes
        assert answer.tokens.completion > 0
        assert answer.notes == (), "the server takes a schema as OpenAI's does"
    again = lw.OpenAIPlanner(name, **options).plans(TASKS, format="basic_py")
    assert [one.text for one in again] == [one.text for one in answers]
    assert all(one.cached for one in again)
    found = compare_plans(tmp_path / "plans", episodes=1, max_steps=50, progress=False)
    assert all(one.steps and not one.reason for one in found.answers)


@pytest.mark.slow
def test_it_answers_for_its_own_model_alone(served, tmp_path):
    name, address = served
    other = lw.OpenAIPlanner("gpt-4o", base_url=address, cache=tmp_path / "cache")
    with pytest.raises(lw.planners.PlannerError, match=f"no such model or address.*'{name}' is served"):
        other.plans("reach", progress=False)


@pytest.mark.slow
def test_a_port_that_is_taken_is_refused(served):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"port {port} of 127.0.0.1 cannot be had"):
            serve_model(port=port)
