"""RerunLogger as a torchrl Logger: numbers, videos, configurations and histograms can be read back exactly."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from recordings import Recording
from tensordict import TensorDict
from torchrl.record import VideoRecorder
from torchrl.record.loggers import Logger

from lw_torchrl.record import RerunLogger


def test_it_is_a_torchrl_logger(tmp_path):
    logger = RerunLogger(tmp_path / "runs" / "a.rrd")
    assert isinstance(logger, Logger)
    assert logger.start() is logger
    assert logger.is_alive
    assert logger.exp_name == "a"
    assert logger.log_dir == str(tmp_path / "runs")
    assert "open" in repr(logger)
    logger.shutdown()
    logger.shutdown()
    logger.close()
    assert not logger.is_alive
    assert "closed" in repr(logger)
    with pytest.raises(RuntimeError, match="cannot be restarted"):
        logger.start()
    with pytest.raises(RuntimeError, match="takes nothing more"):
        logger.log_scalar("loss", 1.0)


def test_scalars(tmp_path):
    with RerunLogger(tmp_path / "a.rrd", exp_name="run") as logger:
        for i in range(3000):
            logger.log_scalar("loss/bc", 1.0 / (i + 1), step=10 * i)
        logger.log_scalar("counted", 1)
        logger.log_scalar("counted", torch.tensor([2.0]))
        logger.log_metrics(TensorDict({"eval": {"success": torch.tensor(0.5)}}), step=7)
        logger.log_metrics({"nan": float("nan")}, step=0)
        with pytest.raises(ValueError, match="value of 'loss/bc' must be one number"):
            logger.log_scalar("loss/bc", [1.0, 2.0])
        with pytest.raises(ValueError, match="name must be"):
            logger.log_scalar("loss//bc", 1.0)
    found = Recording(tmp_path / "a.rrd")
    loss = "/metrics/loss/bc", "Scalars:scalars"
    assert found.values(*loss) == [[1.0 / (i + 1)] for i in range(3000)]
    assert found.times(*loss, "global_step") == list(range(0, 30000, 10))
    assert found.times("/metrics/counted", "Scalars:scalars", "global_step") == [0, 1]
    assert found.values("/metrics/eval/success", "Scalars:scalars") == [[0.5]]
    assert np.isnan(found.values("/metrics/nan", "Scalars:scalars")[0][0])


def test_counters_are_saved_and_restored(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_scalar("loss", 1.0)
        logger.log_scalar("loss", 1.0)
        state = logger.state_dict()
    with RerunLogger(tmp_path / "b.rrd") as logger:
        logger.load_state_dict(state)
        logger.log_scalar("loss", 1.0)
    assert Recording(tmp_path / "b.rrd").times("/metrics/loss", "Scalars:scalars", "global_step") == [2]


@pytest.mark.parametrize("channels", [1, 3])
def test_videos(tmp_path, channels):
    video = torch.randint(256, (4, channels, 6, 8), dtype=torch.uint8)
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_video("plain", video)
        logger.log_video("batched", video[None], step=100, fps=10)
        logger.log_video("two", torch.stack([video, video]))
        for wrong in (video.float(), video[0], video[:0], video.expand(4, -1, 6, 8).repeat(1, 2, 1, 1)):
            with pytest.raises(ValueError, match="video 'wrong' must be uint8 of shape T×C×H×W"):
                logger.log_video("wrong", wrong)
    found = Recording(tmp_path / "a.rrd")
    for entity in ("/videos/plain", "/videos/batched/step\\ 100", "/videos/two/0", "/videos/two/1"):
        pixels = found.array(entity, "Image:buffer").reshape(4, 6, 8, channels)
        np.testing.assert_array_equal(pixels, video.permute(0, 2, 3, 1).numpy())
    seconds = found.times("/videos/batched/step\\ 100", "Image:buffer", "time")
    assert [int(second) for second in seconds] == [0, 100_000_000, 200_000_000, 300_000_000]


def test_torchrls_video_recorder(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        recorder = VideoRecorder(logger, tag="rollout", skip=1, make_grid=False)
        frames = torch.randint(256, (5, 3, 4, 4), dtype=torch.uint8)
        for frame in frames:
            recorder._apply_transform(frame)
        recorder.dump()
    found = Recording(tmp_path / "a.rrd")
    (entity,) = {entity for entity in found.entities() if entity.startswith("/videos/")}
    pixels = found.array(entity, "Image:buffer").reshape(-1, 4, 4, 3)
    np.testing.assert_array_equal(pixels, frames[-len(pixels) :].permute(0, 2, 3, 1).numpy())


def test_hparams(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_hparams({"lr": 3e-4, "actor": {"width": 256, "note": "a|b"}})
        logger.log_hparams({"seed": 0})
        with pytest.raises(TypeError, match="cfg must be a mapping"):
            logger.log_hparams("lr=1")
    text = Recording(tmp_path / "a.rrd").values("/hparams", "TextDocument:text")[-1][0]
    for row in ("| lr | 0.0003 |", "| actor.width | 256 |", "| actor.note | a\\|b |", "| seed | 0 |"):
        assert row in text


def test_histograms(tmp_path):
    data = torch.randn(3, 50)
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_histogram("actor/action", data, step=5, bins=7)
        logger.log_histogram("list", [1, 2, 2])
        for wrong in ([], [1.0, float("nan")]):
            with pytest.raises(ValueError, match="data of histogram 'wrong' must be finite and not empty"):
                logger.log_histogram("wrong", wrong)
    found = Recording(tmp_path / "a.rrd")
    counts, edges = np.histogram(data.double().numpy(), bins=7)
    entity = "/histograms/actor/action"
    assert found.times(entity, "BarChart:values", "global_step") == [5]
    assert [row[0]["buffer"] for row in found.values(entity, "BarChart:values")] == [counts.tolist()]
    centers = [row[0]["buffer"] for row in found.values(entity, "BarChart:abscissa")]
    assert centers == [((edges[1:] + edges[:-1]) / 2).tolist()]


def test_importing_loads_no_rerun():
    code = "import sys, lw_torchrl.record; sys.exit('rerun' in sys.modules or 'rerun_bindings' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
