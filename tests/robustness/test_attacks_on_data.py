"""Attacks on functions and data: arguments, arrays, models and databases that make no sense.

pytest -n 0 tests/robustness/test_attacks_on_data.py
pytest -m long tests/robustness/test_attacks_on_data.py
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damaged import execute
from exported_model import NAMES, write_model, write_photographs
from numpy.typing import NDArray
from results import tree
from verified import verified

import colmap_affrect
from colmap_affrect import CompareOptions, Extension, RunOptions, match_descriptors
from colmap_affrect import match_feature_sets as match_sets
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_verification import verify
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.doctor import diagnose
from colmap_affrect.errors import AffrectError, OptionError, StoreError
from colmap_affrect.geometry.neighbors import without_duplicates
from colmap_affrect.interop.align import Reference, align
from colmap_affrect.interop.export import export

Array = NDArray[Any]
CHANCE = np.random.default_rng(0)
POINTS = CHANCE.uniform(0.0, 300.0, (80, 2))
ROWS = CHANCE.normal(size=(80, 32)).astype(np.float32)
SETS: dict[str, tuple[Array, Array]] = {"a": (POINTS, ROWS), "b": (POINTS + 5.0, ROWS)}


@pytest.mark.parametrize("length", [1e-200, 1e-42, 1e-30, 1e-6, 1e6, 1e30, 1e200])
def test_length_of_descriptors_does_not_matter(length: float) -> None:
    usual = match_descriptors(POINTS, ROWS, POINTS, ROWS)
    scaled = ROWS.astype(np.float64) * length
    found = match_descriptors(POINTS, scaled, POINTS, scaled)
    assert len(usual.indices) > 60
    assert np.array_equal(found.indices, usual.indices)


class _NoTensor:
    """Something that says why it cannot become an array, as tensors do."""

    def __array__(self, *_: object, **__: object) -> Array:
        raise RuntimeError("Can't call numpy() on Tensor\nthat requires grad")


ODD_ARRAYS: dict[str, tuple[Any, Any, str]] = {
    "words": (np.full((80, 2), "x"), ROWS, "keypoints are <U1; give numbers of px"),
    "complex numbers": (POINTS.astype(complex), ROWS, "keypoints are complex128"),
    "dates": (
        np.zeros((80, 2), "datetime64[s]"),
        ROWS,
        r"keypoints are datetime64\[s\]",
    ),
    "records": (np.zeros(80, [("x", "f4")]), ROWS, "do not fit"),
    "ragged lists": ([[1.0, 2.0], [3.0]], ROWS[:2], "two arrays"),
    "tensors that need grad": (
        _NoTensor(),
        ROWS,
        "numpy.. on Tensor that requires grad",
    ),
    "masked values": (
        np.ma.masked_greater(POINTS, 200.0),
        ROWS,
        "some values are masked",
    ),
    "no image is so large": (POINTS * 1e300, ROWS, "where no image reaches"),
    "in units of the sides": (POINTS / 300.0, ROWS, "write keypoints in px"),
    "all at one place": (np.full((80, 2), 99.0), ROWS, "at one place"),
    "nan": (POINTS * np.nan, ROWS, "not finite"),
    "no array at all": ({"keypoints": POINTS}, ROWS, "do not fit"),
    "nothing": (None, None, "do not fit"),
}


@pytest.mark.parametrize("case", ODD_ARRAYS)
def test_arrays_that_mean_nothing_are_one_line(case: str) -> None:
    keypoints, descriptors, said = ODD_ARRAYS[case]
    with pytest.raises(OptionError, match=said) as error:
        match_descriptors(keypoints, descriptors, POINTS, ROWS)
    assert "\n" not in str(error.value)
    assert "image 1" in str(error.value)


ODD_SETS: dict[str, tuple[Any, ...]] = {
    "a list of sets": (list(SETS.items()),),
    "numbers for names": ({1: SETS["a"], "b": SETS["b"]},),
    "one array": ({"a": POINTS, "b": POINTS},),
    "three arrays": ({"a": (POINTS, ROWS, ROWS), "b": SETS["b"]},),
    "no arrays": ({"a": None, "b": SETS["b"]},),
    "three names": (SETS, [("a", "b", "a")]),
    "one name": (SETS, (pair for pair in [("a",)])),
    "a word for pairs": (SETS, "ab"),
    "a number for pairs": (SETS, 5),
    "another's options": (SETS, None, VerificationOptions()),
    "a dictionary of options": (SETS, None, {"max_ratio": 0.8}),
}


@pytest.mark.parametrize("case", ODD_SETS)
def test_sets_and_pairs_that_make_no_sense_are_one_line(case: str) -> None:
    with pytest.raises(OptionError) as error:
        match_sets(*ODD_SETS[case])
    assert "\n" not in str(error.value)


def test_of_many_matches_at_one_place_the_best_stays() -> None:
    points = np.zeros((600, 2))
    points[1::2] = 50.0
    keep = without_duplicates(points, points, 2.0)
    assert np.flatnonzero(keep).tolist() == [0, 1]


ODD_CALLS: dict[str, Callable[[Path], object]] = {
    "no cameras": lambda _: RunOptions(cameras=None),  # type: ignore[arg-type]
    "pairs in a list": lambda _: RunOptions(pairs=[("a", "b")]),  # type: ignore[arg-type]
    "time as text": lambda _: RunOptions(max_minutes="3"),  # type: ignore[arg-type]
    "one name": lambda _: colmap_affrect.ByHand(left_out="a.png"),  # type: ignore[arg-type]
    "flat pair": lambda _: colmap_affrect.ByHand(rejected=("a", "b")),  # type: ignore[arg-type]
    "no path": lambda _: Extension(model_path=None),  # type: ignore[arg-type]
    "no as a word": lambda _: Extension(model_path=Path(), refine_existing="no"),  # type: ignore[arg-type]
    "one seed": lambda _: CompareOptions(seeds=0),  # type: ignore[arg-type]
    "methods are numbers": lambda _: CompareOptions(methods=[1]),  # type: ignore[list-item]
    "array of seeds": lambda _: CompareOptions(seeds=np.arange(2)),  # type: ignore[arg-type]
    "two for a distance": lambda _: Reference(distances=(("a", "b"),)),  # type: ignore[arg-type]
    "distance as text": lambda _: Reference(distances=(("a", "b", "2"),)),  # type: ignore[arg-type]
    "number of threads": lambda p: colmap_affrect.run(p, p, executor=4),  # type: ignore[arg-type]
    "no formats": lambda p: export(p, p, None),  # type: ignore[arg-type]
    "formats in a word": lambda p: export(p, p, "ply"),
    "no reference": lambda p: align(p, p, None),  # type: ignore[arg-type]
    "no recipe": lambda _: colmap_affrect.load_recipe(None),  # type: ignore[arg-type]
    "numbers for settings": lambda _: colmap_affrect.load_recipe("default", [3]),  # type: ignore[list-item]
    "unknown kind of matches": lambda p: colmap_affrect.map_database(
        p / "x.db", p / "o", match_type="x"  # type: ignore[arg-type]
    ),
    "one name of an image": lambda p: colmap_affrect.extract_features(p / "x.db", p, "a.png"),
    "bytes for names": lambda p: colmap_affrect.extract_features(p / "x.db", p, b"a.png"),  # type: ignore[arg-type]
}  # fmt: skip


@pytest.mark.parametrize("case", ODD_CALLS)
def test_arguments_of_wrong_types_are_one_line(case: str, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(AffrectError) as error:
        ODD_CALLS[case](tmp_path)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.glob("o*"))


@pytest.mark.parametrize("path", ["", "a\0b", ".", "/"])
def test_paths_that_name_no_database_are_one_line(path: str, tmp_path: Path) -> None:
    for use in (
        lambda: colmap_affrect.map_database(path, tmp_path / "o"),
        lambda: colmap_affrect.match_exhaustive(path),
        lambda: colmap_affrect.verify_matches(path),
        lambda: colmap_affrect.incremental_mapping(path, "", tmp_path / "o"),
    ):
        with pytest.raises(AffrectError):
            use()  # type: ignore[no-untyped-call]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", ["", "a\0b"])
def test_no_path_is_not_the_current_folder(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_photographs(tmp_path)
    monkeypatch.chdir(tmp_path)
    for use in (
        lambda: colmap_affrect.run(path, tmp_path / "o"),
        lambda: colmap_affrect.compare(path, tmp_path / "o"),
        lambda: diagnose(path),
        lambda: export(path, tmp_path / "o"),
    ):
        with pytest.raises(OptionError, match="path"):
            use()  # type: ignore[no-untyped-call]
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("length", [1e-300, 1e20, 1e300])
def test_scale_that_cannot_be_right_is_refused(length: float, tmp_path: Path) -> None:
    write_model(tmp_path / "model")
    reference = Reference(distances=((NAMES[0], NAMES[1], length),))
    with pytest.raises(OptionError, match="cannot be right"):
        align(tmp_path / "model", tmp_path / "new", reference)
    assert not (tmp_path / "new").exists()


PANORAMA_USES: dict[str, Callable[[Path], object]] = {
    "undistorted": lambda p: export(
        p / "m", p / "o", ["undistorted"], image_path=p / "photos"
    ),
    "nerfstudio": lambda p: export(
        p / "m", p / "o", ["nerfstudio"], image_path=p / "photos"
    ),
    "mvsnet": lambda p: export(p / "m", p / "o", ["mvsnet"], image_path=p / "photos"),
    "another camera": lambda p: export(
        p / "m", p / "o", ["text"], camera_model="RADIAL"
    ),
    "extended": lambda p: colmap_affrect.run(
        p / "photos", p / "o", RunOptions(extend=Extension(model_path=p / "m"))
    ),
}


@pytest.mark.parametrize("use", PANORAMA_USES)
def test_model_of_panoramas_is_refused_where_a_focal_length_is_needed(
    use: str, tmp_path: Path
) -> None:
    model = write_model(tmp_path / "m")
    write_photographs(tmp_path / "photos")
    model.cameras[1].model = pycolmap.CameraModelId.EQUIRECTANGULAR
    model.cameras[1].params = [160.0, 120.0]
    model.write(tmp_path / "m")
    before = tree(tmp_path)
    with pytest.raises(
        OptionError, match=r"camera 1 looks all around \(EQUIRECTANGULAR\)"
    ):
        PANORAMA_USES[use](tmp_path)
    assert tree(tmp_path) == before
    assert set(export(tmp_path / "m", tmp_path / "o", ["ply", "text", "cameras"])) == {
        "ply", "text", "cameras",
    }  # fmt: skip


@pytest.mark.parametrize("name", ["points3D.txt", "images.txt"])
def test_text_model_that_contradicts_itself_is_named(name: str, tmp_path: Path) -> None:
    model = write_model(tmp_path / "m")
    (tmp_path / "text").mkdir()
    model.write_text(tmp_path / "text")
    path = tmp_path / "text" / name
    lines = path.read_text().splitlines()
    kept = (
        lines[: len(lines) // 2]
        if name == "points3D.txt"
        else [*lines[:-1], lines[-1] * 2]
    )
    path.write_text("\n".join(kept) + "\n")
    for use in (
        lambda: export(tmp_path / "text", tmp_path / "o", ["ply"]),
        lambda: export(
            tmp_path / "text", tmp_path / "o", ["nerfstudio"], image_path=tmp_path
        ),
    ):
        with pytest.raises(StoreError, match="images and points are not of one model"):
            use()  # type: ignore[no-untyped-call]


@pytest.mark.long
@pytest.mark.parametrize("times", [2, 20])
def test_matches_that_are_given_several_times_count_once(
    photos: Path, tmp_path: Path, times: int
) -> None:
    path = verified(photos, tmp_path / "out").database
    usual = _num_inliers(path)
    other = Path(shutil.copy(path, tmp_path / "other.db"))
    execute(other, "DELETE FROM two_view_geometries")
    with open_database(other) as database:
        for pair_id in database.read_num_matches()[0]:
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            matches = np.repeat(np.asarray(database.read_matches(*ids)), times, axis=0)
            database.delete_matches(*ids)
            database.write_matches(*ids, matches)
    verify(other, VerificationOptions())
    assert _num_inliers(other) == usual
    assert min(usual) > 100


def _num_inliers(path: Path) -> list[int]:
    with open_database(path) as database:
        return list(map(int, database.read_two_view_geometry_num_inliers()[1]))
