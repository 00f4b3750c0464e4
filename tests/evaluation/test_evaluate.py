"""Evaluation as a whole on small planar pairs: results, resuming, budget, failures, command."""

from __future__ import annotations

import json
import math
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import run_in_process_of_its_own
from posed_photographs import TRUTH, write_extreme_views, write_imc

from colmap_affrect.errors import OptionError
from colmap_affrect.evaluation.datasets import load_evd
from colmap_affrect.evaluation.evaluate import (
    PROTOCOLS,
    EvaluateOptions,
    RecipeRun,
    evaluate,
)
from colmap_affrect.evaluation.results import Evaluation, RecipeResult
from colmap_affrect.evaluation.truths import ScoreOptions, TrueHomography
from colmap_affrect.stages.one_image import ImageExtractor

Done = tuple[Path, Evaluation]
Patch = pytest.MonkeyPatch
Calls = Counter[str]
PLAIN = "unrectified-rootsift"
RECIPES = (PLAIN, "rectified=rectified:max_image_size_px=120")
NAMES = ["cafe", "dance", "shop"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_extreme_views(tmp_path_factory.mktemp("evd"), NAMES)


@pytest.fixture(scope="module")
def done(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Done:
    out = tmp_path_factory.mktemp("out")
    return out, run(dataset, out)


@pytest.fixture
def copied(done: Done, tmp_path: Path) -> Path:
    return shutil.copytree(done[0], tmp_path / "out")


@pytest.fixture
def changed(dataset: Path, tmp_path: Path) -> Path:
    return shutil.copytree(dataset, tmp_path / "changed")


@pytest.fixture
def calls(monkeypatch: Patch) -> Calls:
    """Count images extracted and pairs scored."""
    counts: Calls = Counter()
    counted_functions = (
        (ImageExtractor, ImageExtractor.extract_file),
        (TrueHomography, TrueHomography.score),
    )
    for owner, function in counted_functions:

        def counted(*given: Any, function: Any = function) -> Any:
            counts[function.__name__] += 1
            return function(*given)

        monkeypatch.setattr(owner, function.__name__, counted)
    return counts


def run(
    path: Path, out: Path, recipes: Sequence[str] = RECIPES, **options: Any
) -> Evaluation:
    scores = ScoreOptions(max_num_iterations=2000)
    return evaluate(
        "evd", path, out, EvaluateOptions(recipes=recipes, scores=scores, **options)
    )


def errors(recipe: RecipeResult) -> list[float]:
    return [pair.error for pair in recipe.pairs]


def test_every_recipe_solves_easy_pairs(done: Done) -> None:
    _, evaluation = done
    assert [recipe.name for recipe in evaluation.recipes] == [PLAIN, "rectified"]
    for recipe in evaluation.recipes:
        assert [pair.name for pair in recipe.pairs] == NAMES
        assert max(errors(recipe)) < 1.0
        assert recipe.summary["homographies"]["< 1 px"] == 3
        assert (recipe.costs["solved"], recipe.costs["failed"]) == (1.0, 0)
        assert recipe.costs["seconds"] == sum(pair.seconds for pair in recipe.pairs)
        for pair in recipe.pairs:
            assert 4 <= pair.num_inliers <= pair.num_matches <= min(pair.num_keypoints)
            assert (pair.level, pair.failure) == ("", "")


def test_files_and_tables_say_the_same(done: Done) -> None:
    out, evaluation = done
    text = (out / "evaluation.json").read_text(encoding="utf-8")
    assert text == evaluation.to_json()
    values = json.loads(text)
    assert (values["protocol"], values["settings"]["scores"]["threshold_px"]) == (
        "evd",
        0.5,
    )
    pair = values["recipes"]["rectified"]["pairs"][0]
    assert {"name", "error", "num_inliers", "seconds"} <= pair.keys()
    row = evaluation.published["paper: AffNetShapes (Table 2: EVD, 15 pairs)"]
    assert list(row.items())[4:] == [
        ("< 10 px", 9),
        ("< 20 px", 10),
        ("seconds", 185.47),
    ]
    (line,) = (
        s for s in evaluation.summary().splitlines() if s.startswith("paper: AffNetS")
    )
    assert line.split()[-7:] == ["0", "2", "5", "8", "9", "10", "185.47"]


def test_features_are_kept_and_truths_read_again(
    changed: Path, tmp_path: Path, calls: Calls
) -> None:
    for truth in (TRUTH, np.diag([1, 1, 0.5]) @ TRUTH):
        np.savetxt(changed / "h" / "dance.txt", truth)
        (recipe,) = run(changed, tmp_path / "out", RECIPES[:1]).recipes
    assert calls["extract_file"] == 6
    cafe, dance, _ = errors(recipe)
    assert dance > 20.0 > cafe


def test_budget_takes_the_strongest(dataset: Path, copied: Path, calls: Calls) -> None:
    budgeted = run(dataset, copied, max_num_keypoints=60)
    assert (calls["extract_file"], calls["score"]) == (0, 6)
    for recipe in budgeted.recipes:
        assert {pair.num_keypoints for pair in recipe.pairs} == {(60, 60)}
    # Of features that were cut at random hardly any would match.
    assert budgeted.recipes[0].summary["homographies"]["< 5 px"] == 3


def test_damaged_image_fails_its_pair_and_the_others_go_on(
    changed: Path, tmp_path: Path, monkeypatch: Patch
) -> None:
    """It is damaged after the data set was read."""
    loaded = load_evd(changed)
    (changed / "2" / "dance.png").write_bytes(b"no image")
    monkeypatch.setitem(PROTOCOLS, "evd", lambda _: loaded)
    evaluation = run(changed, tmp_path / "out", RECIPES[:1])
    (recipe,) = evaluation.recipes
    assert [pair.name for pair in recipe.pairs if pair.failure] == ["dance"]
    assert errors(recipe)[:2] == [pytest.approx(0.0, abs=1.0), math.inf]
    assert recipe.summary["homographies"]["< 20 px"] == 2
    assert "2/dance.png" in recipe.failures
    values = json.loads(evaluation.to_json())
    assert values["recipes"][recipe.name]["pairs"][1]["error"] is None


@pytest.fixture
def climbing(tmp_path: Path) -> str:
    path = tmp_path / "climbing.toml"
    levels = '[[escalation]]\nrectifier.name = "dense-shapes"\n' * 2
    path.write_text(f'[rectifier]\nname = "identity"\n{levels}')
    return f"climbing={path}:escalate.strong_num_inliers="


@pytest.mark.parametrize(("inliers", "strong", "level", "num_levels"), [
    ((20, 16, 10), 30, "identity", 3),
    ((20, 30, 99), 30, "dense-shapes", 2),
])  # fmt: skip
def test_escalation_stops_where_it_suffices_and_most_verified_inliers_count(
    inliers: tuple[int, ...], strong: int, level: str, num_levels: int,
    changed: Path, tmp_path: Path, climbing: str, monkeypatch: Patch, calls: Calls,
) -> None:  # fmt: skip
    for path in changed.glob("*/[ds]*"):
        path.unlink()
    monkeypatch.setattr(
        RecipeRun, "_verified_inliers", lambda *given: inliers[given[-1]]
    )
    (recipe,) = run(changed, tmp_path / "out", [f"{climbing}{strong}"]).recipes
    assert (recipe.pairs[0].level, calls["extract_file"]) == (level, 2 * num_levels)
    assert recipe.summary["homographies"]["< 1 px"] == 1


@pytest.mark.parametrize(("protocol", "options", "message"), [
    ("evd", EvaluateOptions(recipes=["sift"]), "sift is COLMAP's and no recipe"),
    ("evd", EvaluateOptions(max_num_keypoints=0), "--max-num-keypoints 0: must be at least 1"),
    ("megadepth", EvaluateOptions(), "unknown protocol 'megadepth'; give evd or svp"),
])  # fmt: skip
def test_bad_options(
    protocol: str, options: Any, message: str, dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=message):
        evaluate(protocol, dataset, tmp_path, options)


def test_poses_are_evaluated_by_category(tmp_path: Path) -> None:
    scene = write_imc(tmp_path / "set" / "garden")
    options = EvaluateOptions(
        recipes=[PLAIN], scores=ScoreOptions(max_num_iterations=1000)
    )
    (recipe,) = evaluate("imc", scene, tmp_path / "out", options).recipes
    columns = ("0.1", "0.2", "all")
    assert [recipe.summary["poses"][column] for column in columns] == [1.0] * 3


@pytest.mark.long
def test_command_prints_tables_and_errors_are_one_line(
    dataset: Path, tmp_path: Path
) -> None:
    common = ["evaluate", "evd", "--output-path", tmp_path / "out", "-q"]
    ended = run_in_process_of_its_own(
        *common, "--dataset-path", dataset, "--recipes", PLAIN,
    )  # fmt: skip
    assert (ended.code, ended.errors) == (0, [])
    assert "< 1 px  < 2 px  < 3 px  < 5 px  < 10 px  < 20 px  seconds" in ended.stdout
    row = next(
        line for line in ended.stdout.splitlines() if line.startswith("unrectified-roo")
    )
    assert row.split()[1:7] == ["3"] * 6
    missing = run_in_process_of_its_own(*common, "--dataset-path", tmp_path / "nowhere")
    assert missing.code == 2
    assert missing.errors == [
        f"error: {tmp_path / 'nowhere'}: no such folder; give the folder of the dataset"
    ]
