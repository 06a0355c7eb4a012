"""Several calls of collect_demonstrations with one folder: one works, the others are refused or find it done."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
from collecting import collect, tree

from lw_torchrl._util.files import locked
from lw_torchrl.data import DatasetError
from lw_torchrl.data.collect import EpisodeFiles


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


def elsewhere(root):
    """Collect in another thread, while this one waits."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(collect, root).result()


def test_a_second_call_is_refused_while_the_first_is_at_work(made, tmp_path, monkeypatch):
    put, asked = EpisodeFiles.put, []

    def meanwhile(self, *args):
        if not asked:
            asked.append(True)
            with pytest.raises(DatasetError, match=r"root: another collect_demonstrations is writing to .*demos"):
                elsewhere(tmp_path / "demos")
        put(self, *args)

    monkeypatch.setattr(EpisodeFiles, "put", meanwhile)
    collect(tmp_path / "demos")
    assert asked
    assert tree(tmp_path / "demos") == tree(made.root)


def test_a_finished_dataset_is_read_by_as_many_as_like(made):
    with locked(made.root, "root", folder=True):
        assert elsewhere(made.root) == made
