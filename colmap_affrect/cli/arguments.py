"""The commands and their options, with help texts."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from colmap_affrect import __version__
from colmap_affrect.cli import commands
from colmap_affrect.comparison.methods import DEFAULT_METHODS
from colmap_affrect.options import MAPPERS, PRESETS, PairOptions

if TYPE_CHECKING:
    # The types of add_subparsers() and of what takes arguments have no public names.
    Container = argparse._ActionsContainer
    Subparsers = argparse._SubParsersAction[argparse.ArgumentParser]

Function = Callable[[argparse.Namespace], int]

EPILOG = """\
examples:
  colmap-affrect run --image-path photos --output-path out
  colmap-affrect run --image-path photos --output-path out --camera-mode single
  colmap-affrect run --image-path photos --output-path out --recipe unrectified-rootsift
  colmap-affrect extract --image-path photos --output-path out
  colmap-affrect pairs   --output-path out --pairs retrieval,sequence --num-neighbors 30
  colmap-affrect match   --output-path out
  colmap-affrect verify  --output-path out
  colmap-affrect map     --output-path out
  colmap-affrect run --image-path photos --output-path out --recipe on-demand
  colmap-affrect run --image-path photos --output-path out --recipe depth-planes-recommended \\
      --depth-path depth
  colmap-affrect compare --image-path photos --output-path out
  colmap-affrect compare --image-path photos --output-path out --methods sift,default --seeds 0
  colmap-affrect evaluate evd --dataset-path EVD --output-path out \\
      --recipes unrectified-rootsift,default,on-demand
  colmap-affrect inspect photos/a.jpg --output-path out
  colmap-affrect weights fetch
  colmap-affrect doctor out
  colmap-affrect doctor database.db --image-path photos
  colmap-affrect import-h5 --image-path photos --features-path features.h5 \\
      --matches-path matches.h5 --database-path new.db
  colmap-affrect export-h5 --database-path any.db --features-path features.h5 \\
      --matches-path matches.h5

Run a command again and it goes on where it stopped. Exit codes: 0 done, 1 failed (one line
says why; also when images could not be read, see --max-failures), 2 wrong usage, 3 finished
without a model, 130 interrupted.
"""


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="colmap-affrect",
        description="Rectified wide-baseline features for COLMAP: photographs in, model out.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"colmap-affrect {__version__}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = _command(subparsers, "run", commands.run, "all stages: photographs in, COLMAP model out")
    _add_images(run)
    _add_database_descriptors(run)
    _add_recipe(run)
    _add_resources(run)
    _add_scheduler(run)
    _add_depth(run)
    _add_pairs(run)
    _add_preset(run)
    _add_mapper(run)
    _add_seed(run)
    _add_json(run)

    extract = _command(
        subparsers, "extract", commands.extract, "features into features.h5 and database.db"
    )
    _add_images(extract)
    _add_database_descriptors(extract)
    _add_recipe(extract)
    _add_resources(extract)
    _add_scheduler(extract)
    _add_depth(extract)

    pairs = _command(subparsers, "pairs", commands.pairs, "which images to match, into pairs.txt")
    _add_pairs(pairs)

    match = _command(subparsers, "match", commands.match, "matches into matches.h5 and database.db")
    _add_recipe(match, default=None)
    _add_device(match)
    _add_scheduler(match)

    verify = _command(subparsers, "verify", commands.verify, "two-view geometries into database.db")
    _add_preset(verify)
    _add_seed(verify)

    escalate = _command(
        subparsers,
        "escalate",
        commands.escalate,
        "match pairs that failed again, with more warps (recipes that escalate, as on-demand)",
    )
    _add_resources(escalate)
    _add_scheduler(escalate)

    mapping = _command(subparsers, "map", commands.map, "COLMAP models into sparse/")
    _add_preset(mapping)
    _add_mapper(mapping)
    _add_seed(mapping)
    _add_json(mapping)

    compare = _command(
        subparsers,
        "compare",
        commands.compare,
        "how many photographs, and which, COLMAP's SIFT and recipes register; with pictures",
    )
    _add_images(compare)
    _add_option(
        compare,
        "--methods",
        nargs="+",
        default=DEFAULT_METHODS,
        metavar="A,B,...",
        help="sift, sift-affine-dsp, recipes by name or path; NAME=RECIPE:section.option=value "
        f"changes options (default: {','.join(DEFAULT_METHODS)})",
    )
    _add_option(
        compare,
        "--seeds",
        type=_numbers,
        default=(0, 1, 2),
        metavar="N,...",
        help="seeds of verification and mapping, which run once for each (default: 0,1,2)",
    )
    _add_option(
        compare,
        "--ground-truth-path",
        type=Path,
        metavar="MODEL",
        help="folder of a COLMAP model with true poses of the photographs, in any frame",
    )
    _add_resources(compare)
    _add_depth(compare)
    _add_pair_list(compare)
    _add_preset(compare)
    _add_mapper(compare)
    compare.add_argument("--json", action="store_true", help="print comparison.json, no summary")
    compare.add_argument(
        "--viewer",
        action="store_true",
        help="also comparison.rrd for rerun (pip install 'colmap-affrect[viewer]')",
    )

    evaluate = _command(
        subparsers,
        "evaluate",
        commands.evaluate,
        "score recipes on pairs of images with a known truth, as the paper does on its datasets",
    )
    evaluate.add_argument(
        "protocol",
        choices=["evd", "svp", "imc", "pairs"],
        help="evd: homographies; svp, imc: camera poses; pairs: what pairs.json describes",
    )
    _add_option(
        evaluate,
        "--dataset-path",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="the dataset, in the layout of the protocol",
    )
    _add_option(
        evaluate,
        "--recipes",
        nargs="+",
        default=["unrectified-rootsift", "default"],
        metavar="A,B,...",
        help="by name or path; NAME=RECIPE:section.option=value changes options "
        "(default: unrectified-rootsift,default)",
    )
    _add_option(
        evaluate,
        "--baseline",
        metavar="NAME",
        help="the recipe that the others are tested against, pair by pair",
    )
    _add_option(
        evaluate,
        "--max-num-keypoints",
        type=int,
        metavar="N",
        help="equal budget: match only the strongest N features of each image, warps included",
    )
    _add_option(
        evaluate,
        "--protocol-options",
        nargs="+",
        action="extend",
        default=[],
        metavar="KEY=VALUE",
        help="settings of the protocol, e.g. magsac_threshold_px=1 (evd), max_num_iterations=1000 "
        "(svp, imc: what the code of the paper did)",
    )
    _add_resources(evaluate)
    _add_depth(evaluate)
    _add_seed(evaluate, "of the estimators and the statistics")
    evaluate.add_argument("--json", action="store_true", help="print evaluation.json, no tables")

    inspect = _command(
        subparsers,
        "inspect",
        commands.inspect,
        "draw what a recipe does to one image: regions, warps, features; the plan as JSON",
        overwrites=False,
    )
    inspect.add_argument("image", type=Path, metavar="IMAGE", help="the photograph")
    _add_masks(inspect)
    _add_recipe(inspect)
    _add_resources(inspect)
    _add_depth(inspect)

    import_h5 = _listing(
        subparsers,
        "import-h5",
        commands.import_h5,
        "features and matches of hloc or deep-image-matching into a new COLMAP database",
    )
    _add_image_path(import_h5)
    _add_h5_files(import_h5)
    _add_option(
        import_h5,
        "--database-path",
        type=Path,
        required=True,
        metavar="FILE",
        help="the database to make; must not exist",
    )
    _add_cameras(import_h5)
    import_h5.add_argument(
        "--layout",
        choices=["auto", "hloc", "dim"],
        default="auto",
        help="of the files; dim is deep-image-matching's (default: auto, as matches are stored)",
    )
    _add_option(
        import_h5,
        "--pixel-origin",
        choices=["center", "corner"],
        default="center",
        help="where (0, 0) is in the first pixel (default: center, as both programs have it)",
    )
    _add_option(
        import_h5, "--skip-verification", action="store_true", help="no two-view geometries"
    )
    _add_seed(import_h5)
    _add_volume(import_h5)

    export_h5 = _listing(
        subparsers,
        "export-h5",
        commands.export_h5,
        "features and matches of an output folder or a database for hloc or deep-image-matching",
    )
    source = export_h5.add_mutually_exclusive_group(required=True)
    _add_option(
        source,
        "--output-path",
        dest="workspace_path",
        type=Path,
        metavar="PATH",
        help="an output folder in which matching is done",
    )
    _add_option(
        source,
        "--database-path",
        type=Path,
        metavar="FILE",
        help="or any COLMAP database; a copy of it is read",
    )
    _add_h5_files(export_h5)
    export_h5.add_argument(
        "--layout",
        choices=["hloc", "dim"],
        default="hloc",
        help="of the files; dim is deep-image-matching's (default: hloc)",
    )
    export_h5.add_argument(
        "--half", action="store_true", help="float16, which rounds coordinates to 1 px and more"
    )
    _add_volume(export_h5)

    doctor = _listing(
        subparsers,
        "doctor",
        commands.doctor,
        "look for what is wrong with results or the installation, and say what to do about it",
    )
    doctor.add_argument(
        "path", nargs="?", type=Path, metavar="PATH", help="output folder, or any COLMAP database"
    )
    _add_option(
        doctor,
        "--image-path",
        type=Path,
        metavar="PATH",
        help="folder of the photographs, to compare their sizes with the cameras",
    )
    _add_option(
        doctor,
        "--weights",
        type=Path,
        metavar="FOLDER",
        help="look for weights there first",
    )
    doctor.add_argument("--json", action="store_true", help="print JSON")
    _add_volume(doctor)

    recipes = _listing(
        subparsers, "recipes", commands.recipes, "list the recipes and what they need"
    )
    recipes.add_argument("name", nargs="?", help="print this recipe with all of its options")

    weights = _listing(
        subparsers,
        "weights",
        commands.weights,
        "list the files of weights, or fetch them beforehand",
    )
    weights.add_argument(
        "action",
        nargs="?",
        choices=["list", "fetch"],
        default="list",
        help="fetch downloads what is missing, for a machine without network (default: list)",
    )
    weights.add_argument(
        "keys",
        nargs="*",
        metavar="KEY",
        help="which files to fetch (default: affnet, orinet, hardnet)",
    )
    _add_option(
        weights,
        "--weights",
        type=Path,
        metavar="FOLDER",
        help="look there first, and fetch into it (default: torch's cache)",
    )
    return parser


def _listing(
    subparsers: Subparsers, name: str, function: Function, summary: str
) -> argparse.ArgumentParser:
    """Add a command that prints and leaves no files."""
    command: argparse.ArgumentParser = subparsers.add_parser(
        name,
        help=summary,
        description=summary,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(function=function, output_path=None)
    return command


def _command(
    subparsers: Subparsers, name: str, function: Function, summary: str, *, overwrites: bool = True
) -> argparse.ArgumentParser:
    """Add a command that works in an output folder."""
    command = _listing(subparsers, name, function, summary)
    _add_option(
        command,
        "--output-path",
        type=Path,
        required=True,
        metavar="PATH",
        help="folder for all results",
    )
    if overwrites:
        command.add_argument(
            "--overwrite", action="store_true", help="discard the results of this and later stages"
        )
    _add_volume(command)
    return command


def _add_volume(command: argparse.ArgumentParser) -> None:
    volume = command.add_mutually_exclusive_group()
    volume.add_argument("-q", "--quiet", action="store_true", help="errors and the result only")
    volume.add_argument("-v", "--verbose", action="store_true", help="every image, tracebacks")


def _add_option(command: Container, flag: str, **settings: Any) -> None:
    """Add a long option, accepted with underscores too, as COLMAP writes them."""
    underscored = "--" + flag.removeprefix("--").replace("-", "_")
    flags = [flag, underscored] if underscored != flag else [flag]
    command.add_argument(*flags, **settings)


def _add_image_path(command: argparse.ArgumentParser) -> None:
    _add_option(
        command,
        "--image-path",
        type=Path,
        required=True,
        metavar="PATH",
        help="folder of the photographs, searched with its sub-folders",
    )


def _add_h5_files(command: argparse.ArgumentParser) -> None:
    for content in ("features", "matches"):
        _add_option(
            command,
            f"--{content}-path",
            type=Path,
            required=True,
            metavar="FILE",
            help=f"HDF5 file of {content}",
        )


def _add_images(command: argparse.ArgumentParser) -> None:
    _add_image_path(command)
    _add_option(
        command,
        "--image-list-path",
        type=Path,
        metavar="FILE",
        help="names of the images to use, one per line, relative to --image-path",
    )
    _add_masks(command)
    _add_option(
        command,
        "--from-database",
        type=Path,
        metavar="FILE",
        help="take images, cameras, rigs, frames and priors of this COLMAP database; it is copied",
    )
    _add_cameras(command)
    _add_option(
        command,
        "--max-failures",
        type=int,
        default=0,
        metavar="N",
        help="exit code 1 if more images than this cannot be read (default: 0)",
    )


def _add_database_descriptors(command: argparse.ArgumentParser) -> None:
    _add_option(
        command,
        "--database-descriptors",
        action="store_true",
        help="descriptors into database.db too, as 8-bit SIFT, for COLMAP's own matchers",
    )


def _numbers(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(number) for number in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: not whole numbers with commas") from error


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def _add_cameras(command: argparse.ArgumentParser) -> None:
    _add_option(
        command,
        "--camera-mode",
        default="auto",
        choices=["auto", "single", "per-folder", "per-image"],
        help="which images share a camera (default: auto, by EXIF)",
    )
    _add_option(
        command,
        "--camera-model",
        default="SIMPLE_RADIAL",
        metavar="MODEL",
        help="COLMAP camera model (default: SIMPLE_RADIAL)",
    )
    _add_option(
        command,
        "--camera-params",
        default="",
        metavar="A,B,...",
        help="known intrinsics in COLMAP's order, e.g. 1437.2,1440.1,792.0,524.5",
    )


def _add_masks(command: argparse.ArgumentParser) -> None:
    _add_option(
        command,
        "--mask-path",
        type=Path,
        metavar="FOLDER",
        help="masks, black where features are not wanted: a/b.jpg has a/b.jpg.png or a/b.png",
    )
    _add_option(
        command,
        "--camera-mask-path",
        type=Path,
        metavar="FILE",
        help="one mask for all images",
    )


def _add_recipe(command: argparse.ArgumentParser, default: str | None = "default") -> None:
    shown = default or "that of extract"
    _add_option(
        command,
        "--recipe",
        default=default,
        metavar="NAME",
        help=f"one that 'recipes' lists, or the path of a TOML file (default: {shown})",
    )
    _add_option(
        command,
        "--set",
        action="append",
        default=[],
        metavar="SECTION.OPTION=VALUE",
        help="change one option of the recipe, e.g. --set rectifier.tilt_radius=1.8",
    )


def _add_resources(command: argparse.ArgumentParser) -> None:
    _add_option(
        command,
        "--weights",
        type=Path,
        metavar="FOLDER",
        help="weights of networks (default: $COLMAP_AFFRECT_WEIGHTS, torch's cache, download)",
    )
    _add_device(command)


def _add_device(command: argparse.ArgumentParser) -> None:
    _add_option(
        command,
        "--device",
        default="auto",
        metavar="DEVICE",
        help="for networks and matching: auto, cpu, cuda, cuda:1, mps (default: auto)",
    )


def _add_scheduler(command: argparse.ArgumentParser) -> None:
    _add_option(
        command,
        "--scheduler",
        metavar="ADDRESS",
        help="extract and match on the dask.distributed cluster of this scheduler, such as "
        "tcp://10.0.0.1:8786 (pip install 'colmap-affrect[cluster]'); default: on this machine",
    )


def _add_depth(command: argparse.ArgumentParser) -> None:
    source = command.add_mutually_exclusive_group()
    _add_option(
        source,
        "--depth-path",
        type=Path,
        metavar="FOLDER",
        help="depth maps named as the images: a/b.jpg has a/b.npy, .npz, .png, .exr or .h5",
    )
    _add_option(
        source,
        "--depth-model",
        metavar="NAME",
        help="monocular depth network: name or local folder for Hugging Face transformers",
    )
    _add_option(
        command,
        "--depth-kind",
        choices=["z", "ray", "inverse"],
        help="what depth maps hold: z, distance from the camera, or inverse depth (default: z)",
    )


def _add_pair_list(command: argparse.ArgumentParser) -> None:
    _add_option(
        command,
        "--match-list-path",
        type=Path,
        metavar="FILE",
        help="pairs to match, two names per line (default: all pairs)",
    )


def _add_pairs(command: argparse.ArgumentParser) -> None:
    _add_pair_list(command)
    defaults = PairOptions()
    _add_option(
        command,
        "--pairs",
        type=_words,
        default=defaults.methods,
        metavar="A,B,...",
        help="which pairs to match, all of: exhaustive, retrieval (photographs that are alike), "
        "low-resolution (whose strongest features match), gps (near to each other), sequence "
        "(following by name); together with those of --match-list-path, which takes the place of "
        "exhaustive (default: exhaustive)",
    )
    _add_option(
        command,
        "--num-neighbors",
        type=int,
        default=defaults.num_neighbors,
        metavar="N",
        help="retrieval, low-resolution: neighbours of a photograph on average; gps: at most; "
        f"sequence: before and after it (default: {defaults.num_neighbors})",
    )
    _add_option(
        command,
        "--max-distance-m",
        type=float,
        default=defaults.max_distance_m,
        metavar="METRES",
        help=f"gps: largest distance of neighbours (default: {defaults.max_distance_m:g})",
    )


def _add_preset(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--preset",
        default="sparse",
        choices=PRESETS,
        help="options of two-view geometry and mapping: ours for few photographs, or COLMAP's "
        "defaults (default: sparse)",
    )


def _add_mapper(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--mapper",
        default="incremental",
        choices=MAPPERS,
        help="COLMAP's incremental or global mapper (default: incremental)",
    )
    _add_option(
        command,
        "--mapper-options",
        nargs="+",
        action="extend",
        default=[],
        metavar="KEY=VALUE",
        help="options of pycolmap's IncrementalPipelineOptions or GlobalPipelineOptions, e.g. "
        "ba_refine_principal_point=true mapper.abs_pose_min_num_inliers=10; they win over the "
        "preset. With num_threads other than 1 results vary from run to run",
    )


def _add_seed(command: argparse.ArgumentParser, what: str = "of verification and mapping") -> None:
    _add_option(
        command,
        "--random-seed",
        type=int,
        default=0,
        metavar="N",
        help=f"seed {what} (default: 0)",
    )


def _add_json(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true", help="print report.json, no summary")
