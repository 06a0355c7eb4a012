"""The shipped policy, its card, and policies in folders and on a hub, which stands in for the real one."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import lw_torchrl as lw
from lw_torchrl.evaluation import EpisodeResult, EvaluationResult, policy_card, save_pretrained
from lw_torchrl.training.files import policy_file, read_description

ROOT = Path(__file__).parent.parent.parent
SHIPPED = "few-shot-mt50"


@pytest.fixture(scope="module")
def result():
    config = {"tasks": ["push", "reach"], "episodes_per_task": 2, "seed": 5, "noise_scale": 0.1}
    config |= {"stop_at_success": True, "max_steps": 500}
    ran = [("push", 0, True), ("push", 1, True), ("reach", 0, True), ("reach", 1, False)]
    return EvaluationResult(
        config, tuple(EpisodeResult(task, n, won, 9 if won else None, None, None) for task, n, won in ran)
    )


def test_a_policy_to_start_from_is_shipped_and_acts():
    actor = lw.load_actor(SHIPPED)
    assert isinstance(actor, lw.PlanConditionedActor)
    assert actor.tasks == lw.MT50
    assert policy_file(SHIPPED).stat().st_size < 3 * 2**20
    run = read_description(SHIPPED)["run"]
    assert (run["setting"], run["preset"], run["seed"]) == ("few-shot", "one-network", 0)
    found = lw.evaluate(
        actor,
        tasks=["button-press", "drawer-close"],
        episodes_per_task=2,
        seed=7,
        stop_at_success=True,
        progress=False,
    )
    assert found.mean_success == 1.0
    assert actor.stochastic().out_keys[-1] == "action_log_prob"


def test_a_file_of_that_name_comes_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lw.save_actor(lw.DescriptorConditionedActor("reach", width=8), tmp_path / SHIPPED)
    assert lw.load_actor(SHIPPED).tasks == ("reach",)
    with pytest.raises(FileNotFoundError, match="did you mean 'few-shot-mt50', which is shipped"):
        lw.load_actor("few-shot-mt5")
    with pytest.raises(FileNotFoundError):
        lw.load_actor("../data/few-shot-mt50")


def test_a_card_says_what_the_file_and_the_evaluation_say(result):
    card = policy_card(SHIPPED, result, repo="me/mine")
    front = card.split("---")[1]
    assert "library_name: lw_torchrl\npipeline_tag: robotics\ntags:\n- robotics" in front
    assert "value: 0.750" in front
    assert "It knows 50 tasks, and was shown demonstrations of 50." in card
    assert "episodes_per_task 10, seed 0, noise_scale [0.0, 0.1, 0.2, 0.3, 0.4]" in card
    assert "steps 6000" in card
    assert "| push | 1.00 |  |\n| reach | 0.50 |  |\n| **mean** | **0.750** | |" in card
    assert "3 of 4 episodes, 95 % interval 0.301 to 0.954 (Wilson)." in card
    assert "- Below 0.8: reach (0.50)." in card
    assert 'policy = lw.from_pretrained("me/mine")' in card
    yaml = pytest.importorskip("yaml").safe_load(front)
    assert yaml["model-index"][0]["results"][0]["metrics"][0]["value"] == 0.75


def test_a_card_without_a_result_says_that_nothing_was_measured(tmp_path):
    lw.save_actor(lw.DescriptorConditionedActor("reach", width=8), tmp_path / "p.zip")
    card = policy_card(tmp_path / "p.zip")
    assert "Not measured." in card
    assert "model-index" not in card


def test_the_shipped_policys_card_has_its_own_result():
    card = policy_card(SHIPPED)
    assert "20 episodes of each task, seed 10000, action noise 0.1" in card
    assert "| **mean** | **0.967** | |" in card
    code = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    assert code[0].startswith("import lw_torchrl as lw\n")
    assert 'lw.load_actor("few-shot-mt50")' in code[0]


def test_a_card_cites_what_the_citation_file_cites():
    cited = (ROOT / "CITATION.cff").read_text("utf-8")
    card = policy_card(SHIPPED)
    assert re.search(r'title: "(Cond.*)"', cited)[1] in card
    for name in re.findall(r"family-names: (\w+)", cited):
        assert name in card
    assert f"year = {{{re.search(r'year: (.*)', cited)[1]}}}" in card


def test_a_strangers_file_puts_nothing_but_words_in_a_card(tmp_path):
    actor = lw.DescriptorConditionedActor("reach", width=8)
    evil = "x\n# Heading <script>alert(1)</script> | `code` ![](a) {{}}"
    lw.save_actor(actor, tmp_path / "p.zip", data={"seed": evil, "tasks": [evil]}, training={"steps": evil}, run=3)
    card = policy_card(tmp_path / "p.zip")
    assert "<script>" not in card
    assert "\n# Heading" not in card
    lw.save_actor(actor, tmp_path / "p.zip", data={"parts": 3}, training=[], run=[1])
    assert "The file does not say" not in policy_card(tmp_path / "p.zip")  # the versions it does


def test_a_strangers_file_puts_no_link_in_a_card(tmp_path, monkeypatch):
    evil = "[click me](https://evil.example/x) [a][b] www.evil.example"
    told = {"run": {"seed": evil}, "training": {"optimizer": evil}, "data": {"tasks": [evil]}}
    lw.save_actor(lw.DescriptorConditionedActor("reach", width=8), tmp_path / "p.zip", **told)
    described = read_description(tmp_path / "p.zip") | {"versions": {evil: evil}}
    monkeypatch.setattr("lw_torchrl.evaluation.card.read_description", lambda _: described)
    card = policy_card(tmp_path / "p.zip").partition("## How to cite")[0]
    assert card.count("click me") == 5
    assert not re.search(r"\]\(|\]\[|\]:|://|www\.", card)


@pytest.mark.parametrize("name", ["a: b", "[x", "- y", "it's: 'q", "null", "@@@", '"', "x #c", "1e5", "\x07", "日本"])
def test_any_file_name_is_read_back_from_its_card(result, tmp_path, name):
    lw.save_actor(lw.DescriptorConditionedActor(["push", "reach"], width=8), tmp_path / f"{name}.zip")
    card = policy_card(tmp_path / f"{name}.zip", result)
    yaml = pytest.importorskip("yaml").safe_load(card.split("---")[1])
    assert yaml["model-index"][0]["name"] == name
    assert ast.literal_eval(re.search(r"load_actor\((.*)\)", card)[1]) == f"{name}.zip"
    assert re.search(r"^# \S", card, re.MULTILINE)


def test_a_result_of_other_tasks_is_refused(result, tmp_path):
    lw.save_actor(lw.DescriptorConditionedActor("reach", width=8), tmp_path / "p.zip")
    with pytest.raises(ValueError, match="result must be of the policy's tasks, it does not know push"):
        policy_card(tmp_path / "p.zip", result)


def same(one, other):
    ours, found = one.state_dict(), other.state_dict()
    return ours.keys() == found.keys() and all(torch.equal(ours[name], found[name]) for name in ours)


def test_a_folder_holds_a_policy_and_its_card(result, tmp_path):
    save_pretrained(SHIPPED, tmp_path / "mine", result)
    assert (tmp_path / "mine" / "policy.zip").read_bytes() == policy_file(SHIPPED).read_bytes()
    assert (tmp_path / "mine" / "README.md").read_text("utf-8") == policy_card(SHIPPED, result)
    assert same(lw.from_pretrained(tmp_path / "mine"), lw.load_actor(SHIPPED))
    with pytest.raises(FileNotFoundError, match=r"policy\.zip"):
        lw.from_pretrained(tmp_path)


def test_nothing_is_written_where_the_card_has_no_room(tmp_path):
    (tmp_path / "README.md").mkdir()
    with pytest.raises(IsADirectoryError, match=r"folder must have room for the file README\.md"):
        save_pretrained(SHIPPED, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["README.md"]


@pytest.mark.parametrize(
    ("source", "error", "says"),
    [
        ("p.zip", ValueError, r"must be a folder or a repository, got 'p\.zip'; lw\.load_actor loads it"),
        (SHIPPED, ValueError, "lw.load_actor loads it"),
        ("", FileNotFoundError, "there is no folder ''; a repository is named like 'me/my-policy'"),
        ("my-plicy", FileNotFoundError, "there is no folder 'my-plicy'"),
        ("/no/such/folder", FileNotFoundError, "there is no folder '/no/such/folder'; a repository"),
        ("runs/mine", FileNotFoundError, "no folder 'runs/mine', and the Hub gave no policy: 404"),
    ],
)
def test_what_is_neither_a_folder_nor_on_the_hub_is_told(monkeypatch, tmp_path, source, error, says):
    def download(repo, file, *, revision):
        raise OSError("404")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(hf_hub_download=download))
    with pytest.raises(error, match=says):
        lw.from_pretrained(source)


def test_a_policy_goes_to_the_hub_and_comes_back(result, tmp_path, monkeypatch):
    said = []

    class Api:
        def __init__(self, token=None):
            said.append(token)

        def create_repo(self, repo, *, private, exist_ok):
            said.append((repo, private, exist_ok))

        def upload_folder(self, *, repo_id, folder_path, commit_message):
            for file in Path(folder_path).iterdir():
                (tmp_path / file.name).write_bytes(file.read_bytes())
            return f"hub:{repo_id}"

    def download(repo, file, *, revision):
        said.append((repo, revision))
        return str(tmp_path / file)

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(HfApi=Api, hf_hub_download=download))
    assert lw.evaluation.push_to_hub(SHIPPED, "me/mine", result, private=True, token="t") == "hub:me/mine"
    assert 'lw.from_pretrained("me/mine")' in (tmp_path / "README.md").read_text("utf-8")
    assert same(lw.from_pretrained("me/mine", revision="v1"), lw.load_actor(SHIPPED))
    assert said == ["t", ("me/mine", True, True), ("me/mine", "v1")]
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=r"needs the extra \[hub\]: pip install 'lw_torchrl\[hub\]'"):
        lw.from_pretrained("me/mine")
    assert "hub" in tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
