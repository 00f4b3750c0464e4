"""The options of all commands, with help texts; which command has which, see :mod:`.parser`."""

import argparse
from pathlib import Path
from typing import Any

from colmap_affrect.comparison import DEFAULT_METHODS, LEARNED_METHODS
from colmap_affrect.options import PRESETS
from colmap_affrect.pairs.base import PairOptions


class Option:
    """A row of the tables below: an option or argument and what argparse needs to know of it."""

    def __init__(self, *flags: str, **settings: Any) -> None:
        """Take what ``add_argument`` takes; long options get a spelling with underscores too."""
        spellings = (f"--{flag[2:].replace('-', '_')}" for flag in flags if flag.startswith("--"))
        self.flags, self.settings = tuple(dict.fromkeys([*flags, *spellings])), settings


class OneOf:
    """Options that exclude each other."""

    def __init__(self, *options: Option, required: bool = False) -> None:
        self.options, self.required = options, required


def _path(name: str, metavar: str, text: str, **settings: Any) -> Option:
    return Option(name, type=Path, metavar=metavar, help=text, **settings)


def _value(name: str, metavar: str, text: str, **settings: Any) -> Option:
    return Option(name, metavar=metavar, help=text, **settings)


def _flag(name: str, text: str) -> Option:
    return Option(name, action="store_true", help=text)


def _choice(name: str, choices: list[str], text: str, **settings: Any) -> Option:
    return Option(name, choices=choices, help=text, **settings)


def _whole_numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(number) for number in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: not whole numbers with commas") from error


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


MANY: dict[str, Any] = {"nargs": "+", "action": "extend", "default": []}

VOLUME = OneOf(
    Option("-q", "--quiet", action="store_true", help="errors and the result only"),
    Option("-v", "--verbose", action="store_true", help="every image, tracebacks"),
)
OUTPUT_PATH = _path("--output-path", "PATH", "folder for all results", required=True)
RESULTS = (
    OUTPUT_PATH,
    _flag("--overwrite", "discard the results of this and later stages"),
    VOLUME,
)
"""Of commands that leave results in an output folder."""

CONVERTED_PATH = _path(
    "--output-path", "PATH", "new folder for the photographs", required=True, dest="converted_path"
)
IMAGE_PATH = _path("--image-path", "PATH",
    "folder of the photographs, searched with its sub-folders", required=True)  # fmt: skip
CONFIG = (
    _path("--config", "FILE",
        "options of an earlier run, its config.toml; those that are given here win, and with other "
        "photographs its lists, masks and depth maps do not count"),
    _path("--image-path", "PATH",
        "folder of the photographs, searched with its sub-folders (default: that of --config)"),
)  # fmt: skip
MASKS = (
    _path("--mask-path", "FOLDER",
        "masks, black where features are not wanted: a/b.jpg has a/b.jpg.png or a/b.png; "
        "photographs without one are used whole"),
    _path("--camera-mask-path", "FILE", "one mask for all images"),
)  # fmt: skip
CAMERAS = (
    _choice("--camera-mode", ["auto", "single", "per-folder", "per-image"],
        "which images share a camera (default: auto, as --cameras-path says, else those of one "
        "body, lens, focal length and size by EXIF; without EXIF one camera each, unless matches "
        "show that images of one size share one)"),
    _value("--camera-model", "MODEL", "COLMAP camera model (default: SIMPLE_RADIAL)"),
    _value("--camera-params", "A,B,...",
        "known intrinsics in COLMAP's order, e.g. 1437.2,1440.1,792.0,524.5"),
    _path("--cameras-path", "FILE",
        "known cameras: folder of a COLMAP model of these images, or a CSV file "
        "with the columns name and any of focal_px, focal_mm with plate_width_mm "
        "(of what the whole image shows), model, params, cx, cy, camera (images "
        "with one label share a camera)"),
    _value("--focal-length-px", "PX",
        "known focal length of images that --cameras-path does not name; the rest is refined",
        type=float),
    _value("--principal-point", "CX,CY",
        "where the optical axis meets the image, in px from its corner (default: its middle, wrong "
        "for prints and scans that were cropped off centre)"),
    _flag("--ignore-exif", "take neither focal lengths nor who shares a camera from EXIF"),
)  # fmt: skip
SELECTION = (
    _path("--image-list-path", "FILE",
        "names of the images to use, one per line, relative to --image-path"),
    *MASKS,
    _path("--from-database", "FILE",
        "take images, cameras, rigs, frames and priors of this COLMAP database; it is copied"),
    *CAMERAS,
    _value("--max-failures", "N",
        "exit code 1 if more images than this cannot be read (default: 0)", type=int, default=0),
)  # fmt: skip
IMAGES = (IMAGE_PATH, *SELECTION)
DESCRIPTORS = _flag("--database-descriptors",
    "descriptors into database.db too, as 8-bit SIFT, for COLMAP's own matchers")  # fmt: skip


def recipe(default: str | None = "default") -> tuple[Option, Option]:
    shown = default or "that of extract"
    text = f"one that 'recipes' lists, or the path of a TOML file (default: {shown})"
    example = "rectifier.tilt_radius=1.8" if default else "matching.max_ratio=0.8"
    return _value("--recipe", "NAME", text), setting(example)


def setting(example: str) -> Option:
    text = f"change one option of the recipe, e.g. --set {example}"
    return _value("--set", "SECTION.OPTION=VALUE", text, action="append", default=[])


MATCHER = _value("--matcher", "NAME",
    "nearest, lightglue, or one of another package (default: that of the recipe)")  # fmt: skip
GUIDED = _choice("--guided", ["auto", "always", "never"],
    "match verified pairs again, guided by their geometry: those of images that are missing or "
    "hang on few tracks, all, or none (default: auto)")  # fmt: skip
DEVICE = _value("--device", "DEVICE",
    "for networks: auto, cpu, cuda, cuda:1, mps (default: auto)",
    default="auto")  # fmt: skip
RESOURCES = (
    _path("--weights", "FOLDER",
        "weights of networks (default: $COLMAP_AFFRECT_WEIGHTS, torch's cache, packages that are "
        "installed, download)"),
    DEVICE,
)  # fmt: skip
SCHEDULER = _value("--scheduler", "ADDRESS",
    "extract and match on the dask.distributed cluster of this scheduler, such as "
    "tcp://10.0.0.1:8786 (pip install 'colmap-affrect[cluster]'); default: on this "
    "machine")  # fmt: skip
DEPTH = (
    _path("--depth-path", "FOLDER",
        "depth maps named as the images: a/b.jpg has a/b.npy, .png or .tif"),
    _choice("--depth-kind", ["z", "ray", "inverse"],
        "what depth maps hold: z, distance from the camera, or inverse depth (default: z)"),
)  # fmt: skip

PAIR_LIST = _path("--match-list-path", "FILE",
    "pairs to match, two names per line (default: all pairs)")  # fmt: skip
PAIRS = (
    PAIR_LIST,
    _value("--pairs", "A,B,...",
        "which pairs to match, all of: exhaustive, retrieval (photographs that are alike), "
        "low-resolution (whose strongest features match), gps (near to each other), sequence "
        "(following by name); together with those of --match-list-path, which takes the place of "
        "exhaustive (default: exhaustive)", type=_words),
    _value("--num-neighbors", "N",
        "retrieval, low-resolution: neighbours of a photograph on average; gps: at most; "
        f"sequence: before and after it (default: {PairOptions().num_neighbors})", type=int),
    _value("--max-distance-m", "METRES",
        f"gps: largest distance of neighbours (default: {PairOptions().max_distance_m:g})",
        type=float),
)  # fmt: skip
PRESET = _choice("--preset", list(PRESETS),
    "options of two-view geometry and mapping: ours for few photographs, or COLMAP's "
    "defaults (default: sparse)")  # fmt: skip
MAPPER = (
    _value("--mapper", "NAME",
        "sparse (ours: adjustments that know what is known of the cameras), or COLMAP's "
        "incremental or global (default: sparse)"),
    _value("--mapper-options", "KEY=VALUE",
        "options of pycolmap's IncrementalPipelineOptions or GlobalPipelineOptions, e.g. "
        "ba_refine_principal_point=true mapper.abs_pose_min_num_inliers=10; they win over the "
        "preset. With num_threads other than 1 results vary from run to run", **MANY),
)  # fmt: skip


COPIED = (
    _path("--from-database", "FILE",
        "map this COLMAP database of any program, verified or matched; it is copied"),
    _path("--image-path", "PATH",
        "folder of its photographs, for the colours of the points (with --from-database)"),
)  # fmt: skip
EXTEND = (
    _path("--extend", "MODEL",
        "register new photographs into this COLMAP model, whose poses and cameras stay; it may be "
        "of another program, and its photographs must be among those given"),
    _flag("--refine-existing", "let the poses and cameras of --extend move"),
)  # fmt: skip


NO_PAGE = Option("--no-page", dest="page", action="store_false",
    help="leave out report.html, the page to look at")  # fmt: skip


def seed(what: str = "of verification and mapping", default: int | None = None) -> Option:
    text = f"seed {what} (default: 0)"
    return _value("--random-seed", "N", text, type=int, default=default)


def json(text: str = "print report.json, no summary") -> Option:
    return _flag("--json", text)


COMPARISON = (
    _value("--methods", "A,B,...",
        "sift-colmap (all as COLMAP does it by default), sift, sift-affine-dsp (with our preset), "
        "recipes by name or path; NAME=RECIPE:section.option=value changes options (default: "
        f"{','.join(DEFAULT_METHODS)}, and {', '.join(LEARNED_METHODS)} where their weights are)",
        nargs="+"),
    _value("--seeds", "N,...",
        "seeds of verification and mapping, which run once for each (default: 0,1,2)",
        type=_whole_numbers, default=(0, 1, 2)),
    _path("--ground-truth-path", "MODEL",
        "folder of a COLMAP model with true poses of the photographs, in any frame"),
)  # fmt: skip

EVALUATION = (
    _choice("protocol", ["evd", "svp", "imc", "pairs"],
        "evd: homographies; svp, imc: camera poses; pairs: what pairs.json describes"),
    _path("--dataset-path", "FOLDER", "the dataset, in the layout of the protocol", required=True),
    _value("--recipes", "A,B,...",
        "by name or path; NAME=RECIPE:section.option=value changes options "
        "(default: unrectified-rootsift,default)",
        nargs="+", default=["unrectified-rootsift", "default"]),
    _value("--max-num-keypoints", "N",
        "equal budget: match only the strongest N features of each image, warps included",
        type=int),
    _value("--protocol-options", "KEY=VALUE",
        "settings of the protocol, e.g. threshold_px=1, max_num_iterations=1000 "
        "(svp, imc: what the code of the paper did)", **MANY),
)  # fmt: skip

H5_FILES = tuple(
    _path(f"--{content}-path", "FILE", f"HDF5 file of {content}", required=True)
    for content in ("features", "matches")
)
IMPORT_TARGET = _path("--database-path", "FILE", "the database to make; must not exist",
    required=True)  # fmt: skip
SKIP_VERIFICATION = _flag("--skip-verification", "no two-view geometries")
EXPORT_SOURCE = _path("--database-path", "FILE", "any COLMAP database; a copy of it is read",
    required=True)  # fmt: skip

OLD_DATABASE = (
    _path("path", "PATH", "output folder, or any COLMAP database; a copy of it is read"),
    _path("database_path", "OUT.db", "the database to make; must not exist"),
    _choice("--colmap", ["3.8"], "whose tables to write; COLMAP 3.8 to 3.13 read these",
        default="3.8"),
)  # fmt: skip
MODEL = _path("--model-path", "MODEL", "folder of a COLMAP model, such as out/sparse/0",
    required=True)  # fmt: skip
EXPORT = (
    MODEL,
    _path("--output-path", "FOLDER", "folder for the files; nothing in it is overwritten",
        required=True, dest="target_path"),
    _value("--format", "A,B,...",
        "ply (points), text (COLMAP's), undistorted (photographs and model, for dense "
        "reconstruction), nerfstudio (the same with transforms.json, for Gaussian splatting too), "
        "cameras (CSV) (default: ply,text,cameras)",
        type=_words, default=("ply", "text", "cameras")),
    _path("--image-path", "PATH",
        "folder of the photographs, to undistort them (default: that of the run)"),
)  # fmt: skip
ALIGN = (
    MODEL,
    _path("--output-path", "MODEL", "folder for the new model, in metres; must not exist",
        required=True, dest="target_path"),
    OneOf(
        _path("--gps", "DATABASE",
            "positions by GPS that a COLMAP database holds, such as out/database.db"),
        _path("--positions", "FILE",
            "CSV of where photographs were taken: name and x,y,z in metres, or name and "
            "latitude,longitude,altitude"),
        _path("--points", "FILE",
            "CSV of points that are marked in two photographs or more: point,image,px,py, and "
            "x,y,z of control points in metres (px, py: from the upper left corner)"),
    ),
    _value("--distance", "A,B,METRES",
        "a known distance, of two photographs or two points of --points: gives the scale alone; "
        "may be repeated", action="append", default=[]),
)  # fmt: skip

IMAGE = Option("image", type=Path, metavar="IMAGE", help="the photograph")
DOCTOR = (
    _path("path", "PATH", "output folder, or any COLMAP database", nargs="?"),
    _path("--image-path", "PATH",
        "folder of the photographs, to compare their sizes with the cameras"),
    _path("--weights", "FOLDER", "look for weights there first"),
)  # fmt: skip
SHOWN_RECIPE = Option("name", nargs="?", help="print this recipe with all of its options")
WEIGHTS = (
    _choice("action", ["list", "fetch"],
        "fetch downloads what is missing or damaged, for a machine without network (default: list)",
        nargs="?", default="list"),
    _value("keys", "KEY", "which files, all of a name (aliked, lightglue), or those of a recipe "
        "(default: list all, fetch affnet, orinet and hardnet)",
        nargs="*"),
    _path("--weights", "FOLDER",
        "look there first, and fetch into it (default: torch's cache)"),
)  # fmt: skip
