"""Matching by a network: the same in threads, on a cluster, alone, and in a run that goes on."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from random_weights import write_comparing_lightglue
from results import hdf5_content

from colmap_affrect.errors import StaleStoreError, WeightsError
from colmap_affrect.parallel.cluster import connected
from colmap_affrect.parallel.executor import Executor, Threads
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.context import Context, Resources
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.inputs import Inputs
from colmap_affrect.stages.match import match
from colmap_affrect.stages.one_pair import CachedMatcher, Matching, iterate_matches
from colmap_affrect.stages.pairs import choose_pairs, listed_pairs

RECIPE = load_recipe("sift-lightglue", ["matching.max_num_features=120"])


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    write_comparing_lightglue(folder / "sift_lightglue.pth")
    return folder


@pytest.fixture(scope="module")
def extracted(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An output folder before matching."""
    out = tmp_path_factory.mktemp("out")
    with Workspace(out).locked() as workspace:
        extract(Context(workspace), Inputs.of(photos), RECIPE)
        choose_pairs(Context(workspace))
    return out


def matched(
    out: Path, extracted: Path, weights: Path, executor: Executor
) -> dict[str, tuple[str, bytes]]:
    """Match in a copy of the folder, or in the folder if it is there already."""
    if not out.exists():
        shutil.copytree(extracted, out)
    with Workspace(out).locked() as workspace:
        match(Context(workspace, Resources(weights, "cpu"), executor))
    return hdf5_content(Workspace(out).matches)


@pytest.mark.long
def test_matches_of_other_weights_are_not_mixed(
    tmp_path: Path, extracted: Path, weights: Path
) -> None:
    matched(tmp_path / "out", extracted, weights, Threads(1))
    workspace = Workspace(tmp_path / "out")
    assert list(workspace.recorded()["match"]["weights"]) == ["lightglue-sift"]
    assert Context(workspace).matching == RECIPE.matching
    write_comparing_lightglue(tmp_path / "sift_lightglue.pth", sharpness=30.0)
    with pytest.raises(StaleStoreError, match="match stage was run there with weights"):
        matched(tmp_path / "out", extracted, tmp_path, Threads(1))


@pytest.mark.long
def test_threads_one_pair_alone_and_a_resumed_run_find_the_same(
    tmp_path: Path, extracted: Path, weights: Path
) -> None:
    expected = matched(tmp_path / "one", extracted, weights, Threads(1))
    assert matched(tmp_path / "two", extracted, weights, Threads(2)) == expected
    context = Context(Workspace(tmp_path / "one"), Resources(weights, "cpu"))
    pairs = listed_pairs(context)
    assert sum(len(found.scores) for found in context.matches.read(pairs)) > 50
    matching = Matching(
        context.features, RECIPE.matching, extractor="rootsift", resources=context.resources
    )
    (alone,) = iterate_matches(pairs[3:4], matching, Threads(1))
    (stored,) = context.matches.read(pairs[3:4])
    np.testing.assert_array_equal(alone.indices, stored.indices)
    assert len(np.unique(stored.scores)) > 3
    with h5py.File(context.workspace.matches, "a") as file:  # as if the run had been killed
        for key in list(file)[1:]:
            del file[key]
    assert matched(tmp_path / "one", extracted, weights, Threads(2)) == expected


@pytest.mark.long
def test_cluster_finds_what_threads_find(
    tmp_path: Path, extracted: Path, weights: Path, address: str
) -> None:
    expected = matched(tmp_path / "local", extracted, weights, Threads(2))
    with connected(address) as cluster:
        assert matched(tmp_path / "cluster", extracted, weights, cluster) == expected


def test_workers_with_other_weights_are_refused(
    tmp_path: Path, extracted: Path, weights: Path
) -> None:
    folder = tmp_path / "weights"
    shutil.copytree(weights, folder)
    store = Context(Workspace(extracted)).features
    resources = Resources(folder, "cpu")
    matching = Matching(store, RECIPE.matching, resources=resources)
    rebuild, given = CachedMatcher(matching).__reduce__()
    rebuild(*given)
    state = torch.load(folder / "sift_lightglue.pth", weights_only=True)
    torch.save(
        state | {"posenc.Wr.weight": state["posenc.Wr.weight"] + 1}, folder / "sift_lightglue.pth"
    )
    with pytest.raises(WeightsError, match=r"sift_lightglue\.pth: is another file than"):
        rebuild(*given)
