"""Depth networks: tiny ones of random weights through the real loading code, kinds and cache."""

from __future__ import annotations

import json
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from depth_photographs import (
    CAMERA,
    COURTYARD,
    FLOAT32_RTOL,
    courtyard_photograph,
    photograph,
    slanted_plane,
)
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import write_image

from colmap_affrect.errors import DepthError
from colmap_affrect.images.depth import (
    NETWORK_IMAGE_SIZE_PX,
    DepthContext,
    MonocularDepth,
    MonocularOptions,
)


def monocular(model, cache, kind="z"):
    return MonocularDepth(MonocularOptions(model=model, kind=kind), DepthContext(cache))


@pytest.fixture(scope="module")
def transformers():
    """The package, told before it is imported that there is no network."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_HUB_OFFLINE", "1")
        reason = "transformers (the extra 'depth') is not installed"
        transformers = pytest.importorskip("transformers", reason=reason)
        patch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
        yield transformers


def save_network(model, folder, processor, dtype="float32"):
    """Save a model of random weights that are the same in all versions of torch."""
    import torch

    rng = np.random.default_rng(3)
    with torch.no_grad():
        for name, values in model.named_parameters():
            if values.ndim > 1:
                weights = rng.normal(0.0, values[0].numel() ** -0.5, tuple(values.shape))
                values.copy_(torch.from_numpy(weights))
            if name == "head.conv3.bias":  # the last one of Depth Anything: away from 0
                values.fill_(3.0)
    model.to(getattr(torch, dtype)).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    return str(folder)


def relative_network(transformers, folder, **options):
    """Save a Depth Anything of two layers, which predicts inverse depth; return its folder."""
    backbone = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=2, num_attention_heads=2, mlp_ratio=2, image_size=56,
        out_features=["stage1", "stage2"], reshape_hidden_states=False,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, reassemble_factors=[1, 0.5],
        neck_hidden_sizes=[8, 8], fusion_hidden_size=8, head_hidden_size=8,
    )  # fmt: skip
    processor = {
        "image_processor_type": "DPTImageProcessor", "size": {"height": 112, "width": 112},
        "keep_aspect_ratio": True, "ensure_multiple_of": 14,
    }  # fmt: skip
    model = transformers.DepthAnythingForDepthEstimation(config)
    return save_network(model, folder, processor, **options)


@pytest.fixture(scope="module")
def model(transformers, tmp_path_factory):
    return relative_network(transformers, tmp_path_factory.mktemp("relative"))


COURT_1 = courtyard_photograph("court_1.jpg")


@pytest.mark.long
def test_network_of_relative_inverse_depth(transformers, model):
    depth = monocular(model, None).depth(COURT_1)
    assert depth.shape == (540, 720)
    assert depth.dtype == np.float32
    assert np.nanmin(depth) == 1.0, "the largest disparity is the unit"
    assert 1.01 < np.nanmax(depth) <= 100.0
    network = transformers.pipeline("depth-estimation", model=model, device="cpu")
    from PIL import Image

    disparity = network(Image.open(COURT_1.path))["predicted_depth"].numpy()
    assert disparity.shape == depth.shape
    assert_allclose(depth, disparity.max() / disparity, rtol=1e-5)


@pytest.mark.long
def test_model_that_is_no_depth_network_or_not_there_is_one_clear_error(transformers, tmp_path):
    config = transformers.Dinov2Config(hidden_size=16, num_hidden_layers=1, num_attention_heads=1)
    transformers.Dinov2Model(config).save_pretrained(tmp_path / "backbone")
    cache = tmp_path / "cache"
    for name in ("nobody/no-such-model", str(tmp_path), str(tmp_path / "backbone")):
        network = monocular(name, cache)
        for call in (lambda n=network: n.depth(COURT_1), lambda n=network: n.require_some(["a"])):
            with pytest.raises(DepthError) as error:
                call()
            assert str(error.value).startswith(f"{name}: cannot be loaded as a depth network (")
            assert "local folder" in str(error.value)
            assert "\n" not in str(error.value)
    assert not cache.exists()


@pytest.mark.parametrize("package", ["transformers", "PIL"])
def test_missing_package_is_named_with_the_command_that_installs_it(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    message = 'depth from a network needs transformers: pip install "colmap-affrect[depth]"'
    network = monocular("some/model", None)
    for call in (lambda: network.depth(COURT_1), lambda: network.require_some(["a.jpg"])):
        with pytest.raises(DepthError) as error:
            call()
        assert str(error.value) == message


# --- networks: kinds, cache and threads, with a pipeline whose prediction is known


class FakePipelines:
    """Stands for ``transformers.pipeline``; counts what is loaded and what is predicted."""

    def __init__(self, prediction, **config):
        self.prediction = prediction
        self.config = SimpleNamespace(**config)
        self.model = SimpleNamespace(config=self.config, float=lambda: None)
        self.loaded, self.sizes = [], []
        self.busy = threading.Lock()

    def load(self, task, model, device, trust_remote_code):
        assert (task, trust_remote_code) == ("depth-estimation", False)
        self.loaded.append((model, device))
        return self

    def __call__(self, image):
        import torch

        assert self.busy.acquire(blocking=False), "two threads at one network"
        self.sizes.append(image.size)
        time.sleep(0.01)
        self.busy.release()
        return {"predicted_depth": torch.tensor(self.prediction)}


@pytest.fixture
def fake(monkeypatch):
    def install(prediction, **config):
        pipelines = FakePipelines(prediction, **config)
        package = SimpleNamespace(pipeline=pipelines.load)
        monkeypatch.setitem(sys.modules, "transformers", package)
        return pipelines

    return install


RELATIVE = dict(model_type="depth_anything", depth_estimation_type="relative")
METRIC = dict(model_type="zoedepth")
DPT = dict(model_type="dpt", add_projection=False)  # as MiDaS; with a projection it is metric

NAN = np.nan
PLANE, PLANE_RAYS = slanted_plane((12, 8), CAMERA)


@pytest.mark.parametrize(
    ("config", "kind", "predicted", "expected"),
    [
        # Inverse depth: 1 at its largest, unknown below a hundredth of it.
        (
            RELATIVE,
            "z",
            [[50.0, 25.0, 5.0], [0.51, 0.49, -0.1]],
            [[1, 2, 10], [50 / 0.51, NAN, NAN]],
        ),
        (DPT, "z", [[50.0, 25.0]], [[1, 2]]),
        ({**DPT, "add_projection": True}, "z", [[50.0, 25.0]], [[50, 25]]),
        (METRIC, "z", [[[5.0, 2.5, 0.5], [0.0, -0.1, NAN]]], [[5, 2.5, 0.5], [NAN] * 3]),
        (METRIC, "inverse", [[4.0, 2.0]], [[1.0, 2.0]]),
        (METRIC, "ray", PLANE_RAYS, PLANE),
    ],
)
def test_prediction_becomes_depth_by_its_kind(fake, config, kind, predicted, expected):
    fake(predicted, **config)
    network = monocular("m", None, kind)
    assert_allclose(network.depth(photograph()), expected, rtol=FLOAT32_RTOL)


def test_photographs_reach_the_network_shrunk_and_as_rgb(fake, tmp_path, monkeypatch):
    fake([[1.0, 2.0]], **METRIC)
    seen = []
    monkeypatch.setattr("PIL.Image.fromarray", lambda pixels: seen.append(pixels) or MagicMock())
    bgr = np.full((300, 2000, 3), (10, 60, 200), np.uint8)
    path = write_image(tmp_path / "large.png", bgr)
    monocular("m", None).depth(photograph(path=path))
    assert seen[0].shape == (154, NETWORK_IMAGE_SIZE_PX, 3)
    assert seen[0][0, 0].tolist() == [200, 60, 10]


PREDICTION = [[5.0, 2.5, 0.5], [0.3, 0.2, 0.125]]


@pytest.mark.parametrize("config", [RELATIVE, METRIC])
def test_prediction_is_kept_and_used_again_without_loading_the_network(fake, tmp_path, config):
    pipelines = fake(PREDICTION, **config)
    image = replace(COURT_1, name="side ž/court 1.jpg")
    depth = monocular("m", tmp_path).depth(image)
    again = monocular("m", tmp_path)
    again.require_some([image.name])
    assert_array_equal(again.depth(image), depth)
    inverse = monocular("m", tmp_path, "inverse").depth(image)
    assert_allclose(inverse, 5.0 / np.array(PREDICTION), rtol=FLOAT32_RTOL)
    assert (pipelines.loaded, len(pipelines.sizes)) == ([("m", "cpu")], 1)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert files == [tmp_path / "side ž" / "court 1.jpg.npz"]


def test_prediction_is_made_again_for_another_model_or_other_pixels(fake, tmp_path):
    pipelines = fake(PREDICTION, **METRIC)
    monocular("m", tmp_path).depth(COURT_1)
    other = monocular("other", tmp_path)
    other.depth(COURT_1)
    assert [model for model, _ in pipelines.loaded] == ["m", "other"]
    other.depth(replace(COURT_1, path=COURTYARD / "images" / "court_2.jpg"))
    other.depth(replace(COURT_1, path=COURTYARD / "images" / "court_2.jpg"))
    assert len(pipelines.sizes) == 3


def test_damaged_cache_is_written_again(fake, tmp_path):
    pipelines = fake(PREDICTION, **METRIC)
    depth = monocular("m", tmp_path).depth(COURT_1)
    file = tmp_path / "court_1.jpg.npz"
    good = file.read_bytes()
    file.write_bytes(good[: len(good) // 2])
    assert_array_equal(monocular("m", tmp_path).depth(COURT_1), depth)
    assert len(pipelines.sizes) == 2


def test_threads_share_one_network_and_take_turns(fake, tmp_path):
    pipelines = fake(PREDICTION, **METRIC)
    network = monocular("m", tmp_path)
    images = [photograph(f"{number}.jpg") for number in range(8)]
    with ThreadPoolExecutor(4) as pool:
        depths = list(pool.map(network.depth, images))
    assert pipelines.loaded == [("m", "cpu")]
    assert len(pipelines.sizes) == len(depths) == 8
