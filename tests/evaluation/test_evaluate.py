"""Evaluation as a whole on small planar pairs: results, resuming, budget, failures, command."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import run_in_process_of_its_own
from planar_pairs import TRUTH, write_extreme_views

from colmap_affrect.errors import EvaluationError, OptionError, StaleStoreError
from colmap_affrect.evaluation import evaluate as module
from colmap_affrect.evaluation.evaluate import EvaluateOptions, evaluate
from colmap_affrect.evaluation.evd import Evd
from colmap_affrect.evaluation.pair_matches import MatchedPair
from colmap_affrect.evaluation.recipe_features import IMAGE_STEPS, RecipeFeatures, RecordFile
from colmap_affrect.evaluation.results import Evaluation, RecipeResult, Solved
from colmap_affrect.matchers import nearest
from colmap_affrect.stages.context import Resources
from colmap_affrect.stages.one_image import ExtractedImage, ImageExtractor

FAST = "default=default:max_image_size_px=120"
RECIPES = ("unrectified-rootsift", FAST)
PROTOCOL = Evd(max_num_iterations=2000, num_magsac_estimates=1)
NAMES = ["cafe", "dance", "shop"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_extreme_views(tmp_path_factory.mktemp("evd"), NAMES)


@pytest.fixture(scope="module")
def done(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Evaluation]:
    out = tmp_path_factory.mktemp("out")
    return out, run(dataset, out, baseline="unrectified-rootsift")


@pytest.fixture(autouse=True)
def _no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots take most of the time; those of ``done`` are drawn."""
    monkeypatch.setattr(module, "write_plots", lambda *_: [])


@pytest.fixture
def copied(done: tuple[Path, Evaluation], tmp_path: Path) -> Path:
    return shutil.copytree(done[0], tmp_path / "out")


@pytest.fixture
def changed(dataset: Path, tmp_path: Path) -> Path:
    """Return a copy of the dataset, to be changed."""
    return shutil.copytree(dataset, tmp_path / "changed")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Count images extracted and pairs scored."""
    counts = {"images": 0, "pairs": 0}

    def count(key: str, owner: type, method: str) -> None:
        function = getattr(owner, method)

        def counted(*arguments):
            counts[key] += 1
            return function(*arguments)

        monkeypatch.setattr(owner, method, counted)

    count("images", RecipeFeatures, "_extract")
    count("pairs", Evd, "score")
    return counts


def run(path: Path, out: Path, recipes: Sequence[str] = RECIPES, **options: Any) -> Evaluation:
    return evaluate(PROTOCOL, path, out, EvaluateOptions(recipes=recipes, **options))


def test_device_reaches_extraction_and_matching(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    matched: list[str] = []
    extracted: list[str] = []
    extract = ImageExtractor.extract

    def watched(extractor: ImageExtractor, *arguments: Any) -> ExtractedImage:
        extracted.append(extractor.resources.device)
        return extract(extractor, *arguments)

    monkeypatch.setattr(nearest, "coarse_descriptors", lambda _, device: matched.append(device))
    monkeypatch.setattr(ImageExtractor, "extract", watched)
    run(dataset, tmp_path / "out", RECIPES[:1], resources=Resources(device="cpu"))
    assert matched == ["cpu"]
    assert set(extracted) == {"cpu"}


def errors(recipe: RecipeResult) -> list[float]:
    return [pair.error for pair in recipe.pairs]


def test_every_recipe_solves_easy_pairs(done: tuple[Path, Evaluation]) -> None:
    _, evaluation = done
    assert [recipe.name for recipe in evaluation.recipes] == ["unrectified-rootsift", "default"]
    for recipe in evaluation.recipes:
        assert [pair.name for pair in recipe.pairs] == NAMES
        assert max(errors(recipe)) < 1.0
        assert recipe.summary["< 1 px"] == 3
        assert recipe.solved == Solved(1.0, (1.0, 1.0))
        assert not any(pair.failure for pair in recipe.pairs)
        for pair in recipe.pairs:
            assert 4 <= pair.num_inliers <= pair.num_matches <= min(pair.num_keypoints)
            assert pair.seconds == pytest.approx(sum(pair.seconds_by_step.values()))
    assert [recipe.p_value for recipe in evaluation.recipes] == [None, 1.0]


def test_costs_are_those_of_the_warps(done: tuple[Path, Evaluation]) -> None:
    plain, warped = done[1].recipes
    assert plain.complexity["area_mpx"] == plain.complexity["warps_per_region"] == 0
    assert warped.complexity["num_warps"] >= warped.complexity["num_regions"] > 0
    assert 0 < warped.complexity["area_mpx"] < 10 * 160 * 120 / 1e6
    steps = warped.seconds_per_step
    assert min(steps[step] for step in ("plan", "warp", "detect", "match", "estimate")) > 0
    expected = 6 * sum(steps[step] for step in IMAGE_STEPS) + sum(p.seconds for p in warped.pairs)
    assert warped.summary["seconds"] == pytest.approx(expected)


def test_files_say_the_same(done: tuple[Path, Evaluation]) -> None:
    out, evaluation = done
    text = (out / "evaluation.json").read_text(encoding="utf-8")
    assert text == evaluation.to_json()
    values = json.loads(text)
    assert values["protocol"] == "evd"
    assert values["settings"]["scores"]["threshold_px"] == 0.5
    pair = values["recipes"]["default"]["pairs"][0]
    assert {"name", "error", "num_inliers", "seconds"} <= pair.keys()
    assert (out / "errors.png").read_bytes()[:4] == b"\x89PNG"
    summary = evaluation.summary()
    assert "paper: AffNetShapes (Table 2" in summary
    assert "paper: depth-map-based (Table 1" in summary
    assert "3 pairs; the dataset of the paper has 15" in summary


def test_finished_work_is_not_done_again(
    dataset: Path, copied: Path, done: tuple[Path, Evaluation], calls: dict[str, int]
) -> None:
    again = run(dataset, copied, baseline="unrectified-rootsift")
    assert calls == {"images": 0, "pairs": 0}
    assert again.to_json() == done[1].to_json()


def test_stopped_evaluation_goes_on(
    dataset: Path, copied: Path, done: tuple[Path, Evaluation], calls: dict[str, int]
) -> None:
    (records,) = (copied / "pairs").glob("unrectified-rootsift-*.jsonl")
    lines = records.read_bytes().splitlines(keepends=True)
    records.write_bytes(b"".join(lines[:2]) + lines[2][:40])  # killed while writing a line
    costs = copied / "features" / "default.jsonl"
    costs.write_bytes(costs.read_bytes() + b'{"image": "1/ca')
    again = run(dataset, copied)
    assert calls == {"images": 0, "pairs": 2}
    assert [errors(recipe) for recipe in again.recipes] == [errors(r) for r in done[1].recipes]
    assert again.recipes[1].num_images == 6


def test_a_changed_truth_is_scored_again(
    changed: Path, tmp_path: Path, calls: dict[str, int]
) -> None:
    run(changed, tmp_path / "out", RECIPES[:1])
    assert calls == {"images": 6, "pairs": 3}
    np.savetxt(changed / "h" / "dance.txt", np.diag([1, 1, 0.5]) @ TRUTH)
    again = run(changed, tmp_path / "out", RECIPES[:1])
    assert calls == {"images": 6, "pairs": 4}
    cafe, dance, _ = errors(again.recipes[0])
    assert dance > 20.0 > cafe


def test_budget_takes_the_strongest_of_the_same_features(
    dataset: Path, copied: Path, calls: dict[str, int]
) -> None:
    budgeted = run(dataset, copied, max_num_keypoints=60)
    assert calls == {"images": 0, "pairs": 6}
    for recipe in budgeted.recipes:
        assert {pair.num_keypoints for pair in recipe.pairs} == {(60, 60)}
    # Of features that were cut at random hardly any would match.
    assert budgeted.recipes[0].summary["< 5 px"] == 3


@pytest.mark.parametrize(("when", "failed"), [("before", ["dance", "shop"]), ("later", ["dance"])])
def test_damaged_image_fails_its_pair_and_the_others_go_on(
    when: str, failed: list[str], changed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = PROTOCOL.load(changed)
    (changed / "2" / "dance.png").write_bytes(b"no image")
    (changed / "h" / "shop.txt").write_text("1 2 nan")
    if when == "later":
        monkeypatch.setattr(Evd, "load", lambda *_: loaded)
    evaluation = run(changed, tmp_path / "out", RECIPES[:1])
    (recipe,) = evaluation.recipes
    assert [pair.name for pair in recipe.pairs if pair.failure] == failed
    assert errors(recipe)[0] < 1.0
    assert errors(recipe)[1] == math.inf
    assert recipe.summary["< 20 px"] == 3 - len(failed)
    assert ("2/dance.png" in recipe.failures) == (when == "later")
    assert "dance" in evaluation.summary()
    values = json.loads(evaluation.to_json())
    assert values["recipes"][recipe.name]["pairs"][1]["error"] is None


def test_unforeseen_error_of_a_score_fails_its_pair_only(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    score = Evd.score

    def fragile(self, pair, *arguments):
        if pair.name == "dance":
            raise ZeroDivisionError("an accident")
        return score(self, pair, *arguments)

    monkeypatch.setattr(Evd, "score", fragile)
    (recipe,) = run(dataset, tmp_path, RECIPES[:1]).recipes
    assert [pair.failure for pair in recipe.pairs] == ["", "ZeroDivisionError: an accident", ""]


@pytest.fixture
def climbing(tmp_path: Path) -> str:
    path = tmp_path / "climbing.toml"
    path.write_text(
        '[rectifier]\nname = "identity"\n[[escalation]]\nrectifier.name = "dense-shapes"\n'
    )
    return f"{path}:escalate.strong_num_inliers="


def test_escalation_stops_at_the_level_that_suffices(
    changed: Path, tmp_path: Path, climbing: str
) -> None:
    for folder in ("1", "2", "h"):
        for path in (changed / folder).glob("[ds]*"):
            path.unlink()
    recipes = [f"easy={climbing}0", f"hard={climbing}100000"]
    easy, hard = run(changed, tmp_path / "out", recipes).recipes
    assert easy.pairs[0].level == "identity"
    assert easy.complexity["num_warps"] == 0 < hard.complexity["num_warps"]
    assert [recipe.pairs[0].num_levels for recipe in (easy, hard)] == [1, 2]
    assert hard.pairs[0].num_correct >= 0.9 * easy.pairs[0].num_correct


def test_the_level_with_most_verified_inliers_counts() -> None:
    first, weaker, stronger, lost = (
        MatchedPair(None, (), (0, 0), level, number, inliers, 1.0)
        for number, (level, inliers) in enumerate((("a", 20), ("b", 16), ("c", 30), ("none", 0)), 1)
    )
    assert first.better(weaker) == replace(first, num_levels=2, seconds=2.0)
    assert first.better(weaker).better(stronger) == replace(stronger, seconds=3.0)
    assert lost.better(lost) == replace(lost, seconds=2.0)


def test_cost_is_that_of_the_levels_that_these_settings_need(
    dataset: Path, tmp_path: Path, climbing: str
) -> None:
    recipes = [f"climbing={climbing}0"]
    (climbed,) = run(dataset, tmp_path / "out", recipes, max_num_keypoints=15).recipes
    assert climbed.complexity["num_warps"] > 0
    (recipe,) = run(dataset, tmp_path / "out", recipes).recipes
    assert {pair.level for pair in recipe.pairs} == {"identity"}
    assert (recipe.complexity["num_warps"], recipe.num_images) == (0, 6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (EvaluateOptions(recipes=["sift"]), "sift is COLMAP's and no recipe"),
        (EvaluateOptions(baseline="asift"), "--baseline asift: is not among the recipes"),
        (EvaluateOptions(max_num_keypoints=0), "--max-num-keypoints 0: must be at least 1"),
        (EvaluateOptions(random_seed=-4), "--random-seed -4: must be at least 0"),
        (EvaluateOptions(recipes=["default", "default"]), "two methods are called 'default'"),
    ],
)
def test_bad_options_are_refused(
    options: EvaluateOptions, message: str, dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match=message):
        evaluate(PROTOCOL, dataset, tmp_path, options)


def test_features_of_other_options_are_not_mixed(dataset: Path, copied: Path) -> None:
    options = EvaluateOptions(recipes=["default=default:max_image_size_px=90"])
    with pytest.raises(StaleStoreError, match="max_image_size_px=120, and it is 90 now"):
        evaluate(PROTOCOL, dataset, copied, options)
    evaluate(PROTOCOL, dataset, copied, options, overwrite=True)
    assert len(list((copied / "pairs").glob("default-*"))) == 1


def test_dataset_without_a_usable_pair_is_refused(changed: Path, tmp_path: Path) -> None:
    for path in (changed / "2").iterdir():
        path.unlink()
    with pytest.raises(EvaluationError, match=r"no pair can be evaluated; the first: .*cafe\.png"):
        evaluate(PROTOCOL, changed, tmp_path / "out")


def test_record_file_refuses_other_settings_and_drops_half_a_line(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    RecordFile(path, {"size": [1, 2]}).append({"name": "a\u2028b"})
    path.write_bytes(path.read_bytes() + b'{"name": "c')
    reopened = RecordFile(path, {"size": (1, 2)})
    assert reopened.records == [{"name": "a\u2028b"}]
    reopened.append({"name": "d"})
    assert [record["name"] for record in RecordFile(path, {"size": [1, 2]}).records] == [
        "a\u2028b",
        "d",
    ]
    with pytest.raises(StaleStoreError, match=r"size=\[1, 2\], and it is \[1, 3\] now"):
        RecordFile(path, {"size": [1, 3]})


def test_fingerprint_sees_numbers_in_any_place() -> None:
    first, again = ((Evd(), [np.ones((2, 999))], "a") for _ in range(2))
    assert module._fingerprint(first) == module._fingerprint(again)
    again[1][0][1, 500] += 1e-15
    for other in ((Evd(threshold_px=1), *first[1:]), again):
        assert module._fingerprint(other) != module._fingerprint(first)


@pytest.mark.long
def test_command_prints_tables_and_errors_are_one_line(dataset: Path, tmp_path: Path) -> None:
    common = ["evaluate", "evd", "--output-path", tmp_path / "out", "-q"]
    settings = ["max_num_iterations=2000", "num_magsac_estimates=1"]
    ended = run_in_process_of_its_own(
        *common, "--dataset-path", dataset, "--recipes", "unrectified-rootsift",
        "--protocol-options", *settings,
    )  # fmt: skip
    assert (ended.code, ended.errors) == (0, [])
    assert "< 1 px  < 2 px  < 3 px  < 5 px  < 10 px  < 20 px  seconds" in ended.stdout
    row = next(line for line in ended.stdout.splitlines() if line.startswith("unrectified-roo"))
    assert row.split()[1:7] == ["3"] * 6
    missing = run_in_process_of_its_own(*common, "--dataset-path", tmp_path / "nowhere")
    assert missing.code == 2
    assert missing.errors == [
        f"error: {tmp_path / 'nowhere'}: no such folder; give the folder of the dataset"
    ]
