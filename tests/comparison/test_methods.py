"""Methods by name, and COLMAP's SIFT on masks, lists of pairs and names with spaces."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from small_scene import write_photographs

from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.image_import import import_images
from colmap_affrect.comparison.method_run import extract_sift, match_sift
from colmap_affrect.comparison.methods import parse_methods
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.images.photographs import CameraOptions, MaskOptions


def test_options_of_a_recipe_are_changed_by_what_follows_the_colon():
    texts = [
        "sift, tuned=default:matching.max_ratio=0.7,max_image_size_px=640",
        "unrectified",
    ]
    sift, tuned, unrectified = parse_methods(texts)
    assert (sift.recipe, unrectified.label) == (None, "unrectified")
    assert tuned.label == "tuned"
    assert tuned.recipe.matching.max_ratio == 0.7
    assert tuned.recipe.extraction.max_image_size_px == 640
    assert tuned.recipe.name == "default"


def test_depth_goes_to_the_recipes_that_use_it():
    depth, default = parse_methods(["depth-planes,default"], ['depth.path="/depth"'])
    assert depth.recipe.extraction.depth.path == "/depth"
    assert default.recipe.extraction.depth.path == ""


def test_folders_of_methods_differ_and_stay_inside():
    texts = [
        "default:max_image_size_px=640",
        "default:max_image_size_px=641",
        "a/../b=default",
    ]
    folders = [method.folder_name for method in parse_methods(texts)]
    assert len(set(folders)) == 3
    assert not any("/" in folder or "." in folder for folder in folders)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["sift,defualt"], r"unknown method 'defualt' .did you mean 'default'"),
        (["sift,sift"], "two methods are called 'sift'"),
        (["sift=default"], "'sift' is COLMAP's"),
        ([","], "no method given"),
    ],
)
def test_wrong_methods_are_refused(texts, message):
    with pytest.raises(OptionError, match=message):
        parse_methods(texts)


def test_sift_looks_at_the_masks_and_matches_the_pairs_of_the_list(tmp_path):
    names = write_photographs(tmp_path / "images", 3)
    masks = tmp_path / "masks" / "side"
    masks.mkdir(parents=True)
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :160] = 0
    for path in ("a.png.png", "b c.png", "side/č.png.png"):
        cv2.imwrite(str(tmp_path / "masks" / path), mask)
    path = tmp_path / "database.db"
    import_images(path, tmp_path / "images", names, CameraOptions())
    ids = image_ids(path)
    options = MaskOptions(path=str(tmp_path / "masks"))
    assert extract_sift(path, tmp_path / "images", names, options) == {}
    with open_database(path) as database:
        for name in names:
            keypoints = database.read_keypoints(ids[name])
            assert len(keypoints) > 50
            assert keypoints[:, 0].min() >= 160
    first, second, third = names
    match_sift(path, [(first, third)])
    with open_database(path) as database:
        assert database.exists_matches(ids[first], ids[third])
        assert not database.exists_matches(ids[first], ids[second])
    match_sift(path, None)
    with open_database(path) as database:
        assert len(database.read_matches(ids[first], ids[second])) > 20
        assert database.num_verified_image_pairs() == 0
    assert second == "b c.png"
    with pytest.raises(AffrectError, match=r"b c\.png: COLMAP matches no listed names"):
        match_sift(path, [(first, second)])
