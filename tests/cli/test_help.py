"""What help shows, and lists of recipes; nothing heavy is loaded for it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from command import Call

from colmap_affrect.cli.parser import COMMANDS as ALL_COMMANDS
from colmap_affrect.cli.parser import EXAMPLES, VOLUME, build_parser, epilog
from colmap_affrect.recipes import load_recipe, recipe_names

COMMANDS = [
    "run", "extract", "pairs", "match", "verify", "map", "compare",
    "evaluate", "inspect", "recipes", "weights", "doctor",
]  # fmt: skip
TIMEOUT_S = 60


@pytest.mark.parametrize("command", [[], ["run"], ["inspect"], ["recipes"]])
def test_help_has_options_and_examples(command: list[str], call: Call) -> None:
    done = call(*command, "--help")
    assert (done.code, done.stderr) == (0, [])
    assert (
        f"colmap-affrect {(command or ['run'])[0]}"
        in done.stdout.partition("examples:")[2]
    )
    assert "Exit codes: 0 done" in done.stdout
    if not command:
        assert all(f"    {name} " in done.stdout for name in COMMANDS)
    elif command[0] not in ("recipes", "weights", "doctor"):
        assert all(flag in done.stdout for flag in ("--output-path", "--quiet"))
        assert ("--overwrite" in done.stdout) == (command != ["inspect"])


def test_each_command_has_examples_of_its_own_that_it_understands() -> None:
    parser = build_parser()
    assert {example.split()[0] for example in EXAMPLES} == {
        *COMMANDS, "convert", "panoramas", "serve", "show-pair", "show-runs", "lines",
        "import-h5", "export-h5", "export-database", "export", "align",
    }  # fmt: skip
    for example in EXAMPLES:
        parser.parse_args(example.replace("\\\n", " ").split())
    shown = epilog("map")
    assert shown.count("colmap-affrect ") == shown.count("colmap-affrect map ") == 2


def test_help_of_many_flags_is_in_groups_that_lack_none() -> None:
    parser = build_parser()
    (choices,) = (
        action.choices for action in parser._actions if action.dest == "command"
    )
    for name, (_, flags) in ALL_COMMANDS.items():
        words = re.split(r"[ |\n,]+", f"{flags} {VOLUME}")
        given = {word.removesuffix("!").partition("@")[0] for word in words}
        known = choices[name]._option_string_actions.keys()
        assert {flag for flag in given if flag.startswith("-")} == known - {
            "-h",
            "--help",
        }, name
    shown = choices["run"].format_help()
    first = "usage: colmap-affrect run --image-path PATH --output-path PATH [options]\n"
    assert shown.startswith(first)
    titles = re.findall(r"^(\w[\w ]*):$", shown, re.MULTILINE)
    assert titles == [
        "options", "photographs", "cameras", "features and pairs", "models", "by hand",
        "what is printed and drawn", "examples",
    ]  # fmt: skip
    most_used = shown.partition("photographs:\n")[0]
    assert "--camera-mode MODE" in most_used
    assert "--mapper" not in most_used


def test_help_loads_no_heavy_package() -> None:
    script = (
        "import sys; from colmap_affrect.cli import main\n"
        "try: main(['run', '--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "heavy = {'torch', 'kornia', 'pycolmap', 'cv2', 'h5py', 'matplotlib', 'scipy'}\n"
        "print('loaded', sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == "loaded []"


def test_recipes_are_listed_with_what_they_need(call: Call) -> None:
    lines = call("recipes").stdout.splitlines()
    first, *others = [line.split()[0] for line in lines[::2]]
    assert (first, sorted([first, *others])) == ("default", recipe_names())
    needs = {
        name.split()[0]: line.strip()
        for name, line in zip(*[iter(lines)] * 2, strict=True)
    }
    assert needs["rectified"] == needs["on-demand"] == "needs nothing"
    assert (
        needs["default"]
        == "needs nothing, and uses aliked-n16, lightglue-aliked if it can"
    )
    assert needs["dense-affnet"] == "needs affnet, hardnet, orinet"
    assert needs["depth-planes-recommended"] == "needs depth"


def test_one_recipe_is_printed_with_all_options_and_can_be_used_as_a_file(
    tmp_path: Path, call: Call
) -> None:
    done = call("recipes", "on-demand")
    assert (done.code, done.stderr) == (0, [])
    path = tmp_path / "copy.toml"
    path.write_text(done.stdout)
    copy = load_recipe(str(path))
    original = load_recipe("on-demand")
    assert (copy.extraction, copy.matching) == (original.extraction, original.matching)
    assert (
        "# Radius r of a covering ball as a tilt ratio. Paper: 1.7.\ntilt_radius"
        in done.stdout
    )


def test_the_name_alone_shows_the_help(call: Call) -> None:
    assert call() == call("--help")
