"""Files of hloc go into databases, exactly and safely."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from h5_files import (
    NAMES,
    Datasets,
    Files,
    hloc_group,
    hloc_names,
    match_group,
    one_line,
    read_database,
    write_h5,
    write_photos,
)
from numpy.testing import assert_allclose

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import OptionError, StoreError
from colmap_affrect.interop.hdf5 import export_h5


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)


def test_centres_move_by_half_a_pixel_once_and_in_float32(files: Files) -> None:
    write_photos(files.photos, ["a.png"], (1100, 48))
    half = np.array([[3.25, 17.5], [1027.0, 2.0]], np.float16)
    write_h5(
        files.features,
        {"a.png": {"keypoints": half}, "sub/b c.png": {"keypoints": [[7.0, 11.125]]}},
    )
    write_h5(files.matches, {})
    files.import_all()
    assert files.keypoints("a.png").tolist() == [[3.75, 18.0], [1027.5, 2.5]]
    assert files.keypoints("sub/b c.png").tolist() == [[7.5, 11.625]]


def test_frames_become_affine_shapes_of_one_sigma(files: Files) -> None:
    lafs = np.array([[[6.0, 12.0, 5.0], [-18.0, 24.0, 9.0]]], np.float32)
    data = {"keypoints": [[5.0, 9.0]], "lafs": lafs, "scales": [1.0], "oris": [0.0]}
    write_h5(files.features, {"a.png": data})
    write_h5(files.matches, {})
    files.import_all()
    assert files.keypoints("a.png").tolist() == [[5.5, 9.5, 1.0, 2.0, -3.0, 4.0]]


def test_orientation_has_the_sign_of_colmap_both_ways(files: Files) -> None:
    angle = np.deg2rad(30.0)
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    frame = np.concatenate([6 * 2.5 * turned, [[4.0], [8.0]]], axis=1)[None]
    write_h5(
        files.features,
        {
            "a.png": {"keypoints": [[4.0, 8.0]], "scales": [2.5], "oris": [30.0]},
            "sub/b c.png": {"keypoints": [[4.0, 8.0]], "lafs": frame},
        },
    )
    write_h5(files.matches, {})
    files.import_all()
    columns = files.keypoints("a.png")
    assert_allclose(columns, [[4.5, 8.5, 2.5, angle]], rtol=1e-6)
    # COLMAP finds the same orientation in the six columns made of the frame.
    x, y, a11, a12, a21, a22 = files.keypoints("sub/b c.png")[0].tolist()
    colmap = pycolmap.FeatureKeypoint(x=x, y=y, a11=a11, a12=a12, a21=a21, a22=a22)
    assert colmap.compute_orientation() == pytest.approx(angle, rel=1e-6)
    assert colmap.compute_scale() == pytest.approx(2.5, rel=1e-6)
    out = files.folder / "out.h5", files.folder / "out_matches.h5"
    export_h5(files.database, *out)
    with h5py.File(out[0], "r") as file:
        for name in ("a.png", "sub/b c.png"):
            assert_allclose(file[name]["oris"][()], [30.0], rtol=1e-5)
            assert_allclose(file[name]["scales"][()], [2.5], rtol=1e-5)
        assert "lafs" not in file["a.png"]
        assert_allclose(file["sub/b c.png"]["lafs"][()], frame, rtol=1e-5)


@pytest.mark.parametrize("is_reversed", [False, True])
def test_keys_of_hloc_are_read(files: Files, is_reversed: bool) -> None:
    # Rows of matches0 belong to the first name of the key.
    names = ["sub-b c.png", "a.png"] if is_reversed else ["a.png", "sub-b c.png"]
    matches0 = [2, -1, -1, 0] if is_reversed else [3, -1, 0]
    write_h5(files.matches, {"/".join(names): match_group(matches0)})
    report = files.import_all()
    ((pair, indices),) = files.pairs().items()
    assert (pair, sorted(indices)) == (("a.png", "sub/b c.png"), [[0, 3], [2, 0]])
    assert (report.num_pairs, report.num_matches) == (1, 2)


def test_of_pairs_given_twice_one_counts_and_an_image_is_not_matched_with_itself(
    files: Files,
) -> None:
    write_h5(
        files.matches,
        {
            "a.png/sub-b c.png": match_group([1, -1, -1]),
            "sub-b c.png/a.png": match_group([2, -1, -1, -1]),
            "a.png/a.png": match_group([0, 1, 2]),
        },
    )
    assert files.import_all().num_pairs == 1
    assert files.pairs() == {("a.png", "sub/b c.png"): [[0, 1]]}


def test_images_without_features_are_imported_and_named_and_not_exported(
    files: Files,
) -> None:
    write_h5(files.features, {"a.png": hloc_group(3), "sub/b c.png": hloc_group(0)})
    write_h5(files.matches, {"a.png/sub-b c.png": match_group([-1, -1, -1])})
    report = files.import_all()
    keypoints, pairs = read_database(files.database)
    assert {name: len(values) for name, values in keypoints.items()} == {
        "a.png": 3, "sub/b c.png": 0, "sub/č.png": 0, "sub_x/d.png": 0
    }  # fmt: skip
    assert pairs == {("a.png", "sub/b c.png"): []}
    assert report.summary().splitlines()[1:] == [
        "note: images without features are there without keypoints: sub/č.png, sub_x/d.png",
        "note: descriptors are not kept, a database takes those of 128 values: a.png",
    ]
    assert (report.num_images, report.num_keypoints) == (4, 3)
    targets = files.folder / "out.h5", files.folder / "out_matches.h5"
    report = export_h5(files.database, *targets)
    assert "keypoints are left out: sub/č.png, sub_x/d.png" in report.summary()
    assert hloc_names(targets[0]) == {"a.png", "sub/b c.png"}


def test_keypoints_of_smaller_pictures_are_noted(files: Files) -> None:
    half = {name: hloc_group(120, n) for n, name in enumerate(NAMES)}
    for group in half.values():
        group["keypoints"] = group["keypoints"] / 2
        del group["image_size"]
    write_h5(files.features, half)
    write_h5(files.matches, {})
    notes = files.import_all().summary().splitlines()[1:]
    assert len(notes) == 2
    assert "descriptors are not kept" in notes[1]
    assert (
        "all keypoints in the upper left part, found in smaller pictures perhaps"
        in notes[0]
    )


def change_features(**datasets: Any) -> Callable[[Files], object]:
    groups = {"a.png": {**hloc_group(3), **datasets}, "sub/b c.png": hloc_group(4)}
    return lambda files: write_h5(files.features, groups)


def change_matches(**groups: Datasets) -> Callable[[Files], object]:
    return lambda files: write_h5(
        files.matches, {k.replace("__", "/"): v for k, v in groups.items()}
    )


def outside_data(files: Files) -> None:
    (files.folder / "secret").write_bytes(bytes(64))
    with h5py.File(files.features, "w") as file:
        external = [(str(files.folder / "secret"), 0, 64)]
        file.create_dataset("a.png/keypoints", (4, 2), "f8", external=external)


def huge(files: Files) -> None:
    with h5py.File(files.features, "a") as file:
        del file["a.png/keypoints"]
        file.create_dataset("a.png/keypoints", (10**12, 2), "f4", chunks=(1000, 2))


def two_names_one_key(files: Files) -> None:
    names = ["sub/x-y.png", "sub-x/y.png"]
    write_photos(files.photos, names)
    write_h5(files.features, {name: hloc_group(2) for name in names})
    write_h5(files.matches, {})


ERRORS: dict[str, tuple[Callable[[Files], object], str]] = {
    "features missing": (lambda f: f.features.unlink(), r"features\.h5: no such file"),
    "cut": (
        lambda f: f.features.write_bytes(f.features.read_bytes()[:4000]),
        r"features\.h5: (not an HDF5 file|damaged)",
    ),
    "no features": (lambda f: write_h5(f.features, {}), "images that|holds no"),
    "other images": (
        lambda f: write_h5(f.features, {"a.png": hloc_group(1), "z/y.png": hloc_group(1)}),
        r"images that are not in .*photos: z/y\.png$",
    ),
    "data in another file": (outside_data, r"not followed: a\.png/keypoints"),
    "huge": (huge, "too large to be true"),
    "frames of others": (
        change_features(lafs=np.zeros((4, 2, 3))),
        r"a\.png/lafs has shape \(4, 2, 3\), expected \(3, 2, 3\)",
    ),
    "not finite": (
        change_features(keypoints=[[1.0, 2.0], [np.nan, 3.0], [1e300, 2.0]]),
        r"features\.h5: images with keypoints that are not finite.*: a\.png; extract and",
    ),
    "of pictures twice as large": (
        change_features(keypoints=[[1.0, 2.0], [70.0, 3.0], [100.0, 90.0]]),
        r"features\.h5: images with keypoints outside of them.*: a\.png; extract and match with",
    ),
    "in units of its sides": (
        change_features(keypoints=[[0.1, 0.2], [1.0, 0.3], [1.5, 0.9]]),
        r"features\.h5: images with all keypoints in one corner.*: a\.png; write keypoints in px",
    ),
    "other size": (
        change_features(image_size=[48, 64]),
        r"a\.png was 48 x 64 px for the features \(turned by .*photograph is 64 x 48 px",
    ),
    "key of two names": (two_names_one_key, r"sub-x/y\.png and sub/x-y\.png have the same key"),
    "other pair": (
        change_matches(**{"a.png__z.png": match_group([0, 1, 2])}),
        r"matches of images that have no features: a\.png/z\.png",
    ),
    "pair beyond the end": (
        change_matches(**{"a.png__sub-b c.png": match_group([0, 4, 2])}),
        r"a\.png, sub/b c\.png: matches of .* point at keypoints that do not exist",
    ),
    "real matches": (
        change_matches(**{"a.png__sub-b c.png": match_group([0, 1, 2], np.float32)}),
        "does not hold numbers, or no whole ones",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", ERRORS)
def test_each_fault_is_one_clear_line_and_no_database(files: Files, case: str) -> None:
    spoil, message = ERRORS[case]
    spoil(files)
    kind = OptionError if case == "features missing" else StoreError
    with pytest.raises(kind, match=message) as error:
        files.import_all()
    one_line(error)
    assert not [path for path in files.folder.iterdir() if "import" in path.name]
    assert not files.database.exists()
