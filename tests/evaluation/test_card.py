"""The shipped policy, model cards, and policies in folders and on a fake Hub."""

import re
import sys
from pathlib import Path

import pytest
import torch

import lw_torchrl as lw
from lw_torchrl.evaluation import EpisodeResult, EvaluationResult, policy_card, save_pretrained
from lw_torchrl.training.checkpoint import policy_file, read_description

huggingface_hub = pytest.importorskip("huggingface_hub")
ROOT = Path(__file__).parent.parent.parent
SHIPPED = "few-shot-mt50"


@pytest.fixture(scope="module")
def result():
    config = {"tasks": ["push", "reach"], "episodes_per_task": 2, "seed": 5, "noise_scale": 0.1}
    config |= {"stop_at_success": True, "max_steps": 500}
    rows = [("push", 0, True), ("push", 1, True), ("reach", 0, True), ("reach", 1, False)]
    episodes = (EpisodeResult(task, k, success, 9 if success else None, None, None) for task, k, success in rows)
    return EvaluationResult(config, tuple(episodes))


def test_the_shipped_policy_succeeds():
    actor = lw.load_actor(SHIPPED)
    assert (type(actor), actor.tasks) == (lw.PlanConditionedActor, lw.MT50)
    assert policy_file(SHIPPED).stat().st_size < 2 * 2**20
    run = read_description(SHIPPED)["run"]
    assert (run["setting"], run["preset"], run["seed"]) == ("few-shot", "one-network", 0)
    options = {"episodes_per_task": 2, "seed": 7, "stop_at_success": True, "progress": False}
    assert lw.evaluate(actor, tasks=["button-press", "drawer-close"], **options).mean_success == 1.0
    assert actor.stochastic().out_keys[-1] == "action_log_prob"


def reaching():
    return lw.modules.DescriptorConditionedActor("reach", decoder=lw.modules.MLPDecoder(width=8))


def test_a_file_with_the_shipped_policys_name_takes_precedence(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lw.save_actor(reaching(), tmp_path / SHIPPED)
    assert lw.load_actor(SHIPPED).tasks == ("reach",)
    with pytest.raises(FileNotFoundError, match="did you mean the shipped policy 'few-shot-mt50'"):
        lw.load_actor("few-shot-mt5")


def test_a_card_describes_the_file_and_the_evaluation(result):
    card = policy_card(SHIPPED, result, repo="me/mine")
    assert (card.data.library_name, card.data.pipeline_tag) == ("lw_torchrl", "robotics")
    assert card.data.eval_results[0].metric_value == 0.75
    text = str(card)
    assert "The policy knows 50 tasks and was trained on demonstrations of 50 of these tasks." in text
    assert "episodes_per_task 10, seed 0, noise_scale [0.0, 0.1, 0.2, 0.3, 0.4]" in text
    assert "steps 6000" in text
    assert "| push | 1.00 |\n| reach | 0.50 |\n| **mean** | **0.750** |" in text
    assert "3 of 4 episodes succeeded, 95 % interval 0.301 to 0.954 (Wilson)." in text
    assert "- Success below 0.8: reach (0.50)." in text
    assert "policy = lw.from_pretrained('me/mine')" in text


def test_the_shipped_policys_card_has_its_own_result_and_citation():
    card = str(policy_card(SHIPPED))
    assert "20 episodes of each task, seed 10000, action noise 0.1" in card
    assert "| **mean** | **0.967** |" in card
    assert "lw.load_actor('few-shot-mt50')" in card
    cited = (ROOT / "CITATION.cff").read_text("utf-8")
    assert re.search(r'title: "(Cond.*)"', cited)[1] in card
    assert all(name in card for name in re.findall(r"family-names: (\w+)", cited))


def test_a_policy_without_metadata_has_a_card(result, tmp_path):
    path = tmp_path / "a: [b] 'c.safetensors"
    lw.save_actor(lw.modules.ActorEnsemble([reaching(), reaching()]), path)
    card = policy_card(path)
    assert all(text in str(card) for text in ("Not measured.", "`ActorEnsemble` of 2 networks"))
    assert card.data.eval_results is None
    with pytest.raises(ValueError, match=r"result .* push"):
        policy_card(path, result)


def has_same_weights(actor, other):
    first, second = actor.state_dict(), other.state_dict()
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def test_a_policy_and_its_card_are_saved_in_a_folder(result, tmp_path):
    save_pretrained(SHIPPED, tmp_path / "mine", result)
    assert (tmp_path / "mine" / "policy.safetensors").read_bytes() == policy_file(SHIPPED).read_bytes()
    assert (tmp_path / "mine" / "README.md").read_text("utf-8") == str(policy_card(SHIPPED, result))
    assert has_same_weights(lw.from_pretrained(tmp_path / "mine"), lw.load_actor(SHIPPED))
    with pytest.raises(FileNotFoundError, match=r"policy\.safetensors"):
        lw.from_pretrained(tmp_path)
    with pytest.raises(ValueError, match="source must be a folder or a repository"):
        lw.from_pretrained(tmp_path / "mine" / "policy.safetensors")


def test_a_policy_is_uploaded_to_the_hub_and_loaded_from_it(result, tmp_path, monkeypatch):
    calls = []

    class Api:
        def __init__(self, token=None):
            calls.append(token)

        def create_repo(self, repo, *, private, exist_ok):
            calls.append((repo, private, exist_ok))

        def upload_folder(self, *, repo_id, folder_path, commit_message):
            for file in Path(folder_path).iterdir():
                (tmp_path / file.name).write_bytes(file.read_bytes())
            return f"hub:{repo_id}"

    def download(repo, file, *, revision):
        calls.append((repo, revision))
        if repo != "me/mine":
            raise OSError("404")
        return str(tmp_path / file)

    monkeypatch.setattr(huggingface_hub, "HfApi", Api)
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    assert lw.evaluation.push_to_hub(SHIPPED, "me/mine", result, private=True, token="t") == "hub:me/mine"
    assert "lw.from_pretrained('me/mine')" in (tmp_path / "README.md").read_text("utf-8")
    assert has_same_weights(lw.from_pretrained("me/mine", revision="v1"), lw.load_actor(SHIPPED))
    assert calls == ["t", ("me/mine", True, True), ("me/mine", "v1")]
    with pytest.raises(FileNotFoundError, match=r"source: .*'me/other'.*404"):
        lw.from_pretrained("me/other")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ImportError, match=r"lw_torchrl\[hub\]"):
        lw.from_pretrained("me/mine")
