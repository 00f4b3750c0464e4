"""Evaluation as a whole on small planar pairs: results, resuming, budget, failures, command."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import run_in_process_of_its_own
from planar_pairs import TRUTH, write_extreme_views

from colmap_affrect.errors import EvaluationError, OptionError, StaleStoreError
from colmap_affrect.evaluation import evaluate as module
from colmap_affrect.evaluation.evaluate import EvaluateOptions, evaluate
from colmap_affrect.evaluation.evd import Evd
from colmap_affrect.evaluation.recipe_features import RecipeFeatures
from colmap_affrect.evaluation.records import RecordFile
from colmap_affrect.evaluation.results import Evaluation

FAST = "default=default:max_image_size_px=120"
RECIPES = ("unrectified-rootsift", FAST)
PROTOCOL = Evd(check_truth=False, max_num_iterations=2000, num_magsac_estimates=1)
NAMES = ["cafe", "dance", "shop"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_extreme_views(tmp_path_factory.mktemp("evd"), NAMES)


@pytest.fixture(scope="module")
def done(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Evaluation]:
    out = tmp_path_factory.mktemp("out")
    options = EvaluateOptions(recipes=RECIPES, baseline="unrectified-rootsift")
    return out, evaluate(PROTOCOL, dataset, out, options)


@pytest.fixture(autouse=True)
def _no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots take most of the time; those of ``done`` are drawn."""
    monkeypatch.setattr(module, "write_plots", lambda *_: [])


@pytest.fixture
def copied(done: tuple[Path, Evaluation], tmp_path: Path) -> Path:
    shutil.copytree(done[0], tmp_path / "out")
    return tmp_path / "out"


def count_calls(monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Count images extracted and pairs scored from now on."""
    calls = {"images": 0, "pairs": 0}
    extract, score = RecipeFeatures._extract, Evd.score

    def counted_extract(self, name, level):
        calls["images"] += 1
        extract(self, name, level)

    def counted_score(self, *arguments):
        calls["pairs"] += 1
        return score(self, *arguments)

    monkeypatch.setattr(RecipeFeatures, "_extract", counted_extract)
    monkeypatch.setattr(Evd, "score", counted_score)
    return calls


def test_every_recipe_solves_easy_pairs(done: tuple[Path, Evaluation]) -> None:
    _, evaluation = done
    assert [recipe.name for recipe in evaluation.recipes] == ["unrectified-rootsift", "default"]
    for recipe in evaluation.recipes:
        assert [pair.name for pair in recipe.pairs] == NAMES
        assert max(pair.score.error for pair in recipe.pairs) < 1.0
        assert recipe.summary["< 1 px"] == 3
        assert recipe.intervals["< 1 px"] == (3, 3)
        assert recipe.solved == (1.0, (1.0, 1.0))
        assert recipe.num_failed == 0
        for pair in recipe.pairs:
            assert 4 <= pair.score.num_inliers <= pair.num_matches <= min(pair.num_keypoints)
            assert pair.seconds == pytest.approx(sum(pair.seconds_by_step.values()))
    assert [recipe.p_value for recipe in evaluation.recipes] == [None, 1.0]


def test_costs_are_those_of_the_warps(done: tuple[Path, Evaluation]) -> None:
    plain, warped = (recipe.cost for recipe in done[1].recipes)
    assert (plain.area_mpx, plain.num_warps, plain.warps_per_region) == (0, 0, 0)
    assert warped.num_warps >= warped.num_regions > 0
    assert 0 < warped.area_mpx < 10 * 160 * 120 / 1e6
    assert min(warped.plan_s, warped.warp_s, warped.detect_s) > 0
    seconds = done[1].recipes[1].summary["seconds"]
    pairs = sum(pair.seconds for pair in done[1].recipes[1].pairs)
    assert seconds == pytest.approx(6 * warped.total_s + pairs)


def test_files_say_the_same(done: tuple[Path, Evaluation]) -> None:
    out, evaluation = done
    text = (out / "evaluation.json").read_text(encoding="utf-8")
    assert Evaluation.from_json(text).to_json() == text == evaluation.to_json()
    values = json.loads(text)
    assert values["protocol"] == "evd"
    assert values["settings"]["scores"]["threshold_px"] == 0.5
    pair = values["recipes"]["default"]["pairs"][0]
    assert {"name", "error", "num_inliers", "seconds"} <= pair.keys()
    lines = (out / "evaluation.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * 3
    assert lines[0].startswith("recipe,pair,category,error,num_inliers")
    for name in ("errors", "times", "complexity"):
        assert (out / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    summary = evaluation.summary()
    assert "paper: AffNetShapes (Table 2" in summary
    assert "paper: depth-map-based (Table 1" in summary
    assert "3 pairs; the dataset of the paper has 15" in summary


def test_finished_work_is_not_done_again(
    dataset: Path, copied: Path, done: tuple[Path, Evaluation], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = count_calls(monkeypatch)
    options = EvaluateOptions(recipes=RECIPES, baseline="unrectified-rootsift")
    again = evaluate(PROTOCOL, dataset, copied, options)
    assert calls == {"images": 0, "pairs": 0}
    assert again.to_json() == done[1].to_json()


def test_stopped_evaluation_goes_on(
    dataset: Path, copied: Path, done: tuple[Path, Evaluation], monkeypatch: pytest.MonkeyPatch
) -> None:
    (records,) = (copied / "pairs").glob("unrectified-rootsift-*.jsonl")
    lines = records.read_bytes().splitlines(keepends=True)
    records.write_bytes(b"".join(lines[:2]) + lines[2][:40])  # killed while writing a line
    costs = copied / "features" / "default.jsonl"
    costs.write_bytes(costs.read_bytes() + b'{"image": "1/ca')
    calls = count_calls(monkeypatch)
    again = evaluate(PROTOCOL, dataset, copied, EvaluateOptions(recipes=RECIPES))
    assert calls == {"images": 0, "pairs": 2}
    errors = [[pair.score.error for pair in recipe.pairs] for recipe in again.recipes]
    assert errors == [[pair.score.error for pair in r.pairs] for r in done[1].recipes]
    assert again.recipes[1].num_images == 6


def test_a_changed_truth_is_scored_again(
    dataset: Path, copied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = tmp_path / "changed"
    shutil.copytree(dataset, changed)
    options = EvaluateOptions(recipes=RECIPES[:1])
    shutil.rmtree(copied)
    evaluate(PROTOCOL, changed, copied, options)
    np.savetxt(changed / "h" / "dance.txt", np.diag([1, 1, 0.5]) @ TRUTH)
    calls = count_calls(monkeypatch)
    again = evaluate(PROTOCOL, changed, copied, options)
    assert calls == {"images": 0, "pairs": 1}
    errors = {pair.name: pair.score.error for pair in again.recipes[0].pairs}
    assert errors["dance"] > 20.0 > errors["cafe"]


def test_budget_takes_the_strongest_of_the_same_features(
    dataset: Path, copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = count_calls(monkeypatch)
    options = EvaluateOptions(recipes=RECIPES, max_num_keypoints=60)
    budgeted = evaluate(PROTOCOL, dataset, copied, options)
    assert calls == {"images": 0, "pairs": 6}
    for recipe in budgeted.recipes:
        assert {pair.num_keypoints for pair in recipe.pairs} == {(60, 60)}
    # Of features that were cut at random hardly any would match.
    assert budgeted.recipes[0].summary["< 5 px"] == 3


def test_damaged_image_fails_its_pair_and_the_others_go_on(dataset: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed"
    shutil.copytree(dataset, changed)
    loaded = PROTOCOL.load(changed)
    (changed / "2" / "dance.png").write_bytes(b"no image")
    (changed / "h" / "shop.txt").write_text("1 2 nan")

    class Loaded(Evd):
        def load(self, path):
            return loaded if path == changed / "early" else super().load(path)

    (changed / "early").mkdir()
    protocol = Loaded(check_truth=False, max_num_iterations=2000, num_magsac_estimates=1)
    options = EvaluateOptions(recipes=RECIPES[:1])
    for path, failed in ((changed, ["dance", "shop"]), (changed / "early", ["dance"])):
        evaluation = evaluate(protocol, path, tmp_path / path.name, options)
        (recipe,) = evaluation.recipes
        assert [pair.name for pair in recipe.pairs if pair.failure] == failed
        assert recipe.pairs[0].score.error < 1.0
        assert recipe.summary["< 20 px"] == 3 - len(failed)
        assert np.isinf(recipe.pairs[1].score.error)
        assert "dance" in evaluation.summary()
    assert "2/dance.png" in recipe.failures
    assert json.loads(evaluation.to_json())["recipes"][recipe.name]["pairs"][1]["error"] is None


def test_unforeseen_error_of_a_score_fails_its_pair_only(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    score = Evd.score

    def fragile(self, pair, points1, points2, seed):
        if pair.name == "dance":
            raise ZeroDivisionError("an accident")
        return score(self, pair, points1, points2, seed)

    monkeypatch.setattr(Evd, "score", fragile)
    evaluation = evaluate(PROTOCOL, dataset, tmp_path, EvaluateOptions(recipes=RECIPES[:1]))
    failures = [pair.failure for pair in evaluation.recipes[0].pairs]
    assert failures == ["", "ZeroDivisionError: an accident", ""]


def test_escalation_stops_at_the_level_that_suffices(dataset: Path, tmp_path: Path) -> None:
    path = tmp_path / "climbing.toml"
    path.write_text('[rectifier]\nname = "identity"\n[[escalation]]\nname = "dense-shapes"\n')
    easy = f"easy={path}:escalation_strong_num_inliers=0"
    hard = f"hard={path}:escalation_strong_num_inliers=100000"
    two = tmp_path / "two"
    shutil.copytree(dataset, two)
    for folder in ("1", "2", "h"):
        for path in (two / folder).glob("[ds]*"):
            path.unlink()
    recipes = evaluate(
        PROTOCOL, two, tmp_path / "out", EvaluateOptions(recipes=[easy, hard])
    ).recipes
    assert recipes[0].pairs[0].level == "identity"
    assert recipes[0].cost.num_warps == 0
    assert recipes[1].cost.num_warps > 0
    assert [recipe.pairs[0].num_levels for recipe in recipes] == [1, 2]
    inliers = [recipe.pairs[0].score.num_correct for recipe in recipes]
    assert inliers[1] >= 0.9 * inliers[0]


def test_cost_is_that_of_the_levels_that_these_settings_need(dataset: Path, tmp_path: Path) -> None:
    path = tmp_path / "climbing.toml"
    path.write_text('[rectifier]\nname = "identity"\n[[escalation]]\nname = "dense-shapes"\n')
    recipes = [f"climbing={path}:escalation_strong_num_inliers=0"]
    too_few = EvaluateOptions(recipes=recipes, max_num_keypoints=15)
    (climbed,) = evaluate(PROTOCOL, dataset, tmp_path / "out", too_few).recipes
    assert climbed.cost.num_warps > 0
    (recipe,) = evaluate(
        PROTOCOL, dataset, tmp_path / "out", EvaluateOptions(recipes=recipes)
    ).recipes
    assert {pair.level for pair in recipe.pairs} == {"identity"}
    assert (recipe.cost.num_warps, recipe.num_images) == (0, 6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (EvaluateOptions(recipes=["sift"]), "sift is COLMAP's and no recipe"),
        (EvaluateOptions(baseline="asift"), "--baseline asift: is not among the recipes"),
        (EvaluateOptions(max_num_keypoints=0), "--max-num-keypoints 0: must be at least 1"),
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


def test_dataset_without_a_usable_pair_is_refused(dataset: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed"
    shutil.copytree(dataset, changed)
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
    first = (Evd(), [np.arange(3.0)], "a")
    assert module._fingerprint(first) == module._fingerprint((Evd(), [np.arange(3.0)], "a"))
    for other in ((Evd(threshold_px=1), *first[1:]), (first[0], [np.arange(3.0) + 1e-9], "a")):
        assert module._fingerprint(other) != module._fingerprint(first)


@pytest.mark.long
def test_command_prints_tables_and_errors_are_one_line(dataset: Path, tmp_path: Path) -> None:
    common = ["evaluate", "evd", "--output-path", tmp_path / "out", "-q"]
    settings = ["max_num_iterations=2000", "check_truth=false", "num_magsac_estimates=1"]
    ended = run_in_process_of_its_own(
        *common, "--dataset-path", dataset, "--recipes", "unrectified-rootsift",
        "--protocol-options", *settings,
    )  # fmt: skip
    assert (ended.code, ended.errors) == (0, [])
    assert "< 1 px  < 2 px  < 3 px  < 5 px  < 10 px  < 20 px  seconds" in ended.stdout
    row = next(line for line in ended.stdout.splitlines() if line.startswith("unrectified-roo"))
    assert row.split()[1:7] == ["3"] * 6
    missing = run_in_process_of_its_own(*common, "--dataset-path", tmp_path / "nowhere")
    assert missing.code == 1
    assert missing.errors == [
        f"error: {tmp_path / 'nowhere'}: no such folder; give the folder of the dataset"
    ]
