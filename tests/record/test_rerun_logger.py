"""RerunLogger as a TorchRL logger: metrics, videos, hyperparameters and histograms are read back exactly."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from recordings import Recording
from tensordict import TensorDict
from torchrl.record.loggers import Logger

from lw_torchrl.record import RerunLogger


def test_rerun_logger_behaves_as_a_torchrl_logger(tmp_path):
    logger = RerunLogger(tmp_path / "runs" / "a.rrd")
    assert isinstance(logger, Logger)
    assert logger.start() is logger
    assert (logger.is_alive, logger.exp_name, logger.log_dir) == (True, "a", str(tmp_path / "runs"))
    assert "open" in repr(logger)
    for close in (logger.shutdown, logger.shutdown, logger.close):
        close()
    assert not logger.is_alive
    assert "closed" in repr(logger)
    with pytest.raises(RuntimeError, match="cannot be restarted"):
        logger.start()
    with pytest.raises(RuntimeError, match="was shut down"):
        logger.log_scalar("loss", 1.0)


def test_numbers_are_counted_and_several_of_one_name_are_several_curves(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_scalar("counted", 1)
        logger.log_scalar("counted", torch.tensor([2.0]))
        logger.log_metrics({"nan": float("nan")}, step=0)
        logger.log_scalar("eval/success", torch.tensor([[1.0, 2.0], [3.0, 4.0]]), step=1)
        logger.log_metrics(TensorDict({"eval": {"success": torch.tensor([5.0, 6.0])}}), step=2)
        logger.log_scalar("eval/success", True, step=3)
        for wrong in ("high", "1.5", None, torch.zeros(0), torch.zeros(65)):
            with pytest.raises(ValueError, match="loss/bc"):
                logger.log_scalar("loss/bc", wrong)
        with pytest.raises(ValueError, match="name"):
            logger.log_scalar("loss//bc", 1.0)
        state = logger.state_dict()
    recording = Recording(tmp_path / "a.rrd")
    assert recording.times("/metrics/counted", "Scalars:scalars", "global_step") == [0, 1]
    assert np.isnan(recording.values("/metrics/nan", "Scalars:scalars")[0][0])
    assert recording.values("/metrics/eval/success", "Scalars:scalars") == [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0], [1.0]]
    assert recording.times("/metrics/eval/success", "Scalars:scalars", "global_step") == [1, 2, 3]
    names = recording.values("/metrics/eval/success", "SeriesLines:names")
    assert names == [["success 0", "success 1", "success 2", "success 3"]]
    with RerunLogger(tmp_path / "b.rrd") as logger:  # counters are saved and restored
        logger.load_state_dict(state)
        logger.log_scalar("counted", 1.0)
    assert Recording(tmp_path / "b.rrd").times("/metrics/counted", "Scalars:scalars", "global_step") == [2]


def test_each_group_of_metrics_has_a_view(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        for name in ("loss/bc", "loss/latent", "eval/success", "lr", "eval/reach/success"):
            logger.log_scalar(name, 1.0)
        logger.log_histogram("action", [1.0, 2.0])
        logger.log_video("view", torch.zeros(2, 3, 4, 4, dtype=torch.uint8), step=3)
    tabs = {"Metrics": ["loss", "eval", "lr"], "Histograms": ["action"], "Videos": ["view/step 3"]}
    assert Recording(tmp_path / "a.rrd").shown_tabs() == tabs


@pytest.mark.parametrize("channels", [1, 3])
def test_videos_are_read_back(tmp_path, channels):
    t, c, y, x = np.ogrid[:4, :channels, :24, :32]
    video = torch.as_tensor((10 * t + 30 * c + 3 * y + 2 * x).astype(np.uint8))  # without noise, which JPEG changes
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_video("plain", video)
        logger.log_video("batched", video[None], step=100, fps=10)
    recording = Recording(tmp_path / "a.rrd")
    for entity in ("/videos/plain", "/videos/batched/step\\ 100"):
        shown = np.stack(recording.images(entity)).reshape(4, 24, 32, channels).astype(int)
        assert np.abs(shown - video.permute(0, 2, 3, 1).numpy()).max() < 12
    seconds = recording.times("/videos/batched/step\\ 100", "EncodedImage:blob", "time")
    assert [int(second) for second in seconds] == [0, 100_000_000, 200_000_000, 300_000_000]


def test_hyperparameters_are_a_table(tmp_path):
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_hparams({"lr": 3e-4, "actor": {"width": 256, "note": "a|b"}})
        logger.log_hparams({"seed": 0})
    text = Recording(tmp_path / "a.rrd").values("/hparams", "TextDocument:text")[-1][0]
    for row in ("| lr | 0.0003 |", "| actor.width | 256 |", "| actor.note | a\\|b |", "| seed | 0 |"):
        assert row in text


def test_histograms_are_read_back(tmp_path):
    data = torch.randn(3, 50)
    with RerunLogger(tmp_path / "a.rrd") as logger:
        logger.log_histogram("actor/action", data, step=5, bins=7)
        logger.log_histogram("list", [1, 2, 2])
    recording = Recording(tmp_path / "a.rrd")
    counts, edges = np.histogram(data.double().numpy(), bins=7)
    entity = "/histograms/actor/action"
    assert recording.times(entity, "BarChart:values", "global_step") == [5]
    assert [row[0]["buffer"] for row in recording.values(entity, "BarChart:values")] == [counts.tolist()]
    centers = [row[0]["buffer"] for row in recording.values(entity, "BarChart:abscissa")]
    assert centers == [((edges[1:] + edges[:-1]) / 2).tolist()]
    np.testing.assert_allclose(recording.values(entity, "BarChart:widths"), [np.diff(edges)], rtol=1e-6)


def test_episodes_of_several_threads_have_different_names(tmp_path):
    rollout = TensorDict({"observation": torch.rand(5, 39), "action": torch.rand(5, 4)}, [5])
    objects = {"puck": rollout["observation"][:, 4:7]}
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with RerunLogger(tmp_path / "a.rrd") as logger, ThreadPoolExecutor(4) as threads:
            names = list(threads.map(lambda _: logger.log_episode(rollout, task="reach", objects=objects), range(24)))
    finally:
        sys.setswitchinterval(before)
    assert sorted(names) == sorted({"reach", *(f"reach-{number}" for number in range(2, 25))})
