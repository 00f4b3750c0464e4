"""What README.md and the pages of docs/ say runs as written: commands, options, names, links."""

from __future__ import annotations

import ast
import importlib.util
import pkgutil
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import colmap_affrect
from colmap_affrect.cli.parser import COMMANDS, build_parser
from colmap_affrect.project.record import STAGES
from colmap_affrect.recipes import load_recipe

ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "BENCHMARKS.md",
    ROOT / "sample_scenes" / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
NAMES = [str(path.relative_to(ROOT)) for path in DOCUMENTS]
FOREIGN = {
    "--import_path", "--database_path", "--image_path", "--output_path", "--no-deps",
    "--Mapper.tri_ignore_two_view_tracks", "--nthreads", "--nworkers", "--claim",
}  # fmt: skip
"""Options of other programs that the pages name."""
MAX_WORDS = 1500
"""Of README.md, which is to be read in five minutes."""


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)


def inline(text: str) -> list[str]:
    prose = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]


def shell_commands(name: str) -> Iterator[list[str]]:
    """Yield the words of each command, with those behind && as commands of their own."""
    for block in blocks(text_of(name), "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line.partition(" > ")[0], comments=True)
            while "&&" in words:
                yield words[: words.index("&&")]
                words = words[words.index("&&") + 1 :]
            yield words


PARSER = build_parser()
(CHOICES,) = (action.choices for action in PARSER._actions if action.dest == "command")
ALL_FLAGS = {flag for command in CHOICES.values() for flag in command._option_string_actions}


@pytest.mark.parametrize("name", NAMES)
def test_commands_are_understood(name: str) -> None:
    for words in shell_commands(name):
        if not words or Path(words[0]).name != "colmap-affrect":
            continue
        options = PARSER.parse_args(words[1:])
        recipe = getattr(options, "recipe", None) or "default"
        if not recipe.endswith(".toml") and "recipe" in options:
            load_recipe(recipe, options.set)


@pytest.mark.parametrize("name", NAMES)
def test_stages_come_after_those_that_they_need(name: str) -> None:
    for block in blocks(text_of(name), "sh"):
        commands = re.findall(r"^colmap-affrect (\w+)", block, re.MULTILINE)
        stages = [command for command in commands if command in STAGES]
        if stages[:1] == ["extract"]:
            assert stages == list(STAGES[1 : len(stages) + 1]), block


@pytest.mark.parametrize("name", NAMES)
def test_scripts_exist_and_have_the_options(name: str) -> None:
    for words in shell_commands(name):
        if words[:1] != ["python"]:
            continue
        script = (ROOT / words[1]).read_text(encoding="utf-8")
        own = words[: words.index("--")] if "--" in words else words
        for flag in (word for word in own if word.startswith("--")):
            assert f'"{flag}"' in script, f"{words[1]} {flag}"


@pytest.mark.parametrize("name", NAMES)
def test_options_commands_and_names_in_the_text_exist(name: str) -> None:
    for code in inline(text_of(name)):
        words = code.split()
        if words[0] == "colmap-affrect" and len(words) > 1 and words[1].islower():
            assert words[1] in COMMANDS, code
        for flag in (word.partition("=")[0] for word in words if re.match(r"--[a-zA-Z]", word)):
            script = "recipes/" in code or "tests/" in code
            assert script or flag in {*ALL_FLAGS, *FOREIGN}, code
        if re.fullmatch(r"colmap_affrect(\.\w+)+", code):
            pkgutil.resolve_name(code)
        if words[0] == "--recipe" and words[1:] and not words[1].isupper() and ".toml" not in code:
            load_recipe(words[1])
        if words[0] == "--set" and "=" in code:
            load_recipe("default", [words[1]])


@pytest.mark.parametrize("name", NAMES)
def test_python_names_exist(name: str) -> None:
    for block in blocks(text_of(name), "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                "colmap_affrect"
            ):
                for alias in node.names:
                    pkgutil.resolve_name(f"{node.module}:{alias.name}")
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "colmap_affrect":
                assert node.attr in colmap_affrect.__all__


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_somewhere(name: str) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", text_of(name)):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        file = (ROOT / name).parent / path if path else ROOT / name
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            slugs = {re.sub(r"[^\w -]", "", text).lower().replace(" ", "-") for text in headings}
            assert anchor in slugs, target


def test_readme_is_short_and_has_two_commands_that_set_everything_up() -> None:
    text = text_of("README.md")
    assert len(text.split()) < MAX_WORDS
    assert len(re.findall(r"^python3 -m venv", text, re.MULTILINE)) == 2


def test_every_command_is_in_the_pages() -> None:
    text = "\n".join(text_of(name) for name in NAMES)
    assert all(f"colmap-affrect {command}" in text for command in COMMANDS)


@pytest.mark.long
@pytest.mark.skipif(not importlib.util.find_spec("mkdocs"), reason="mkdocs is not installed")
def test_documentation_is_built_without_warnings_and_without_the_network(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    subprocess.run(command, check=True, cwd=ROOT, capture_output=True)
    for page in tmp_path.glob("*.html"):
        assert not re.findall(r'(?:src|href)="https?://[^"]+\.(?:js|css)"', page.read_text())
