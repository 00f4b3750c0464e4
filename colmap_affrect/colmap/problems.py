"""The problems that a COLMAP database can have, and what to do about each."""

from __future__ import annotations

from typing import Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
Check = tuple[Severity, str, str]  # how serious a problem is, what it is, and what to do about it

CHECKS: dict[str, Check] = {
    "no-images": ("warning", "holds no images",
        "import some, e.g. by 'colmap feature_extractor --database_path {path} --image_path X'"),
    "no-camera": ("error", "images whose camera does not exist",
        "import these images again into a new database"),
    "camera-model": ("error", "cameras of a model that COLMAP does not have",
        "import their images again into a new database"),
    "camera-panorama": ("warning", "cameras that look all around, which have no focal length",
        "cut perspective views out of the panoramas, as COLMAP's example panorama.py does, and "
        "give these"),
    "camera-size": ("error", "cameras of a size that no photograph has",
        "import their images again into a new database"),
    "camera-params": ("error",
        "cameras whose parameters are more or fewer than their model has, or not finite numbers",
        "import their images again into a new database"),
    "no-prior-focal": ("note", "cameras whose focal length is a guess",
        "if you know the intrinsics, give them: --cameras-path or --focal-length-px here, "
        "--ImageReader.camera_params in COLMAP"),
    "no-frame": ("error", "images without a frame while others have one, at which mapping aborts",
        "give each of them a frame (pycolmap.Database.write_frame), or begin anew with "
        "'colmap-affrect run --database-path {path}', which adds frames to its copy"),
    "frame-links": ("error", "rows of rigs and frames that belong to nothing",
        "import the images again into a new database"),
    "matrix-data": ("error",
        "rows whose matrices or cameras have more or less data than they should, or no finite "
        "numbers", "delete these rows; two-view geometries are made anew by 'colmap "
        "geometric_verifier'"),
    "bad-name": ("error", "images without a name, or with one that is not UTF-8",
        "rename these files and import them again into a new database"),
    "unsafe-name": ("warning", "image names that lead out of the image folder",
        "rename these images; programs that write a file per image would write elsewhere"),
    "no-keypoints": ("warning", "images without keypoints, which cannot be registered",
        "extract their features, unless they are blank"),
    "keypoint-columns": ("error", "images whose keypoints do not have 2, 4 or 6 columns",
        "write them again as x, y; or x, y, scale, orientation; or x, y and an affine shape"),
    "keypoint-data": ("error",
        "images whose keypoints have more or less data than rows and columns",
        "extract these images again into a new database"),
    "keypoints-not-finite": ("error",
        "images with keypoints that are not finite numbers, or are where no image reaches",
        "extract these images again into a new database"),
    "keypoints-outside": ("warning", "images with keypoints outside of them",
        "see that they were found in the images as stored: not rotated, not resized"),
    "descriptor-count": ("error", "images with another number of descriptors than of keypoints",
        "extract these images again into a new database"),
    "descriptor-types": ("error", "descriptors of several types, which COLMAP does not match",
        "extract all images with the same features into a new database"),
    "no-matches": ("note", "no pairs are matched yet",
        "match them, e.g. by 'colmap exhaustive_matcher --database_path {path}'"),
    "self-pair": ("error", "images that are matched with themselves",
        "delete the matches of these pairs"),
    "unknown-pair": ("error", "matches of images that do not exist",
        "delete the matches of these pairs"),
    "match-data": ("error", "pairs whose matches have more or less data than rows and 2 columns",
        "delete the matches of these pairs and match them again"),
    "match-range": ("error",
        "pairs with matches of keypoints that do not exist, at which COLMAP crashes",
        "delete the matches of these pairs and match them again"),
    "no-geometry": ("warning",
        "matched pairs without a two-view geometry, which mapping does not see",
        "run 'colmap geometric_verifier --database_path {path}'"),
    "undefined-geometry": ("warning",
        "two-view geometries of undefined configuration, which mapping passes over",
        "verify these pairs again: in a copy, delete their two-view geometries and run 'colmap "
        "geometric_verifier'"),
    "file-missing": ("warning", "images whose file is missing",
        "put the files back, or give another --image-path"),
    "file-unreadable": ("warning", "images whose file cannot be read",
        "replace the files"),
    "file-size": ("error", "images of another size than their camera",
        "use the photographs that the database was made from: not resized, not rotated"),
}  # fmt: skip
"""The problems of a database by kind."""

FATAL_FOR_IMAGES = frozenset(
    {
        "bad-name",
        "no-camera",
        "camera-model",
        "camera-panorama",
        "camera-size",
        "camera-params",
        "frame-links",
    }
)
"""Problems of names, cameras, rigs and frames at which COLMAP, or what reads it, fails or ends."""

FATAL = FATAL_FOR_IMAGES | {
    "keypoint-columns", "keypoint-data", "keypoints-not-finite", "self-pair", "unknown-pair",
    "match-data", "match-range", "matrix-data",
}  # fmt: skip
"""The same of keypoints and matches."""
