"""What an idle run reads in the place of features, and when it does not count."""

from __future__ import annotations

import json
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.data import LocalFeatures
from colmap_affrect.geometry.lines import FOCALS, SHIFTS, LineLikelihood, Lines
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.project import feature_store, feature_summary
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.feature_summary import summary_path
from colmap_affrect.project.record import Content
from colmap_affrect.project.sealed_json import write_sealed

NAMES = ("a.png", "west wing/č ñ 图.jpg", "without lines.png")
SIZE = (320, 240)


def some_features(count: int) -> LocalFeatures:
    lafs = np.tile(np.eye(2, 3), (count, 1, 1))
    descriptors = np.ones((count, 8), np.float32)
    return LocalFeatures(lafs, np.ones(count, np.float32), descriptors)


def some_lines(seed: int) -> Lines:
    random = np.random.default_rng(seed)
    segments = Segments(random.normal(size=(7, 2)), random.normal(size=(7, 2)))
    shape = (len(FOCALS), len(SHIFTS))
    rotations = random.normal(size=(*shape, 3, 3))
    return Lines(segments, LineLikelihood(random.normal(size=shape), rotations))


@pytest.fixture
def store(tmp_path: Path) -> FeatureStore:
    """Three images; the third has no straight lines on record."""
    store = FeatureStore(tmp_path / "features.h5")
    for number, name in enumerate(NAMES):
        store.write(
            name,
            some_features(number + 2),
            SIZE,
            content=Content(f"digest {number}", f"stamp {number}"),
            lines=some_lines(number) if number < 2 else None,
        )
    return store


def known(store: FeatureStore) -> dict[str, object]:
    """What commands ask of all images."""
    lines = {}
    for name, found in store.line_findings().items():
        camera = found.camera
        values = (
            [np.asarray(value).tolist() for value in astuple(camera)] if camera else []
        )
        lines[name] = (found.num_segments, found.says_shifted, values)
    return {
        "contents": store.contents(),
        "num_keypoints": store.num_keypoints(),
        "image_sizes": store.image_sizes(),
        "lines": lines,
    }


def test_summaries_say_to_the_last_bit_what_the_features_say(
    store: FeatureStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = known(store)
    assert set(store.line_findings()) == set(NAMES[:2])
    store.keep_summaries()
    feature_store._forget_summaries()
    monkeypatch.setattr("colmap_affrect.project.feature_store.entries_of", None)
    monkeypatch.setattr(FeatureStore, "lines_of", None)
    assert known(store) == before


def test_a_change_of_the_features_removes_their_summaries(store: FeatureStore) -> None:
    store.keep_summaries()
    store.remove([NAMES[0]])
    assert not summary_path(store.path).exists()
    assert set(store.num_keypoints()) == set(NAMES[1:])
    assert set(store.line_findings()) == {NAMES[1]}


def test_features_that_somebody_else_has_written_have_no_summaries(
    store: FeatureStore,
) -> None:
    store.keep_summaries()
    other = FeatureStore(store.path.with_name("other.h5"))
    other.write("b.png", some_features(9), SIZE)
    other.path.replace(store.path)
    feature_store._forget_summaries()
    assert store.num_keypoints() == {"b.png": 9}
    assert not store.line_findings()


@pytest.mark.parametrize("damage", ["digit", "end", "version", "camera", "kind"])
def test_summaries_that_are_damaged_or_of_another_version_do_not_count(
    store: FeatureStore, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    before = known(store)
    store.keep_summaries()
    path = summary_path(store.path)
    text = path.read_text(encoding="utf-8")
    values = json.loads(text)
    del values["sha256"]
    if damage == "digit":
        path.write_text(text.replace("320", "321", 1), encoding="utf-8")
    elif damage == "end":
        path.write_text(text[:-40], encoding="utf-8")
    elif damage == "version":
        monkeypatch.setattr(feature_summary, "FORMAT_VERSION", 0)
    elif damage == "camera":
        values["images"][NAMES[0]][3][2].pop()
        write_sealed(path, json.dumps(values))
    else:
        values["images"][NAMES[0]][1] = "many"
        write_sealed(path, json.dumps(values))
    feature_store._forget_summaries()
    assert known(store) == before


def test_the_version_counts_up_when_the_same_features_give_other_summaries() -> None:
    camera = some_lines(0).findings().camera
    assert camera is not None
    values = (camera.focal, camera.focal_sigma, camera.shift, camera.shift_sigma)
    assert (feature_summary.FORMAT_VERSION, *values) == pytest.approx(
        (2, 1.109972035, 0.447753075, 1.153226e-4, 0.018682949), rel=1e-6
    ), "priors of lines have changed: count feature_summary.FORMAT_VERSION up"
