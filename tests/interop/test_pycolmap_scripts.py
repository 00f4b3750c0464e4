"""Scripts of pycolmap run on when only the import of it is changed, options and all."""

from __future__ import annotations

import inspect
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planar_scenes import write_panoramas
from small_scene import NAMES

import colmap_affrect
from colmap_affrect import pycolmap as replaced
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.interop.pycolmap_options import (
    HONOURED,
    changes,
    extraction_recipe,
    matching_options,
    verification_options,
)
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.progress import Progress
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.pycolmap import panorama
from colmap_affrect.recipes import load_recipe

COARSE = colmap_affrect.ExtractionOptions(rectifier="identity", max_image_size_px=320)


@pytest.fixture(scope="module")
def once_extracted(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("extracted")
    colmap_affrect.extract_features(folder / "a.db", photos, extraction_options=COARSE)
    return folder


@pytest.fixture
def extracted(once_extracted: Path, tmp_path: Path) -> Path:
    shutil.copytree(once_extracted, tmp_path, dirs_exist_ok=True)
    return tmp_path / "a.db"


@pytest.mark.slow
@pytest.mark.parametrize("matcher", ["sequential", "exhaustive"])
def test_panorama_script_of_pycolmap_registers_all_images(
    tmp_path: Path, matcher: str
) -> None:
    (tmp_path / "panoramas").mkdir()
    write_panoramas(tmp_path / "panoramas", 3)
    options = panorama.PanoramaReconstructionOptions(matcher=panorama.Matcher(matcher))
    models = panorama.reconstruct(
        str(tmp_path / "panoramas"), str(tmp_path / "out"), options
    )
    assert models[0].num_reg_images() == 3 * 12
    assert models[0].num_reg_frames() == 3
    with open_database(tmp_path / "out" / "database.db") as database:
        assert not database.exists_descriptors(1)  # SIFT leaves some
    equirectangular = pycolmap.Reconstruction(tmp_path / "out/sparse_equirectangular/0")
    assert equirectangular.num_reg_images() == 3


@pytest.mark.long
def test_panoramas_themselves_are_refused_with_advice(tmp_path: Path) -> None:
    write_panoramas(tmp_path, 1)
    spherical = panorama.PanoramaReconstructionOptions(
        render_type=panorama.PanoRenderType.SPHERICAL
    )
    with pytest.raises(
        OptionError, match=r"EQUIRECTANGULAR: cut perspective views .*panorama does"
    ):
        panorama.reconstruct(tmp_path, tmp_path / "out", spherical)


def test_names_are_all_there_and_those_of_the_module_are_its_own() -> None:
    assert {*pycolmap.__all__} - {*dir(replaced)} == {"match_vocabtree"}
    assert all(hasattr(replaced, name) for name in replaced.__all__)
    assert {"run", "extract_features", "RunOptions"} <= {*dir(colmap_affrect)}
    assert replaced.__path__ != pycolmap.__path__
    with pytest.raises(AttributeError, match="has no attribute '__nothing__'"):
        replaced.__nothing__  # noqa: B018


@pytest.mark.parametrize(
    "name",
    ["extract_features", "match_exhaustive", "match_sequential", "match_spatial",
     "match_image_pairs", "verify_matches", "incremental_mapping"],
)  # fmt: skip
def test_arguments_are_those_of_pycolmap_in_order(name: str) -> None:
    text = getattr(pycolmap, name).__doc__.partition("->")[0]
    ours = inspect.signature(getattr(replaced, name)).parameters.values()
    named = [p.name for p in ours if p.kind is p.POSITIONAL_OR_KEYWORD]
    positions = [text.index(f"{argument}: ") for argument in named]
    assert positions == sorted(positions)
    assert text.count(": ") == len(named)
    assert getattr(replaced, name) is getattr(colmap_affrect, name)


@pytest.mark.parametrize("kind", HONOURED)
def test_default_options_ask_for_nothing_and_every_field_is_honoured_or_named(
    kind: type,
) -> None:
    assert (
        changes(kind(), kind, "x")
        == changes({}, kind, "x")
        == changes(None, kind, "x")
        == {}
    )
    for key, value in kind().todict().items():
        other = (
            {**value, next(iter(value)): 77}
            if isinstance(value, dict)
            else _other(value)
        )
        given = kind()
        given.mergedict({key: other})
        if key in HONOURED[kind]:
            assert changes({key: other}, kind, "x") == changes(given, kind, "x")
            assert list(changes(given, kind, "x")) == [key]
        elif not isinstance(value, dict):
            with pytest.raises(
                OptionError, match=rf"^x: {key}=\S+ cannot be carried over$"
            ):
                changes(given, kind, "x")
    with pytest.raises(OptionError, match=r"^x: no_such: pycolmap has no such option"):
        changes({"no_such": 1}, kind, "x")


def _other(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return type(value)(value + 1)
    if isinstance(value, str | Path):
        return "77"
    return next(item for item in type(value).__members__.values() if item != value)


def test_options_are_translated() -> None:
    recipe, asked = extraction_recipe({"max_image_size": 1000, "use_gpu": True})
    default = load_recipe("default")
    assert recipe.extraction == default.extraction.changed(max_image_size_px=1000)
    assert asked == {"max_image_size": 1000, "use_gpu": True}
    assert extraction_recipe(pycolmap.FeatureExtractionOptions()) == (default, {})
    assert matching_options({"sift": {"max_ratio": 0.8}, "num_threads": 3}) == (
        None, {"num_threads": 3},
    )  # fmt: skip
    assert matching_options(NearestOptions(max_ratio=0.7)) == (
        NearestOptions(max_ratio=0.7),
        {},
    )
    with pytest.raises(
        OptionError, match=r"sift\.max_ratio=0\.7 cannot be carried over"
    ):
        matching_options({"sift": {"max_ratio": 0.7}})
    usual = colmap_affrect.VerificationOptions()
    assert verification_options(pycolmap.TwoViewGeometryOptions(), None) == usual
    nested = verification_options(
        {"ransac": {"random_seed": 7, "max_error": 2.5}}, None
    )
    assert nested == usual.changed(
        random_seed=7, max_error_px=2.5, scale_max_error=False
    )
    named = verification_options(
        {"ransac": {"max_error": 4.0, "random_seed": -1}}, None
    )
    assert named == usual.changed(max_error_px=4.0, scale_max_error=False)
    with pytest.raises(
        OptionError, match=r"ransac\.max_eror: .*did you mean 'ransac\.max_error'"
    ):
        verification_options({"ransac": {"max_eror": 2}}, None)


def test_what_matching_options_ask_for_is_done(extracted: Path) -> None:
    asked = pycolmap.FeatureMatchingOptions(
        skip_geometric_verification=True, num_threads=1
    )
    (match,) = replaced.match_exhaustive(extracted, asked)
    assert match.num_done == 6
    with open_database(extracted) as database:
        assert database.num_verified_image_pairs() == 0
    reports = replaced.match_exhaustive(extracted, {"guided_matching": True})
    assert [report.name for report in reports] == ["match", "verify", "guide"]
    assert (reports[0].num_kept, reports[2].num_done) == (6, 6)


@pytest.mark.long
def test_pairs_are_those_of_pycolmaps_generators(extracted: Path) -> None:
    in_order = pycolmap.SequentialPairingOptions(overlap=1, quadratic_overlap=False)
    with pytest.raises(TypeError, match="unexpected keyword argument 'pairs_options'"):
        replaced.match_sequential(extracted, pairs_options=in_order)
    match, _ = replaced.match_sequential(extracted, pairing_options=in_order)
    assert match.num_done == len(NAMES) - 1
    with pytest.raises(AffrectError, match="0 images have a position"):
        replaced.match_spatial(extracted)
    with open_database(extracted) as database:
        for image_id, x in ((1, 0.0), (2, 5.0), (3, 500.0), (4, 506.0)):
            prior = pycolmap.PosePrior(
                position=np.array([x, 0.0, 0.0]),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
            prior.corr_data_id = database.read_image(image_id).data_id
            database.write_pose_prior(prior)
    match, _ = replaced.match_spatial(extracted, pairing_options={"max_distance": 20.0})
    assert match.num_done + match.num_kept == len(NAMES) - 1
    match, _ = replaced.match_sequential(
        extracted, pairing_options={"overlap": 1, "loop_detection": True}
    )
    assert match.num_done + match.num_kept == 6


def test_pairs_of_a_list_are_verified(extracted: Path, tmp_path: Path) -> None:
    replaced.match_exhaustive(extracted, {"skip_geometric_verification": True})
    listed = tmp_path / "pairs.txt"
    listed.write_text(f"{NAMES[2]} {NAMES[3]}\n")
    token = pycolmap.CancellationToken()
    replaced.verify_matches(extracted, listed, {"ransac": {"random_seed": 3}}, token)
    ids = image_ids(extracted)
    with open_database(extracted) as database:
        (pair_id,), _ = database.read_two_view_geometries()
    assert set(pycolmap.pair_id_to_image_pair(pair_id)) == {
        ids[NAMES[2]],
        ids[NAMES[3]],
    }
    token.cancel()
    with pytest.raises(InterruptedError):
        replaced.verify_matches(extracted, listed, None, token)


@pytest.mark.long
def test_cancelled_token_stops_and_what_is_done_is_kept(
    photos: Path, tmp_path: Path
) -> None:
    class Cancelling(Progress):
        """Cancels after the first image."""

        def stage(self, name: str, total: int, unit: str, part: str = "") -> Any:
            token.cancel()
            return super().stage(name, total, unit, part)

    path = tmp_path / "a.db"
    token = pycolmap.CancellationToken()
    with pytest.raises(InterruptedError, match="Operation cancelled"):
        replaced.extract_features(
            path, photos, extraction_options=COARSE, cancellation_token=token,
            progress=Cancelling(),
        )  # fmt: skip
    report = replaced.extract_features(path, photos, extraction_options=COARSE)
    assert (report.num_done, report.num_kept) == (len(NAMES) - 1, 1)
    with pytest.raises(InterruptedError):
        replaced.match_exhaustive(path, cancellation_token=token)


def test_names_of_pycolmap_say_what_replaces_them() -> None:
    assert replaced.Reconstruction is pycolmap.Reconstruction
    with pytest.raises(AttributeError, match="use match_sequential"):
        replaced.match_vocabtree  # noqa: B018
    assert not Workspace.beside(Path("a.db")).config.exists()
