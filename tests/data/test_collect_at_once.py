"""Several calls of collect_demonstrations with one folder: one works, the others are refused or find it done."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from collecting import collect, tree

from lw_torchrl._files import held
from lw_torchrl.data import DatasetError, LanguageWorldExperienceReplay
from lw_torchrl.data import collect as collect_module
from lw_torchrl.data.missing_episodes import EpisodeFiles


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
            with pytest.raises(DatasetError, match=r"root: another collect_demonstrations is at work in .*demos"):
                elsewhere(tmp_path / "demos")
        put(self, *args)

    monkeypatch.setattr(EpisodeFiles, "put", meanwhile)
    collect(tmp_path / "demos")
    assert asked
    assert tree(tmp_path / "demos") == tree(made.root)


def test_what_another_call_finished_meanwhile_is_kept(made, tmp_path, monkeypatch):
    put = EpisodeFiles.put

    @contextmanager
    def after_another(root, *args, **options):
        monkeypatch.setattr(collect_module, "held", held)
        elsewhere(root)
        monkeypatch.setattr(EpisodeFiles, "put", lambda *_: pytest.fail("nothing is to be run again"))
        with held(root, *args, **options):
            yield

    monkeypatch.setattr(collect_module, "held", after_another)
    assert collect(tmp_path / "demos").episodes == made.episodes
    monkeypatch.setattr(EpisodeFiles, "put", put)
    assert tree(tmp_path / "demos") == tree(made.root)


def test_a_finished_dataset_is_read_by_as_many_as_like(made):
    with held(made.root, "root", folder=True):
        assert elsewhere(made.root) == made


@pytest.mark.slow
def test_two_processes_leave_a_whole_dataset(made, tmp_path):
    program = f"""
import sys
sys.path.insert(0, {str(__file__.rsplit("/", 1)[0])!r})
from collecting import collect
try:
    collect({str(tmp_path / "demos")!r})
except Exception as error:
    print(type(error).__name__, error)
else:
    print("made")
"""
    both = [subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = sorted(one.communicate(timeout=120)[0].split()[0] for one in both)
    assert said in (["DatasetError", "made"], ["made", "made"])
    assert tree(tmp_path / "demos") == tree(made.root)
    assert len(LanguageWorldExperienceReplay(tmp_path / "demos")) == made.num_steps
