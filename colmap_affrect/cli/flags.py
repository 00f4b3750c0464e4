"""All flags and arguments, with help texts; which command has which, see :mod:`.parser`.

What :mod:`.given` makes an options class of has the field as destination, as ``cameras.mode``.
"""

import csv
import math
from argparse import ArgumentTypeError
from pathlib import Path
from typing import Any

from colmap_affrect.comparison import DEFAULT_METHODS
from colmap_affrect.options import EFFORT_NAMES, PRESETS

Settings = dict[str, Any]
"""What ``add_argument`` takes."""


def filled(text: str) -> str:
    """Refuse nothing at all, which would be the current folder, or no option."""
    if not text:
        raise ArgumentTypeError("is empty; is a variable of the shell not set?")
    return text


def path(text: str) -> Path:
    return Path(filled(text))


def _value(metavar: str, text: str, **settings: Any) -> Settings:
    return {"metavar": metavar, "help": text, "type": filled, **settings}


def _path(metavar: str, text: str, **settings: Any) -> Settings:
    return {"metavar": metavar, "help": text, "type": path, **settings}


def _switch(text: str, **settings: Any) -> Settings:
    return {"action": "store_true", "default": None, "help": text, **settings}


def integers(text: str) -> tuple[int, ...]:
    return tuple(int(number) for number in text.split(","))


def count(text: str) -> int:
    number = int(text)
    if number < 0:
        raise ValueError
    return number


def minutes(text: str) -> float:
    number = float(text)
    if not number >= 0:
        raise ValueError
    return number


def _fields(text: str, wanted: str) -> list[str]:
    """Split at commas as a table does: a name with a comma stands in double quotes."""
    try:
        fields = next(csv.reader([text], strict=True), [])
    except csv.Error:  # of quotes that do not end, for one
        fields = []
    if len(fields) != wanted.count(",") + 1:
        raise ArgumentTypeError(
            f"{text!r}: give {wanted}, a name that holds a comma in double quotes"
        )
    return fields


def pair(text: str) -> tuple[str, str]:
    first, second = _fields(text, "A,B")
    return first, second


def words(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def distance(text: str) -> tuple[str, str, float]:
    first, second, metres = _fields(text, "A,B,METRES")
    return first, second, float(metres)


FLAGS: dict[str, Settings] = {
    # what all commands share
    "-q,--quiet": _switch("errors and the result only"),
    "-v,--verbose": _switch("every image, tracebacks"),
    "--json": _switch("print the report as JSON, no summary"),
    "--output-path": _path("PATH", "folder for all results"),
    "--overwrite": _switch("discard the results of this and later stages"),
    "--max-failures": _value("N", "exit code 1 if more images than this cannot be read "
        "(default: 0)", type=count),
    "--no-page": {"dest": "page", "action": "store_false", "default": True,
        "help": "leave out report.html, the page to look at"},
    "--random-seed": _value("N", "seed of all that is left to chance (default: 0)", type=int),
    "--weights": _path("FOLDER", "weights of networks, looked for here first (then in "
        "$COLMAP_AFFRECT_WEIGHTS, torch's cache, installed packages; then downloaded)"),
    "--device": _value("DEVICE", "for networks: auto, cpu, cuda, cuda:1, mps (default: auto)"),
    "--scheduler": _value("ADDRESS", "extract, match and verify on the dask.distributed cluster "
        "of this scheduler, such as tcp://10.0.0.1:8786 (pip install 'colmap-affrect[cluster]'); "
        "default: on this machine"),
    # photographs, masks and cameras
    "--image-path": _path("PATH", "folder of the photographs, searched with its sub-folders, "
        "linked ones too"),
    "--image-list-path": _path("FILE",
        "names of the images to use, one per line, relative to --image-path"),
    "--from-database": _path("FILE",
        "take images, cameras, rigs, frames and priors of this COLMAP database; it is copied"),
    "--mask-path": _path("FOLDER", "masks, black where features are not wanted: a/b.jpg has "
        "a/b.jpg.png or a/b.png; photographs without one are used whole", dest="masks.path"),
    "--camera-mask-path": _path("FILE", "one mask for all images", dest="masks.camera_path"),
    "--camera-mode": _value("MODE", "which images of one size share a camera: auto, single (all), "
        "per-folder or per-image (default: auto, as --cameras-path says, else those of one body, "
        "lens and focal length by EXIF; without EXIF all, unless they match better with one each)",
        dest="cameras.mode"),
    "--camera-model": _value("MODEL", "COLMAP camera model (default: SIMPLE_RADIAL)",
        dest="cameras.model"),
    "--camera-params": _value("A,B,...",
        "known intrinsics in COLMAP's order, e.g. 1437.2,1440.1,792,524.5", dest="cameras.params"),
    "--cameras-path": _path("FILE", "known cameras: folder of a COLMAP model of these images, or "
        "a CSV file with the columns name and any of focal_px, focal_mm with "
        "plate_width_mm (of what the whole image shows), model, params, cx, cy, camera (images "
        "with one label share a camera)", dest="cameras.cameras_path"),
    "--focal-length-px": _value("PX", "known focal length of images that --cameras-path does not "
        "name; the rest is refined", dest="cameras.focal_length_px", type=float),
    "--focal-mm": _value("MM", "focal length of the lens of all images that have none by these or "
        "by EXIF; with --film-width-mm", dest="cameras.focal_mm", type=float),
    "--film-width-mm": _value("MM", "longer side of what an image shows of film, plate or sensor, "
        "36 of small-format film", dest="cameras.film_width_mm", type=float),
    "--principal-point": _value("CX,CY", "where the optical axis meets the image, in px from its "
        "corner (default: its middle, wrong for prints and scans that were cropped off centre)",
        dest="cameras.principal_point"),
    "--ignore-exif": _switch("take neither focal lengths nor who shares a camera from EXIF",
        dest="cameras.ignore_exif"),
    # features, pairs and matches
    "--recipe": _value("NAME",
        "one that 'recipes' lists, or the path of a TOML file (default: default)"),
    "--set": _value("SECTION.OPTION=VALUE", "change one option of the recipe, e.g. --set "
        "rectifier.tilt_radius=1.8; may be repeated", action="append", default=[]),
    "--effort": _value("EFFORT", "how much is tried for photographs that are missing or doubtful "
        "in the first model: low ends after learned matching, normal adds what is likely to help "
        "for about as long as the first model took, a minute at least, high for five times as long "
        "(default: normal)", choices=EFFORT_NAMES, default="normal"),
    "--max-time": _value("MINUTES", "match nothing again after so long, whatever the effort; the "
        "same command goes on (default: no limit)", type=minutes, default=math.inf,
        dest="max_minutes"),
    "--depth-path": _path("FOLDER",
        "depth maps named as the images: a/b.jpg has a/b.npy, .png or .tif"),
    "--database-descriptors": _switch(
        "descriptors into database.db too, as 8-bit SIFT, for COLMAP's own matchers"),
    "--match-list-path": _path("FILE", "pairs to match, two names, or paths, per line, and perhaps "
        "a score (default: all pairs)",
        dest="pairs.match_list_path"),
    "--pairs": _value("A,B,...", "which pairs to match, all of: exhaustive, retrieval "
        "(photographs that are alike), gps (near to each other), sequence (following by name); "
        "with those of --match-list-path, which takes the place of exhaustive (default: "
        "exhaustive)",
        dest="pairs.methods", type=words),
    "--num-neighbors": _value("N", "retrieval: neighbours of a photograph on average; gps: at "
        "most; sequence: before and after it (default: 20)",
        dest="pairs.num_neighbors", type=int),
    "--max-distance-m": _value("METRES", "gps: largest distance of neighbours (default: 100)",
        dest="pairs.max_distance_m", type=float),
    # verification and mapping
    "--preset": _value("NAME", "options of two-view geometry and mapping: ours for few "
        "photographs, or COLMAP's defaults (default: sparse)", choices=PRESETS),
    "--mapper": _value("NAME", "sparse (ours: adjustments that know what is known of the cameras), "
        "or COLMAP's incremental or global, in one thread (default: sparse)"),
    "--mapper-options": _value("KEY=VALUE", "options of pycolmap's IncrementalPipelineOptions or "
        "GlobalPipelineOptions, e.g. ba_refine_principal_point=true "
        "mapper.abs_pose_min_num_inliers=10; they win over the preset. With num_threads other "
        "than 1 results vary from run to run", nargs="+", action="extend", default=[]),
    "--extend": _path("MODEL", "register new photographs into this COLMAP model, whose poses and "
        "cameras stay; it may be of another program, and its photographs must be among those "
        "given"),
    "--refine-existing": _switch("let the poses and cameras of --extend move"),
    "--tie-points": _path("FILE", "the same points marked by hand in several photographs: CSV of "
        "point,photograph,x,y in px from the upper left corner, as the page of a run saves it; "
        "six or more join a lost photograph, or models", dest="tie_points_path"),
    "--reject-pair": _value("A,B", "do not use the matches of these two photographs, which are "
        "wrong; may be repeated; without it they are used again; a name with a comma in double "
        "quotes", type=pair, action="append",
        default=[], dest="rejected"),
    "--leave-out": _value("NAME", "do not map this photograph; may be repeated; without it it is "
        "mapped again", action="append", default=[], dest="left_out"),
    "--from-database@map": _path("FILE",
        "map this COLMAP database of any program, verified or matched; it is copied"),
    "--image-path@map": _path("PATH",
        "folder of its photographs, for the colours of the points (with --from-database)"),
    # panoramas
    "--output-path@new": _path("PATH", "new folder for views and models, or that of a run that was "
        "interrupted, which goes on", dest="target_path"),
    "--order": _value("ORDER", "match panoramas that follow each other by name (sequence), or all "
        "(exhaustive) (default: sequence)", choices=["sequence", "exhaustive"],
        default="sequence"),
    # comparison and evaluation
    "--methods": _value("A,B,...", "sift-colmap (all as COLMAP does it by default), sift "
        "(with our preset), recipes by name or path; "
        "NAME=RECIPE:section.option=value changes options "
        f"(default: {','.join(DEFAULT_METHODS)})", nargs="+", default=DEFAULT_METHODS),
    "--seeds": _value("N,...", "seeds of verification and mapping, which run once for each "
        "(default: 0,1,2)", type=integers, default=(0, 1, 2)),
    "--ground-truth-path": _path("MODEL",
        "folder of a COLMAP model with true poses of the photographs, in any frame"),
    "protocol": {"choices": ["evd", "svp", "imc", "pairs"],
        "help": "evd: homographies; svp, imc: camera poses; pairs: what pairs.json describes"},
    "--dataset-path": _path("FOLDER", "the dataset, in the layout of the protocol"),
    "--recipes": _value("A,B,...", "by name or path; NAME=RECIPE:section.option=value changes "
        "options (default: unrectified-rootsift,default)", nargs="+",
        default=["unrectified-rootsift", "default"]),
    "--max-num-keypoints": _value("N", "equal budget: match only the strongest N features of each "
        "image, warps included", type=int),
    # features and models from and for other programs
    "--output-path@photographs": _path("PATH", "new folder for them", dest="target_path"),
    "--features-path": _path("FILE", "HDF5 file of features"),
    "--matches-path": _path("FILE", "HDF5 file of matches"),
    "--matches-path@given": _path("FILE", "matches of hloc or deep-image-matching (HDF5), or a "
        "list of COLMAP's matches_importer (default: those that a database has, else images are "
        "matched by their descriptors)"),
    "--match-type": _value("TYPE", "what --matches-path has: raw matches, or inliers, which are "
        "taken for verified (default: raw)", choices=["raw", "inliers"]),
    "--match-list-path@given": _path("FILE", "pairs to match by their descriptors, where there are "
        "no matches (default: all pairs)", dest="match_list_path"),
    "--database-path": _path("FILE", "the database to make; must not exist"),
    "--database-path@read": _path("FILE", "any COLMAP database; a copy of it is read"),
    "--colmap": _value("VERSION", "whose tables to write; COLMAP 3.8 to 3.13 read those of 3.8",
        choices=["3.8"], default="3.8"),
    "path": _path("PATH", "output folder, or any COLMAP database; a copy of it is read"),
    "database_path": _path("OUT.db", "the database to make; must not exist"),
    "--descriptors": _switch("of an output folder, with the descriptors of features.h5 as 8-bit "
        "SIFT, which COLMAP's own matchers need"),
    "--model-path": _path("MODEL", "folder of a COLMAP model, or of a run (its "
        "largest one)"),
    "--output-path@files": _path("FOLDER", "folder for the files; nothing in it is overwritten",
        dest="target_path"),
    "--format": _value("A,B,...", "ply (points), text (COLMAP's), undistorted (photographs and "
        "model, for dense reconstruction), nerfstudio (the same with transforms.json, for "
        "Gaussian splatting too), mvsnet (the same with the model as text), cameras (CSV), report "
        "(the page of the run, as PDF where a browser is there) "
        "(default: ply,text,cameras; no text where names have blanks)", type=words, default=()),
    "--camera-model@export": _value("MODEL", "COLMAP camera model of text and cameras, fitted to "
        "the cameras, e.g. RADIAL for OpenSfM (default: their own)", dest="camera_model"),
    "--image-path@export": _path("PATH",
        "folder of the photographs, to undistort them (default: that of the run)"),
    "--output-path@model": _path("MODEL", "folder for the new model, in metres; must not exist",
        dest="target_path"),
    "--gps": _path("DATABASE",
        "positions by GPS that a COLMAP database holds, such as out/database.db"),
    "--positions": _path("FILE", "CSV of where photographs were taken: name and x,y,z in metres, "
        "or name and latitude,longitude,altitude"),
    "--points": _path("FILE", "CSV of points that are marked in two photographs or more: "
        "point,image,px,py, and x,y,z of control points in metres (px, py: from the upper left "
        "corner)"),
    "--distance": _value("A,B,METRES", "a known distance, of two photographs or two points of "
        "--points: gives the scale alone; may be repeated; a name with a comma in double quotes",
        type=distance, action="append",
        default=[]),
    # looking into things
    "image": _path("IMAGE", "the photograph"),
    "photographs": _path("PHOTO", "a photograph, or several", nargs="+"),
    "--output-path@pictures": _path("FOLDER", "folder for a picture of the lines of each "
        "photograph; nothing in it is overwritten (default: none are drawn)", dest="target_path"),
    "pair": _value("IMAGE", "the names of two photographs, as in pairs.txt", nargs=2),
    "--image-path@pair": _path("PATH", "folder of the photographs (default: that of the run)"),
    "--output-path@pair": _path("FILE", "PNG file to make, in no folder of photographs (default: "
        "pairs/a--b.png in the folder of the run)", dest="picture_path"),
    "before": _path("BEFORE", "output folder of a run, or a folder of models 0, 1, ..."),
    "after": _path("AFTER", "output folder of another run of the same photographs"),
    "--output-path@page": _path("FILE", "HTML file to make (default: compared.html in AFTER)",
        dest="page_path"),
    "path@run": _path("PATH", "output folder of a run"),
    "--port": {"metavar": "N", "type": count, "default": None, "help": "of 127.0.0.1; 0 takes one "
        "that is free (default: 8427)"},
    "path@optional": _path("PATH", "output folder, any COLMAP database, or a model", nargs="?"),
    "name": {"nargs": "?", "help": "print this recipe with all of its options"},
    "action": {"choices": ["list", "fetch"], "nargs": "?", "default": "list",
        "help": "fetch downloads what is missing or damaged, for a machine without network "
        "(default: list)"},
    "keys": _value("KEY", "which files, all of a name (aliked, lightglue), or those of a recipe "
        "(default: list all, fetch affnet, orinet and hardnet)", nargs="*"),
}  # fmt: skip
"""By name, with what stands behind @ where commands use one name for several things."""
