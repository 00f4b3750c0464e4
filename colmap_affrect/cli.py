"""Command line: parse, call one library function, print its result."""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from colmap_affrect import __version__
from colmap_affrect.comparison.methods import DEFAULT_METHODS
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.options import (
    MAPPERS,
    PRESETS,
    CameraOptions,
    MappingOptions,
    MaskOptions,
    VerificationOptions,
)
from colmap_affrect.outcomes import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_NO_MODEL,
    EXIT_OK,
    ReconstructionReport,
)
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.workspace import Workspace

if TYPE_CHECKING:
    from colmap_affrect.comparison.results import Comparison
    from colmap_affrect.extraction import Resources
    from colmap_affrect.pipeline import RunOptions
    from colmap_affrect.recipes import Recipe

    # The types of add_subparsers() and of what takes arguments have no public names.
    Container = argparse._ActionsContainer
    Subparsers = argparse._SubParsersAction[argparse.ArgumentParser]

Function = Callable[[argparse.Namespace], int]

logger = logging.getLogger("colmap_affrect")

EPILOG = """\
examples:
  colmap-affrect run --image-path photos --output-path out
  colmap-affrect run --image-path photos --output-path out --camera-mode single
  colmap-affrect run --image-path photos --output-path out --recipe unrectified-rootsift
  colmap-affrect extract --image-path photos --output-path out
  colmap-affrect pairs   --output-path out --match-list-path pairs.txt
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    options = build_parser().parse_args(arguments)
    try:
        if not hasattr(options, "verbose"):  # a command that only prints
            return int(options.function(options))
        with _logging(options):
            return int(options.function(options))
    except AffrectError as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(
            f"{error.filename or 'input/output'}: {error.strerror or error}; when that is mended, "
            "run the same command again: what was done before is kept"
        )
    except KeyboardInterrupt:
        print("interrupted; run the same command again to go on", file=sys.stderr)
        return EXIT_INTERRUPTED


def _fail(message: str) -> int:
    """Print one line; odd characters, out of files perhaps, must not reach the terminal."""
    shown = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in message)
    print(f"error: {''.join(shown)}", file=sys.stderr)
    return EXIT_FAILED


@contextmanager
def _logging(options: argparse.Namespace) -> Iterator[None]:
    """Log to the terminal and to ``run.log``, which also takes what C libraries print.

    Commands without an output folder have no such log.

    COLMAP and image decoders write to file descriptor 2: it leads to the log while the
    command runs, and Python's ``sys.stderr`` to the terminal.
    """
    log_path = Workspace(options.output_path).log if options.output_path else Path(os.devnull)
    log_path.parent.mkdir(parents=True, exist_ok=True)
    python_stderr, terminal_fd = sys.stderr, os.dup(2)
    terminal = os.fdopen(terminal_fd, "w", buffering=1, encoding="utf-8", errors="replace")
    with terminal, _quietly_closed(log_path.open("a", encoding="utf-8", buffering=1)) as log:
        level = logging.DEBUG if options.verbose else logging.WARNING
        handlers: list[logging.Handler] = [logging.StreamHandler(terminal), _LogHandler(log)]
        handlers[0].setLevel(logging.ERROR if options.quiet else level)
        handlers[0].setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
        handlers[1].setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        for handler in handlers:
            logger.addHandler(handler)
        logger.setLevel(logging.DEBUG)
        logger.info("colmap-affrect %s: %s", __version__, " ".join(sys.argv[1:]))
        os.dup2(log.fileno(), 2)
        sys.stderr = terminal
        try:
            yield
        except Exception:
            logger.log(logging.DEBUG, "failed", exc_info=True)
            raise
        finally:
            sys.stderr = python_stderr
            os.dup2(terminal.fileno(), 2)
            for handler in handlers:
                logger.removeHandler(handler)


class _LogHandler(logging.StreamHandler[TextIO]):
    """Writes to ``run.log``; when that cannot be written the command goes on without."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Pass over what the disk has no room for."""


@contextmanager
def _quietly_closed(file: TextIO) -> Iterator[TextIO]:
    try:
        yield file
    finally:
        with suppress(OSError):
            file.close()


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="colmap-affrect",
        description="Rectified wide-baseline features for COLMAP: photographs in, model out.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"colmap-affrect {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    run = _command(commands, "run", _run, "all stages: photographs in, COLMAP model out")
    _add_images(run)
    _add_database_descriptors(run)
    _add_recipe(run)
    _add_resources(run)
    _add_depth(run)
    _add_pair_list(run)
    _add_preset(run)
    _add_mapper(run)
    _add_seed(run)
    _add_json(run)

    extract = _command(commands, "extract", _extract, "features into features.h5 and database.db")
    _add_images(extract)
    _add_database_descriptors(extract)
    _add_recipe(extract)
    _add_resources(extract)
    _add_depth(extract)

    pairs = _command(commands, "pairs", _pairs, "which images to match, into pairs.txt")
    _add_pair_list(pairs)

    match = _command(commands, "match", _match, "matches into matches.h5 and database.db")
    _add_recipe(match, default=None)

    verify = _command(commands, "verify", _verify, "two-view geometries into database.db")
    _add_preset(verify)
    _add_seed(verify)

    escalate = _command(
        commands,
        "escalate",
        _escalate,
        "match pairs that failed again, with more warps (recipes that escalate, as on-demand)",
    )
    _add_resources(escalate)

    mapping = _command(commands, "map", _map, "COLMAP models into sparse/")
    _add_preset(mapping)
    _add_mapper(mapping)
    _add_seed(mapping)
    _add_json(mapping)

    compare = _command(
        commands,
        "compare",
        _compare,
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
        commands,
        "evaluate",
        _evaluate,
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
        commands,
        "inspect",
        _inspect,
        "draw what a recipe does to one image: regions, warps, features; the plan as JSON",
        overwrites=False,
    )
    inspect.add_argument("image", type=Path, metavar="IMAGE", help="the photograph")
    _add_masks(inspect)
    _add_recipe(inspect)
    _add_resources(inspect)
    _add_depth(inspect)

    import_h5 = _listing(
        commands,
        "import-h5",
        _import_h5,
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
        commands,
        "export-h5",
        _export_h5,
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
        commands,
        "doctor",
        _doctor,
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

    recipes = _listing(commands, "recipes", _recipes, "list the recipes and what they need")
    recipes.add_argument("name", nargs="?", help="print this recipe with all of its options")

    weights = _listing(
        commands, "weights", _weights, "list the files of weights, or fetch them beforehand"
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
    commands: Subparsers, name: str, function: Function, summary: str
) -> argparse.ArgumentParser:
    """Add a command that prints and leaves no files."""
    command: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=summary,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(function=function, output_path=None)
    return command


def _command(
    commands: Subparsers, name: str, function: Function, summary: str, *, overwrites: bool = True
) -> argparse.ArgumentParser:
    """Add a command that works in an output folder."""
    command = _listing(commands, name, function, summary)
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
    _add_option(
        command,
        "--device",
        default="auto",
        metavar="DEVICE",
        help="for networks: auto, cpu, cuda, cuda:1, mps (default: auto)",
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


def _run(options: argparse.Namespace) -> int:
    from colmap_affrect.pipeline import run

    report = run(
        options.image_path,
        options.output_path,
        _run_options(options),
        overwrite=options.overwrite,
        progress=_progress(options),
    )
    return _print_reconstruction(report, options)


def _run_options(options: argparse.Namespace) -> RunOptions:
    from colmap_affrect.pipeline import RunOptions

    return RunOptions(
        recipe=_recipe(options, options.recipe),
        cameras=_cameras(options),
        masks=_masks(options),
        match_list_path=options.match_list_path,
        image_list_path=options.image_list_path,
        verification=VerificationOptions.preset(options.preset),
        mapping=_mapping(options),
        from_database=options.from_database,
        database_descriptors=options.database_descriptors,
        random_seed=options.random_seed,
        resources=_resources(options),
    )


def _recipe(options: argparse.Namespace, name: str) -> Recipe:
    from colmap_affrect.recipes import load_recipe

    return load_recipe(name, [*options.set, *_depth_settings(options)])


def _depth_settings(options: argparse.Namespace) -> list[str]:
    path = getattr(options, "depth_path", None)
    given = {
        "path": str(path.resolve()) if path else None,
        "model": getattr(options, "depth_model", None),
        "kind": getattr(options, "depth_kind", None),
    }
    return [f"depth.{key}={json.dumps(value)}" for key, value in given.items() if value]


def _resources(options: argparse.Namespace) -> Resources:
    from colmap_affrect.extraction import Resources

    return Resources(options.weights, options.device)


def _cameras(options: argparse.Namespace) -> CameraOptions:
    return CameraOptions(
        mode=options.camera_mode, model=options.camera_model, params=options.camera_params
    )


def _mapping(options: argparse.Namespace) -> MappingOptions:
    given = {}
    for setting in options.mapper_options:
        key, separator, value = setting.partition("=")
        if not separator or not key.strip():
            raise OptionError(f"--mapper-options {setting}: expected KEY=VALUE")
        given[key.strip()] = value
    return MappingOptions.preset(options.preset, mapper=options.mapper, mapper_options=given)


def _masks(options: argparse.Namespace) -> MaskOptions:
    paths = (options.mask_path, options.camera_mask_path)
    folder, camera = (str(path.resolve()) if path else "" for path in paths)
    return MaskOptions(path=folder, camera_path=camera)


def _extract(options: argparse.Namespace) -> int:
    from colmap_affrect import stages

    with Workspace(options.output_path).locked() as workspace:
        report = stages.extract(
            workspace,
            options.image_path,
            _recipe(options, options.recipe),
            _cameras(options),
            masks=_masks(options),
            image_list_path=options.image_list_path,
            from_database=options.from_database,
            resources=_resources(options),
            overwrite=options.overwrite,
            progress=_progress(options),
        )
        if options.database_descriptors:
            stages.write_descriptors(workspace)
    print(report.summary())
    return _exit_code(report.failures, options)


def _pairs(options: argparse.Namespace) -> int:
    from colmap_affrect import stages

    with Workspace(options.output_path).locked() as workspace:
        report = stages.choose_pairs(
            workspace, match_list_path=options.match_list_path, overwrite=options.overwrite
        )
    print(report.summary())
    return EXIT_OK


def _match(options: argparse.Namespace) -> int:
    from colmap_affrect import stages

    with Workspace(options.output_path).locked() as workspace:
        recipe = _recipe(options, options.recipe or workspace.recipe())
        report = stages.match(
            workspace, recipe.matching, overwrite=options.overwrite, progress=_progress(options)
        )
    print(report.summary())
    return EXIT_OK


def _verify(options: argparse.Namespace) -> int:
    from colmap_affrect import stages

    with Workspace(options.output_path).locked() as workspace:
        report = stages.verify_matches(
            workspace,
            VerificationOptions.preset(options.preset),
            options.random_seed,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
    print(report.summary())
    return EXIT_OK


def _escalate(options: argparse.Namespace) -> int:
    from colmap_affrect import escalation

    with Workspace(options.output_path).locked() as workspace:
        report = escalation.escalate(
            workspace,
            resources=_resources(options),
            overwrite=options.overwrite,
            progress=_progress(options),
        )
        levels = escalation.pair_levels(workspace)
    print(report.summary())
    print(", ".join(f"{count} pairs by {name}" for name, count in levels.items()))
    return EXIT_OK


def _map(options: argparse.Namespace) -> int:
    from colmap_affrect.pipeline import map_and_report

    with Workspace(options.output_path).locked() as workspace:
        report = map_and_report(
            workspace,
            _mapping(options),
            options.random_seed,
            overwrite=options.overwrite,
            progress=_progress(options),
        )
    return _print_reconstruction(report, options)


def _compare(options: argparse.Namespace) -> int:
    from colmap_affrect.comparison.compare import CompareOptions, compare
    from colmap_affrect.comparison.methods import parse_methods
    from colmap_affrect.report.viewer import log_comparison, require_viewer

    if options.viewer:
        require_viewer()
    comparison = compare(
        options.image_path,
        options.output_path,
        CompareOptions(
            methods=parse_methods(options.methods, _depth_settings(options)),
            seeds=options.seeds,
            cameras=_cameras(options),
            masks=_masks(options),
            verification=VerificationOptions.preset(options.preset),
            mapping=_mapping(options),
            match_list_path=options.match_list_path,
            image_list_path=options.image_list_path,
            from_database=options.from_database,
            ground_truth_path=options.ground_truth_path,
            resources=_resources(options),
        ),
        overwrite=options.overwrite,
        progress=SILENT if options.quiet else Progress(sys.stderr, num_plain_lines=1),
    )
    print(comparison.to_json() if options.json else comparison.summary())
    if not options.json:
        print(f"\npictures: {options.output_path / 'report.html'}")
    if options.viewer:
        path = log_comparison(comparison, options.output_path)
        print(f"for rerun: {path}", file=sys.stderr)
    return _comparison_exit_code(comparison, options)


def _evaluate(options: argparse.Namespace) -> int:
    from colmap_affrect.comparison.methods import parse_methods
    from colmap_affrect.evaluation.evaluate import EvaluateOptions, evaluate
    from colmap_affrect.evaluation.registry import make_protocol

    evaluation = evaluate(
        make_protocol(options.protocol, options.protocol_options),
        options.dataset_path,
        options.output_path,
        EvaluateOptions(
            recipes=parse_methods(options.recipes, _depth_settings(options)),
            baseline=options.baseline,
            max_num_keypoints=options.max_num_keypoints,
            random_seed=options.random_seed,
            resources=_resources(options),
        ),
        overwrite=options.overwrite,
        progress=_progress(options),
    )
    print(evaluation.to_json() if options.json else evaluation.summary())
    if not options.json:
        print(f"\nplots, all pairs: {options.output_path}")
    failures = {name: why for recipe in evaluation.recipes for name, why in recipe.failures.items()}
    return _exit_code(failures, options)


def _comparison_exit_code(comparison: Comparison, options: argparse.Namespace) -> int:
    failed = [method.name for method in comparison.methods if method.failed]
    if failed:
        where = options.output_path / "comparison.json"
        return _fail(f"failed: {', '.join(failed)}; {where} says why")
    if not any(seed.model_names for method in comparison.methods for seed in method.seeds):
        print("error: no method found a model", file=sys.stderr)
        return EXIT_NO_MODEL
    failures = {name: why for m in comparison.methods for name, why in m.failures.items()}
    return _exit_code(failures, options)


def _import_h5(options: argparse.Namespace) -> int:
    from colmap_affrect.interchange import import_h5

    report = import_h5(
        options.image_path,
        options.features_path,
        options.matches_path,
        options.database_path,
        cameras=_cameras(options),
        layout=options.layout,
        pixel_origin=options.pixel_origin,
        skip_verification=options.skip_verification,
        random_seed=options.random_seed,
        progress=_progress(options),
    )
    print(report.summary())
    return EXIT_OK


def _export_h5(options: argparse.Namespace) -> int:
    from colmap_affrect.interchange import export_h5

    report = export_h5(
        options.features_path,
        options.matches_path,
        output_path=options.workspace_path,
        database_path=options.database_path,
        layout=options.layout,
        half=options.half,
        progress=_progress(options),
    )
    print(report.summary())
    return EXIT_OK


def _doctor(options: argparse.Namespace) -> int:
    from colmap_affrect.doctor import diagnose

    diagnosis = diagnose(
        options.path,
        image_path=options.image_path,
        weights_path=options.weights,
        progress=_progress(options),
    )
    print(diagnosis.to_json() if options.json else diagnosis.summary())
    return EXIT_FAILED if diagnosis.num_errors else EXIT_OK


def _progress(options: argparse.Namespace) -> Progress:
    return SILENT if options.quiet else Progress(sys.stderr)


def _print_reconstruction(report: ReconstructionReport, options: argparse.Namespace) -> int:
    print(report.to_json() if options.json else report.summary())
    if not report.models:
        why = "one image cannot make a model" if report.images_total == 1 else "no model was found"
        print(f"error: {why}; see {options.output_path / 'report.json'}", file=sys.stderr)
        return EXIT_NO_MODEL
    return _exit_code(report.failures, options)


def _exit_code(failures: Mapping[str, str], options: argparse.Namespace) -> int:
    if len(failures) <= getattr(options, "max_failures", 0):
        return EXIT_OK
    names = ", ".join(failures)
    print(f"error: could not read {len(failures)} of the images: {names}", file=sys.stderr)
    return EXIT_FAILED


def _inspect(options: argparse.Namespace) -> int:
    from colmap_affrect.extraction import prepare
    from colmap_affrect.photographs import Photographs
    from colmap_affrect.report.inspection import inspect_image

    recipe = _recipe(options, options.recipe)
    photographs = Photographs(options.image.parent, CameraOptions(), _masks(options))
    photographs.check()
    mask = photographs.mask(options.image.name)
    extractor = prepare(recipe.extraction, _resources(options), [options.image.name])
    print(inspect_image(extractor, options.image, options.output_path, mask=mask).summary())
    return EXIT_OK


def _recipes(options: argparse.Namespace) -> int:
    from colmap_affrect.features.registry import needed_weights
    from colmap_affrect.recipes import load_recipe, recipe_names
    from colmap_affrect.workspace import dump_toml

    if options.name:
        recipe = load_recipe(options.name)
        everything = {**recipe.extraction.to_mapping(), "matching": recipe.matching.to_mapping()}
        print(f"# {recipe.summary}\n{dump_toml(everything)}", end="")
        return EXIT_OK
    for name in recipe_names():
        recipe = load_recipe(name)
        needs = list(needed_weights(recipe.extraction))
        needs += ["depth"] if any(r.uses_depth for r in recipe.extraction.rectifiers) else []
        print(f"{name:26s} {recipe.summary}")
        print(f"{'':26s} needs {', '.join(needs) or 'nothing'}")
    return EXIT_OK


def _weights(options: argparse.Namespace) -> int:
    from colmap_affrect.features.weights import WEIGHT_FILES, describe_weights, fetch

    if options.action == "fetch":
        keys = options.keys or ["affnet", "orinet", "hardnet"]
        for path in fetch(keys, options.weights, progress=Progress(sys.stderr)).values():
            print(path)
        return EXIT_OK
    checks = {None: "", True: ", verified", False: ", NOT the published file"}
    for row in describe_weights(options.weights):
        where = f"{row.path}{checks[row.verified]}" if row.path else "not found"
        print(f"{row.key:10s} {row.file_name:32s} {row.used_for}")
        print(f"{'':10s} {where}")
        sha256, licence = WEIGHT_FILES[row.key].sha256 or "not known", row.licence or "not stated"
        print(f"{'':10s} sha256 {sha256}; licence {licence}")
    return EXIT_OK
