"""The commands: their flags, help texts and examples."""

import argparse
import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any, NoReturn

from colmap_affrect import __version__
from colmap_affrect.cli.flags import FLAGS
from colmap_affrect.errors import OptionError

EXAMPLES = (
    "run --image-path photos --output-path out",
    "run --image-path scans --output-path out --mask-path masks --effort high",
    "run --image-path photos --output-path out --focal-mm 50 --film-width-mm 36",
    "run --image-path photos --output-path out --pairs retrieval --num-neighbors 20",
    "run --image-path photos --output-path out --tie-points tie-points.csv",
    "extract --image-path photos --output-path out",
    "pairs --output-path out --pairs retrieval,sequence --num-neighbors 30",
    "match --output-path out",
    "verify --output-path out",
    "map --output-path out",
    "map --output-path out --from-database any.db --image-path photos",
    "compare --image-path photos --output-path out --methods sift,default --seeds 0",
    "evaluate evd --dataset-path EVD --output-path out \\\n"
    "      --recipes unrectified-rootsift,rectified,default",
    "convert --image-path scans --output-path photos",
    "panoramas --image-path panoramas --output-path out",
    "inspect photos/a.jpg --output-path out",
    "lines photos/a.jpg photos/b.jpg --output-path pictures",
    "serve out",
    "show-runs out out-2",
    "show-pair out a.jpg b.jpg",
    "show-pair any.db a.jpg b.jpg --image-path photos --output-path pair.png",
    "recipes on-demand",
    "weights fetch affnet orinet hardnet --weights folder",
    "doctor out",
    "import-h5 --image-path photos --features-path features.h5 \\\n"
    "      --matches-path matches.h5 --database-path new.db",
    "export-h5 --database-path any.db --features-path features.h5 \\\n"
    "      --matches-path matches.h5",
    "export-database out old.db --colmap 3.8",
    "export --model-path out/sparse/0 --output-path for-others --format ply,text",
    "align --model-path out/sparse/0 --output-path metric --gps out/database.db",
    "align --model-path out/sparse/0 --output-path metric --distance a.jpg,b.jpg,2.5",
)

ENDING = """
What computes goes on where it stopped when it is run again. Exit codes: 0 done; 1 failed (one
line says why; also when images could not be read, see --max-failures); 2 not carried out as it was
given: unknown options and values, a file or folder that is not there, a list or table that is
wrong, results of yours or of other options in the way; 3 finished without a model, or with one
that is doubtful throughout, which is written all the same; 130 interrupted (143 by SIGTERM).
"""


def epilog(command: str = "") -> str:
    """Return the examples of a command, or one of each, and what all have in common."""
    if command:
        examples = [text for text in EXAMPLES if text.split()[0] == command]
    else:
        first_ones: dict[str, str] = {}
        for text in EXAMPLES:
            first_ones.setdefault(text.split()[0], text)
        examples = list(first_ones.values())
    return "\n  colmap-affrect ".join(["examples:", *examples]) + "\n" + ENDING


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage of forty options."""

    def error(self, message: str) -> NoReturn:
        """Raise OptionError, which ends with exit code 2."""
        raise OptionError(message, advice=f"see {self.prog} --help")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse; names of flags may have underscores, and an unknown one is refused.

        Args:
            args: words of the command line; None for those that this process was given.
            namespace: gets the values; None for a new one.

        Returns:
            The namespace, and no words that are left.

        Raises:
            OptionError: names a flag or a value that is wrong.
        """
        given = sys.argv[1:] if args is None else args
        words = self._with_values(list(map(_with_hyphens, given)))
        if not self._subparsers:
            self._refuse_unknown(self._of_other_commands(words))
        found, unknown = super().parse_known_args(words, namespace)
        self._refuse_unknown(unknown)
        return found, unknown

    def _with_values(self, words: Sequence[str]) -> list[str]:
        """Join flags and values that begin with a hyphen, as names of photographs may."""
        joined: list[str] = []
        for word in words:
            before = joined[-1] if joined else ""
            is_name = (
                re.fullmatch(r"-[^-].*", word)
                and word not in self._option_string_actions
            )
            if is_name and self._takes_value(before):
                joined[-1] = f"{before}={word}"
            else:
                joined.append(word)
        return joined

    def _takes_value(self, word: str) -> bool:
        """Tell whether a word is a flag that takes the next word as its value."""
        action = self._option_string_actions.get(word)
        return action is not None and action.nargs is None and word.startswith("--")

    def _refuse_unknown(self, unknown: Sequence[str]) -> None:
        if not unknown:
            return
        flags = [word for word in unknown if word.startswith("-")]
        name = flags[0] if flags else unknown[0]
        close = get_close_matches(
            name.partition("=")[0], self._option_string_actions, n=1
        )
        meant = f" (did you mean {close[0]}?)" if close else ""
        self.error(f"unknown argument {name}{meant}")

    def _of_other_commands(self, words: Sequence[str]) -> list[str]:
        """Return flags of other commands: argparse would take them for the beginning of ours."""
        flags = {flag for names in FLAGS for flag in _flag(names).split(",")}
        others = {flag for flag in flags if flag.startswith("--")}
        others -= self._option_string_actions.keys()
        return [word for word in words if word.partition("=")[0] in others]


def _with_hyphens(word: str) -> str:
    return re.sub(r"^--[^=]+", lambda name: name[0].replace("_", "-"), word)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands; what a command has no flag for is None."""
    usual: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter}
    parser = Parser(
        prog="colmap-affrect",
        description="Rectified wide-baseline features for COLMAP: photographs in, model out.",
        epilog=epilog(),
        **usual,
    )
    parser.add_argument(
        "--version", action="version", version=f"colmap-affrect {__version__}"
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (summary, flags) in COMMANDS.items():
        subparser = commands.add_parser(
            name, help=summary, description=summary, epilog=epilog(name), **usual
        )
        words = [*flags.split(), VOLUME]
        for title, some in _by_group(words).items():
            target = subparser.add_argument_group(title) if title else subparser
            for word in some:
                parser.set_defaults(**dict.fromkeys(_add(target, word)))
        if len(words) > MAX_UNGROUPED:
            subparser.usage = _short_usage(subparser)
    return parser


def _by_group(words: Sequence[str]) -> dict[str, list[str]]:
    """Sort the flags of a command by the titles of :data:`GROUPS`; of a few nothing is sorted."""
    if len(words) <= MAX_UNGROUPED:
        return {"": list(words)}
    found: dict[str, list[str]] = {}
    for title, flags in GROUPS.items():
        names = flags.split()
        some = [word for word in words if _flag(word) in names]
        if some:
            found[title] = sorted(some, key=lambda word: names.index(_flag(word)))
    return found


def _flag(word: str) -> str:
    """Return the flag of a word of :data:`COMMANDS` alone, as users write it."""
    return word.removesuffix("!").partition("@")[0]


def _short_usage(parser: argparse.ArgumentParser) -> str:
    """Return the usage of a command with many options: what must be given, and nothing else."""
    words = [parser.prog]
    for action in parser._actions:
        if action.required and action.option_strings:
            words.append(f"{action.option_strings[0]} {action.metavar}")
        elif action.required:
            words.append(action.dest)
    return f"{' '.join(words)} [options]"


def _add(parser: argparse._ActionsContainer, word: str) -> list[str]:
    """Add a flag, or several that exclude each other, see :data:`COMMANDS`; return their names."""
    names = word.removesuffix("!").split("|")
    required: dict[str, Any] = {"required": True} if word.endswith("!") else {}
    target = parser.add_mutually_exclusive_group() if len(names) > 1 else parser
    return [
        target.add_argument(*_flag(name).split(","), **FLAGS[name], **required).dest
        for name in names
    ]


VOLUME = "-q,--quiet|-v,--verbose"  # of all commands
RESULTS = "--output-path! --overwrite"
MASKS = "--mask-path --camera-mask-path"
KNOWN_CAMERAS = """--camera-model --camera-params --cameras-path --focal-length-px
    --focal-mm --film-width-mm --principal-point"""
CAMERAS = f"--camera-mode {KNOWN_CAMERAS} --ignore-exif"
IMAGES = (
    f"--image-path! --image-list-path {MASKS} --from-database {CAMERAS} --max-failures"
)
RECIPE = "--recipe --set"
PAIRS = "--match-list-path --pairs --num-neighbors --max-distance-m"
NETWORKS = "--weights --device"
MAPPER = "--preset --mapper --mapper-options"
GIVEN_MATCHES = "--matches-path@given --match-type --match-list-path@given"
BY_HAND = "--tie-points --reject-pair --leave-out"
MODEL = f"--extend --refine-existing {BY_HAND} --random-seed --json --no-page"

MAX_UNGROUPED = 12  # flags of a command that help lists in one go; display
GROUPS = {
    "": "protocol --image-path --dataset-path --output-path --mask-path --camera-mode --recipe "
        "--methods --recipes --seeds --effort --max-time --overwrite --features-path "
        "--matches-path --match-type --database-path",
    "photographs": "--image-list-path --from-database --camera-mask-path --depth-path "
        "--max-failures",
    "cameras": f"{KNOWN_CAMERAS} --ignore-exif",
    "features and pairs": "--set --max-num-keypoints --pairs --num-neighbors --max-distance-m "
        "--match-list-path --database-descriptors --weights --device "
        "--scheduler",
    "models": "--extend --refine-existing --preset --mapper --mapper-options --random-seed "
        "--ground-truth-path",
    "by hand": BY_HAND,
    "what is printed and drawn": f"--json --no-page {VOLUME}",
}  # fmt: skip
"""Titles and flags in the order in which help has them; what is used most has no title."""

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("all stages: photographs in, COLMAP model out",
        f"{RESULTS} {IMAGES} {RECIPE} --effort --max-time --depth-path --database-descriptors "
        f"{NETWORKS} --scheduler {PAIRS} {MAPPER} {MODEL}"),
    "extract": ("features into features.h5 and database.db",
        f"{RESULTS} {IMAGES} {RECIPE} --depth-path --database-descriptors {NETWORKS} --scheduler"),
    "pairs": ("which images to match, into pairs.txt", f"{RESULTS} {PAIRS}"),
    "match": ("matches into matches.h5 and database.db", f"{RESULTS} --set {NETWORKS} --scheduler"),
    "verify": ("two-view geometries into database.db", f"{RESULTS} --preset --random-seed"),
    "map": ("COLMAP models into sparse/",
        f"{RESULTS} --from-database@map --image-path@map {GIVEN_MATCHES} {KNOWN_CAMERAS} {MAPPER} "
        f"{MODEL}"),
    "compare": (
        "how many photographs, and which, COLMAP's SIFT and recipes register; with pictures",
        f"{RESULTS} {IMAGES} --methods --seeds --ground-truth-path --depth-path {NETWORKS} "
        f"--match-list-path {MAPPER} --json"),
    "evaluate": (
        "score recipes on pairs of images with a known truth, as the paper does on its datasets",
        f"{RESULTS} protocol --dataset-path! --recipes --max-num-keypoints "
        f"--depth-path {NETWORKS} --random-seed --json"),
    "convert": (
        "a folder of photographs in formats that COLMAP reads: JPEG 2000, WebP, HEIC, pages",
        "--image-path! --output-path@photographs!"),
    "panoramas": (
        "panoramas of 360 x 180 degrees, by views of them, into COLMAP models",
        "--image-path! --output-path@new! --order --random-seed"),
    "inspect": (
        "draw what a recipe does to one image, a sheet for each level: regions, warps, features",
        f"image --output-path! {MASKS} {RECIPE} --depth-path {NETWORKS}"),
    "lines": (
        "what the straight lines of photographs say of their cameras: focal length, axis, upright",
        "photographs --output-path@pictures --max-failures --json"),
    "serve": (
        "the page of a run in a browser of this machine: marks and masks are mapped at a click",
        "path@run --port --reject-pair --leave-out"),
    "show-runs": (
        "two runs of the same photographs, one laid over the other on a page: before and after",
        "before after --output-path@page"),
    "show-pair": (
        "draw two photographs side by side, with lines between what was matched",
        "path pair --image-path@pair --output-path@pair"),
    "import-h5": (
        "features, and perhaps matches, of hloc and others into a new COLMAP database",
        f"--image-path! --features-path! {GIVEN_MATCHES} --database-path! {CAMERAS} --random-seed"),
    "export-h5": ("features and matches of any COLMAP database for hloc",
        "--database-path@read! --features-path! --matches-path!"),
    "export-database": (
        "any database for COLMAP 3.8 to 3.13, as Linux distributions have them",
        "path database_path --colmap --descriptors"),
    "export": (
        "a model for other programs: points, text, undistorted photographs, tables",
        "--model-path! --output-path@files! --format --camera-model@export --image-path@export"),
    "align": ("give a model its scale and place, by GPS, control points or a distance",
        "--model-path! --output-path@model! --gps|--positions|--points --distance"),
    "doctor": (
        "look for what is wrong with results, a database, a model or the installation, and what "
        "helps",
        "path@optional --weights --json"),
    "recipes": ("list the recipes and what they need", "name"),
    "weights": ("list the files of weights, or fetch them beforehand", "action keys --weights"),
}  # fmt: skip
"""What a command does in one line, and its flags of :data:`.flags.FLAGS`.

One with an exclamation mark must be given; of those that ``|`` joins only one may be.
"""
