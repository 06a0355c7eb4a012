"""The file of a recording has its name from the start, is whole after each write, and spares an older one."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from recordings import PLAN, Recording, make_objects, make_rollout

from lw_torchrl.record import RerunLogger, join_recordings
from lw_torchrl.record.joining import run_names
from lw_torchrl.record.recording_file import is_whole, opened


def test_the_file_has_its_name_from_the_start(tmp_path):
    path = tmp_path / "a.rrd"
    logger = RerunLogger(path)
    logger.log_scalar("loss", 1.0)
    logger.flush()
    assert os.listdir(tmp_path) == ["a.rrd"]
    written = path.read_bytes()
    assert written.startswith(b"RRF2")
    assert written.endswith(bytes(16)), "it ends as a stream does"
    assert not is_whole(path)
    with pytest.warns(UserWarning, match="was not closed"), opened(path) as copy:
        assert "/metrics/loss" in Recording(copy).entities()
    logger.log_scalar("loss", 2.0)
    logger.flush()
    assert path.read_bytes().startswith(written[:-16]), "what was written stays as it is"
    logger.shutdown()
    assert os.listdir(tmp_path) == ["a.rrd"]
    assert is_whole(path)


def test_ending_the_experiment_ends_the_logger(tmp_path):
    # What torchrl's service backends do instead of shutdown().
    logger = RerunLogger(tmp_path / "a.rrd")
    logger.log_scalar("loss", 1.0)
    logger.flush()
    logger.experiment.finish()
    assert not logger.is_alive
    assert "/metrics/loss" in Recording(tmp_path / "a.rrd").entities()


def test_older_files_are_kept(tmp_path):
    path = tmp_path / "a.rrd"
    for content in (b"first", b"second"):
        path.write_bytes(content)
        with RerunLogger(path) as logger:
            logger.log_scalar("loss", 1.0)
    assert logger.previous == tmp_path / "a.previous-2.rrd"
    assert (tmp_path / "a.previous.rrd").read_bytes() == b"first"
    assert (tmp_path / "a.previous-2.rrd").read_bytes() == b"second"
    assert "/metrics/loss" in Recording(path).entities()
    assert len(os.listdir(tmp_path)) == 3


def test_an_empty_file_is_no_recording_to_keep(tmp_path):
    (tmp_path / "a.rrd").touch()
    with RerunLogger(tmp_path / "a.rrd") as logger:
        assert logger.previous is None
    assert os.listdir(tmp_path) == ["a.rrd"]


def test_discarding_gives_the_older_file_its_name_back(tmp_path):
    path = tmp_path / "a.rrd"
    path.write_bytes(b"older")
    logger = RerunLogger(path)
    logger.log_episode(make_rollout(), task="push", objects={})
    logger.flush()
    logger.discard()
    logger.discard()
    assert not logger.is_alive
    assert path.read_bytes() == b"older"
    assert os.listdir(tmp_path) == ["a.rrd"]


@pytest.mark.parametrize("end", ["shutdown", "discard"])
def test_a_recording_leaves_alone_the_one_that_has_its_name_now(tmp_path, end):
    path = tmp_path / "a.rrd"
    first = RerunLogger(path)
    first.log_scalar("first", 1.0)
    first.flush()
    second = RerunLogger(path)
    assert second.previous == tmp_path / "a.previous.rrd"
    getattr(first, end)()
    second.log_scalar("second", 1.0)
    second.shutdown()
    assert Recording(path).entities() == {"/__properties", "/metrics/second"}
    assert is_whole(path)
    if end == "shutdown":
        with pytest.warns(UserWarning, match="was not closed"), opened(second.previous) as kept:
            assert "/metrics/first" in Recording(kept).entities()


def test_a_file_without_room_for_an_index_stays_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_scalar("loss", 1.0)
    assert not is_whole(tmp_path / "a.rrd")
    with pytest.warns(UserWarning, match="was not closed"), opened(tmp_path / "a.rrd") as copy:
        assert "/metrics/loss" in Recording(copy).entities()


def test_two_loggers_do_not_mix(tmp_path):
    import rerun as rr

    one, two = RerunLogger(tmp_path / "1.rrd"), RerunLogger(tmp_path / "2.rrd")
    one.log_scalar("a", 1.0)
    two.log_scalar("b", 1.0)
    assert rr.get_global_data_recording() is None
    one.shutdown()
    two.shutdown()
    assert Recording(tmp_path / "1.rrd").entities() == {"/__properties", "/metrics/a"}
    assert Recording(tmp_path / "2.rrd").entities() == {"/__properties", "/metrics/b"}


def test_wrong_paths_are_named(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.rrd").mkdir()
    for path, message in (
        (tmp_path / "a.txt", "must end in '.rrd'"),
        (tmp_path / ".rrd", "must end in '.rrd'"),
        (tmp_path / "folder.rrd", "must be a file, got the folder"),
        (tmp_path / "file" / "a.rrd", "'.*file' is a file"),
        (tmp_path / "file" / "below" / "a.rrd", "'.*file' is a file"),
    ):
        with pytest.raises(ValueError, match=message):
            RerunLogger(path)
    with pytest.raises(TypeError, match="path must be a path"):
        RerunLogger(3)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_to(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(PermissionError):
        RerunLogger(tmp_path / "a.rrd")


def trained(path, rate, length=20):
    """A recording of a training: two curves of a group, a table, an episode."""
    rollout = make_rollout(length)
    with RerunLogger(path) as logger:
        logger.log_hparams({"rate": rate})
        for step in range(5):
            logger.log_metrics({"loss/bc": rate**step, "loss/latent": 2 * rate**step}, step)
        logger.log_episode(rollout, task="push", objects=make_objects(rollout), plan=PLAN)
    return path


def test_two_runs_lie_over_one_another_and_side_by_side(tmp_path):
    (tmp_path / "a").mkdir()
    files = [trained(tmp_path / "a" / "run.rrd", 0.5), trained(tmp_path / "b.rrd", 0.9)]
    joined = Recording(join_recordings([tmp_path / "a", files[1]], tmp_path / "both.rrd"))
    for run, file in zip("ab", files, strict=True):
        alone = Recording(file)
        for curve in ("bc", "latent"):
            place = f"/metrics/loss/{curve}"
            assert joined.values(f"/{run}{place}", "Scalars:scalars") == alone.values(place, "Scalars:scalars")
            assert joined.values(f"/{run}{place}", "SeriesLines:names")[-1] == [f"{curve} · {run}"]
        for entity in ("/push/action", "/push/plan", "/e1/gripper"):
            assert f"/{run}{entity}" in joined.entities()
    curves = [f"/{run}/metrics/loss/{one}" for run in "ab" for one in ("bc", "latent")]
    colors = [joined.values(curve, "SeriesLines:colors")[-1][0] for curve in curves]
    assert len(set(colors)) == 4
    assert joined.tabs() == ["push · side by side", "a/push", "b/push", "Metrics", "Hyperparameters"]
    assert joined.shown_tabs()["Metrics"] == ["loss"]
    assert joined.shown_tabs()["Hyperparameters"] == ["Hyperparameters · a", "Hyperparameters · b"]


@pytest.mark.parametrize(
    ("runs", "names", "message"),
    [
        (["a"], None, "paths must be of 2 to 4 recordings, got 1"),
        (["a", "a"], None, "paths must be of different recordings"),
        (["a", "b"], ["x", "x"], "names must be 2 different ones"),
        (["a", "b"], ["x"], "names must be 2 different ones"),
    ],
)
def test_runs_that_cannot_be_joined(tmp_path, runs, names, message):
    for run in set(runs):
        trained(tmp_path / f"{run}.rrd", 0.5)
    with pytest.raises(ValueError, match=message):
        join_recordings([tmp_path / f"{run}.rrd" for run in runs], tmp_path / "both.rrd", names=names)
    assert not (tmp_path / "both.rrd").exists()


def test_runs_are_called_by_what_tells_them_apart(tmp_path):
    (tmp_path / "small").mkdir()
    assert run_names([tmp_path / "small", Path("b.rrd")]) == ["small", "b"]
    assert run_names([Path("small/run.rrd"), Path("large/run.rrd")]) == ["small", "large"]
    assert run_names([Path("x/logs/run.rrd"), Path("y/logs/run.rrd")]) == ["x", "y"]
    assert run_names([Path("x/run.rrd"), Path("x/run.rrd")]) == ["run-1", "run-2"]
