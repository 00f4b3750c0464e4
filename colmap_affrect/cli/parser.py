"""The commands, with help texts."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, NoReturn

from colmap_affrect import __version__
from colmap_affrect.cli import arguments as args
from colmap_affrect.cli import commands
from colmap_affrect.errors import OptionError

if TYPE_CHECKING:
    # The type of what takes arguments has no public name.
    Container = argparse._ActionsContainer

EXAMPLES = (
    "run --image-path photos --output-path out",
    "run --image-path photos --output-path out --recipe on-demand --camera-mode single",
    "run --image-path all-photos --output-path out --extend finished/sparse/0",
    "run --config out/config.toml --image-path other-photos --output-path out2",
    "extract --image-path photos --output-path out",
    "pairs --output-path out --pairs retrieval,sequence --num-neighbors 30",
    "match --output-path out",
    "verify --output-path out",
    "escalate --output-path out --overwrite --set escalate.min_num_tracks=10",
    "guide --output-path out",
    "map --output-path out",
    "map --output-path out --from-database any.db --image-path photos",
    "compare --image-path photos --output-path out --methods sift,default --seeds 0",
    "evaluate evd --dataset-path EVD --output-path out \\\n"
    "      --recipes unrectified-rootsift,default,on-demand",
    "convert --image-path scans --output-path photos",
    "inspect photos/a.jpg --output-path out",
    "recipes on-demand",
    "weights fetch affnet orinet hardnet --weights folder",
    "doctor out",
    "import-h5 --image-path photos --features-path features.h5 \\\n"
    "      --matches-path matches.h5 --database-path new.db",
    "export-h5 --database-path any.db --features-path features.h5 \\\n"
    "      --matches-path matches.h5",
    "export-database out old.db --colmap 3.8",
    "export --model-path out/sparse/0 --output-path for-others --format ply,text",
    "export --model-path out/sparse/0 --output-path for-others --format nerfstudio \\\n"
    "      --image-path photos",
    "align --model-path out/sparse/0 --output-path metric --gps out/database.db",
    "align --model-path out/sparse/0 --output-path metric --points control.csv",
    "align --model-path out/sparse/0 --output-path metric --distance a.jpg,b.jpg,2.5",
)

ENDING = """
What computes goes on where it stopped when it is run again. Exit codes: 0 done, 1 failed (one
line says why; also when images could not be read, see --max-failures), 2 wrong usage, or an option
names a file or folder that is not there, or where something of yours lies, 3 finished without a
model that can be trusted, 130 interrupted (143 by SIGTERM).
"""


def epilog(command: str = "") -> str:
    """Return the examples of a command, or all, and what all commands have in common."""
    examples = [text for text in EXAMPLES if command in ("", text.split()[0])]
    return "\n  colmap-affrect ".join(["examples:", *examples]) + "\n" + ENDING


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage of forty options."""

    def error(self, message: str) -> NoReturn:
        """Raise OptionError, which ends with exit code 2."""
        raise OptionError(f"{message}; see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; what is unknown is refused with the option that may have been meant."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            name = next((word for word in unknown if word.startswith("-")), unknown[0])
            close = get_close_matches(name.partition("=")[0], self._option_string_actions, n=1)
            meant = f" (did you mean {close[0]}?)" if close else ""
            self.error(f"unknown argument {name}{meant}")
        return found, unknown


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = Parser(
        prog="colmap-affrect",
        description="Rectified wide-baseline features for COLMAP: photographs in, model out.",
        epilog=epilog(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"colmap-affrect {__version__}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (function, summary, options) in COMMANDS.items():
        command = subparsers.add_parser(
            name,
            help=summary,
            description=summary,
            epilog=epilog(name),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.set_defaults(function=function, **ABSENT)
        _add(command, options)
    return parser


ABSENT: dict[str, Any] = {
    **dict.fromkeys(("output_path", "weights", "scheduler", "random_seed")),
    "device": "auto",
    "max_failures": 0,
}
"""What commands read that not all of them have as options."""


def _add(container: Container, options: Options) -> None:
    for option in options:
        if isinstance(option, args.OneOf):
            group = container.add_mutually_exclusive_group(required=option.required)
            _add(group, option.options)
        else:
            container.add_argument(*option.flags, **option.settings)


Options = tuple[args.Option | args.OneOf, ...]
Command = tuple[Callable[[argparse.Namespace], int | None], str, Options]
"""What is called with the options, what it does in one line, and the options."""

COMMANDS: dict[str, Command] = {
    "run": (commands.run, "all stages: photographs in, COLMAP model out",
        (*args.RESULTS, *args.CONFIG, *args.SELECTION, args.DESCRIPTORS, *args.recipe(),
        args.MATCHER, args.GUIDED,
        *args.RESOURCES, args.SCHEDULER, *args.DEPTH, *args.PAIRS, args.PRESET,
        *args.MAPPER,
        *args.EXTEND, args.seed(), args.json(), args.NO_PAGE)),
    "extract": (commands.extract, "features into features.h5 and database.db",
        (*args.RESULTS, *args.IMAGES, args.DESCRIPTORS, *args.recipe(), args.MATCHER,
        *args.RESOURCES, args.SCHEDULER, *args.DEPTH)),
    "pairs": (commands.pairs, "which images to match, into pairs.txt",
        (*args.RESULTS, *args.PAIRS)),
    "match": (commands.match, "matches into matches.h5 and database.db",
        (*args.RESULTS, *args.recipe(default=None), args.MATCHER, *args.RESOURCES,
        args.SCHEDULER)),
    "verify": (commands.verify, "two-view geometries into database.db",
        (*args.RESULTS, args.PRESET, args.seed())),
    "escalate": (commands.escalate,
        "match pairs that failed again, with more warps (recipes that escalate, as on-demand)",
        (*args.RESULTS, args.setting("escalate.min_num_tracks=10"), *args.RESOURCES,
            args.SCHEDULER)),
    "guide": (commands.guide,
        "match verified pairs again, guided by their geometry",
        (*args.RESULTS, args.GUIDED, args.setting("guided.band_px=2"),
            args.SCHEDULER)),
    "map": (commands.map, "COLMAP models into sparse/",
        (*args.RESULTS, *args.COPIED, *args.EXTEND, args.PRESET,
        *args.MAPPER, args.seed(), args.json(), args.NO_PAGE)),
    "compare": (commands.compare,
        "how many photographs, and which, COLMAP's SIFT and recipes register; with pictures",
        (*args.RESULTS, *args.IMAGES, *args.COMPARISON, *args.RESOURCES, *args.DEPTH,
        args.PAIR_LIST, args.PRESET, *args.MAPPER,
        args.json("print comparison.json, no summary"))),
    "evaluate": (commands.evaluate,
        "score recipes on pairs of images with a known truth, as the paper does on its datasets",
        (*args.RESULTS, *args.EVALUATION, *args.RESOURCES, *args.DEPTH,
        args.seed("of the estimators and the statistics", default=0),
        args.json("print evaluation.json, no tables"))),
    "convert": (commands.convert,
        "a folder of photographs in formats that COLMAP reads: JPEG 2000, WebP, HEIC, pages",
        (args.IMAGE_PATH, args.CONVERTED_PATH, args.VOLUME)),
    "inspect": (commands.inspect,
        "draw what a recipe does to one image: regions, warps, features; the plan as JSON",
        (args.OUTPUT_PATH, args.VOLUME, args.IMAGE, *args.MASKS, *args.recipe(), *args.RESOURCES,
        *args.DEPTH)),
    "import-h5": (commands.import_h5,
        "features and matches in hloc's files into a new COLMAP database",
        (args.IMAGE_PATH, *args.H5_FILES, args.IMPORT_TARGET, *args.CAMERAS,
        args.SKIP_VERIFICATION, args.seed(default=0), args.VOLUME)),
    "export-h5": (commands.export_h5,
        "features and matches of any COLMAP database for hloc",
        (args.EXPORT_SOURCE, *args.H5_FILES, args.VOLUME)),
    "export-database": (commands.export_database,
        "any database for COLMAP 3.8 to 3.13, as Linux distributions have them",
        (*args.OLD_DATABASE, args.VOLUME)),
    "export": (commands.export,
        "a model for other programs: points, text, undistorted photographs, tables",
        (*args.EXPORT, args.VOLUME)),
    "align": (commands.align,
        "give a model its scale and place, by GPS, control points or a known distance",
        (*args.ALIGN, args.VOLUME)),
    "doctor": (commands.doctor,
        "look for what is wrong with results or the installation, and say what to do about it",
        (*args.DOCTOR, args.json("print JSON"), args.VOLUME)),
    "recipes": (commands.recipes, "list the recipes and what they need", (args.SHOWN_RECIPE,)),
    "weights": (commands.weights, "list the files of weights, or fetch them beforehand",
        (*args.WEIGHTS, args.VOLUME)),
}  # fmt: skip
