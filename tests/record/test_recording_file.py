"""The file of a recording is there whole or not at all."""

from __future__ import annotations

import os

import pytest
from recordings import Recording, make_rollout

from lw_torchrl.record import RerunLogger


def test_no_file_before_the_end(tmp_path):
    path = tmp_path / "a.rrd"
    logger = RerunLogger(path)
    logger.log_scalar("loss", 1.0)
    logger.flush()
    assert not path.exists()
    logger.shutdown()
    assert os.listdir(tmp_path) == ["a.rrd"]


def test_ending_the_experiment_ends_the_logger(tmp_path):
    # What torchrl's service backends do instead of shutdown().
    logger = RerunLogger(tmp_path / "a.rrd")
    logger.log_scalar("loss", 1.0)
    logger.flush()
    logger.experiment.finish()
    assert not logger.is_alive
    assert "/metrics/loss" in Recording(tmp_path / "a.rrd").entities()


def test_an_older_file_is_replaced_at_the_end(tmp_path):
    path = tmp_path / "a.rrd"
    path.write_bytes(b"older")
    with RerunLogger(path) as logger:
        logger.log_scalar("loss", 1.0)
        assert path.read_bytes() == b"older"
    assert "/metrics/loss" in Recording(path).entities()


def test_an_error_leaves_the_path_untouched(tmp_path):
    path = tmp_path / "a.rrd"
    path.write_bytes(b"older")
    logger = RerunLogger(path)

    def interrupted():
        with logger:
            logger.log_episode(make_rollout(), task="push", objects={})
            raise KeyError("mine")

    with pytest.raises(KeyError):
        interrupted()
    assert not logger.is_alive
    assert path.read_bytes() == b"older"
    assert os.listdir(tmp_path) == ["a.rrd"]


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
        RerunLogger(None)
