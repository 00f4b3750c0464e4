"""What README.md and the pages of docs/ say runs as written: commands, options, names, links."""

from __future__ import annotations

import ast
import importlib.util
import inspect
import pkgutil
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest

import colmap_affrect
from colmap_affrect.cli.parser import COMMANDS, build_parser
from colmap_affrect.colmap.cameras import Source
from colmap_affrect.project.record import STAGES
from colmap_affrect.recipes import load_recipe

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", "BENCHMARKS.md", "CHANGELOG.md", "CONTRIBUTING.md"]
PAGES += ["sample_scenes/README.md"]
PAGES += sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").glob("*.md"))
TEXTS = {name: (ROOT / name).read_text(encoding="utf-8") for name in PAGES}
FOREIGN = {
    "--import_path", "--database_path", "--image_path", "--output_path", "--no-deps",
    "--Mapper.tri_ignore_two_view_tracks", "--nthreads", "--nworkers", "--claim",
    "--preload",
}  # fmt: skip
"""Options of other programs that the pages name."""
MAX_PICTURE_BYTES = 1_200_000
"""Of docs/pictures, which each clone brings."""
MAX_WORDS = 1500
"""Of README.md, which is to be read in five minutes."""

PARSER = build_parser()
(CHOICES,) = (action.choices for action in PARSER._actions if action.dest == "command")
ALL_FLAGS = {
    flag for command in CHOICES.values() for flag in command._option_string_actions
}

each_page = pytest.mark.parametrize("name", PAGES)


def blocks(name: str, language: str) -> list[str]:
    return re.findall(
        rf"^ *```{language}\n(.*?)^ *```", TEXTS[name], re.MULTILINE | re.DOTALL
    )


def inline(name: str) -> list[str]:
    prose = re.sub(r"^ *```.*?^ *```", "", TEXTS[name], flags=re.MULTILINE | re.DOTALL)
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose)]


def shell_commands(name: str) -> Iterator[list[str]]:
    """Yield the words of each command, with those behind && as commands of their own."""
    for block in blocks(name, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line.partition(" > ")[0], comments=True)
            while "&&" in words:
                yield words[: words.index("&&")]
                words = words[words.index("&&") + 1 :]
            if words:
                yield words


@each_page
def test_commands_and_scripts_are_understood(name: str) -> None:
    for words in shell_commands(name):
        if Path(words[0]).name == "colmap-affrect":
            options = PARSER.parse_args(words[1:])
            recipe = options.recipe or "default"
            if not recipe.endswith(".toml"):
                load_recipe(recipe, options.set or ())
        if words[0] == "python":
            script = (ROOT / words[1]).read_text(encoding="utf-8")
            own = words[: words.index("--")] if "--" in words else words
            for flag in (word for word in own if word.startswith("--")):
                assert f'"{flag}"' in script, f"{words[1]} {flag}"


@each_page
def test_stages_come_after_those_that_they_need(name: str) -> None:
    for block in blocks(name, "sh"):
        commands = re.findall(r"^colmap-affrect (\w+)", block, re.MULTILINE)
        stages = [command for command in commands if command in STAGES]
        if stages[:1] == ["extract"]:
            assert (
                stages
                == [stage for stage in STAGES if stage in COMMANDS][: len(stages)]
            ), block


@each_page
def test_commands_in_the_text_exist(name: str) -> None:
    for code in inline(name):
        words = code.split()
        if words[0] == "colmap-affrect" and len(words) > 1 and words[1].islower():
            assert words[1] in COMMANDS, code


@each_page
def test_flags_in_the_text_exist(name: str) -> None:
    for code in inline(name):
        is_of_script = "recipes/" in code or "tests/" in code
        words = re.findall(r"(?<!\S)--[a-zA-Z]\S*", code)
        flags = {word.partition("=")[0] for word in words}
        assert is_of_script or flags <= {*ALL_FLAGS, *FOREIGN}, code


@each_page
def test_names_of_the_package_in_the_text_exist(name: str) -> None:
    for code in inline(name):
        if re.fullmatch(r"colmap_affrect(\.\w+)+", code):
            found = pkgutil.resolve_name(code)
            is_public = code.split(".")[1] in colmap_affrect.__all__
            assert is_public or inspect.ismodule(found), f"{code} is not public"


@each_page
def test_recipes_and_settings_in_the_text_exist(name: str) -> None:
    for code in inline(name):
        recipe = re.match(r"--recipe ([a-z][\w-]*)(?=\s|$)", code)
        if recipe:
            load_recipe(recipe[1])
        setting = re.match(r"--set (\S+=\S*)", code)
        if setting:
            load_recipe("default", [setting[1]])


@each_page
def test_python_names_exist(name: str) -> None:
    for node in (
        node for block in blocks(name, "python") for node in ast.walk(ast.parse(block))
    ):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
            "colmap_affrect"
        ):
            for alias in node.names:
                pkgutil.resolve_name(f"{node.module}:{alias.name}")
        if (
            isinstance(node, ast.Attribute)
            and ast.unparse(node.value) == "colmap_affrect"
        ):
            assert node.attr in colmap_affrect.__all__


@each_page
def test_links_lead_somewhere(name: str) -> None:
    for target in re.findall(r"\]\(((?!http)[^)]+)\)", TEXTS[name]):
        path, _, anchor = target.partition("#")
        file = (ROOT / name).parent / path if path else ROOT / name
        assert file.exists(), target
        if anchor:
            headings = re.findall(
                r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE
            )
            slugs = {
                re.sub(r"[^\w -]", "", text).lower().replace(" ", "-")
                for text in headings
            }
            assert anchor in slugs, target


def pictures_of(name: str) -> list[Path]:
    """The pictures that a page shows."""
    text = (ROOT / name).read_text(encoding="utf-8")
    targets = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    return [(ROOT / name).parent / target for target in targets]


def test_each_page_of_the_documentation_has_a_picture_and_all_are_shown() -> None:
    shown = set()
    for name in [*PAGES, "ARCHITECTURE.md"]:
        found = pictures_of(name)
        assert found or not name.startswith("docs/"), name
        shown |= {path.resolve() for path in found}
    taken = set((ROOT / "docs" / "pictures").iterdir())
    assert taken <= shown
    assert sum(path.stat().st_size for path in taken) < MAX_PICTURE_BYTES


def said_by_the_program() -> set[str]:
    """All pieces of text in the code, between what is filled in."""
    checks = ROOT / "colmap_affrect" / "colmap" / "checks.toml"
    found = {checks.read_text(encoding="utf-8")}
    for path in (ROOT / "colmap_affrect").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value.removeprefix("error: ").strip())
    return found


def test_lines_that_troubleshooting_quotes_are_printed() -> None:
    """Each piece between names and numbers is in a text of the code, or holds a long one of it."""
    texts = said_by_the_program()
    for row in re.findall(
        r"^\| (`.*?) \| ", TEXTS["docs/troubleshooting.md"], re.MULTILINE
    ):
        for quoted in re.findall(r"`([^`]+)`", row):
            for piece in re.split(r"\.\.\.|[;:] |\b\w+\.jpg|\b\d+\b|sparse/", quoted):
                words = piece.strip(" -:")
                in_words = (text for text in texts if len(text) >= 8 and text in words)
                assert any(words in text for text in texts) or any(in_words), (
                    row,
                    words,
                )


def test_guide_names_all_sources_of_focal_lengths() -> None:
    (sentence,) = re.findall(
        r"where its focal length is\s+from: (.*?)\.\n",
        TEXTS["docs/guide.md"],
        re.DOTALL,
    )
    assert re.findall(r"`([\w-]+)`", sentence) == list(get_args(Source))


def test_readme_and_guide_say_that_complaints_of_pip_are_harmless() -> None:
    for name in ("README.md", "docs/guide.md", "docs/troubleshooting.md"):
        assert re.search(r"`opencv-python`.*?harmless", TEXTS[name], re.DOTALL)


def test_pages_name_every_command_and_readme_is_short() -> None:
    text = "\n".join(TEXTS.values())
    assert all(f"colmap-affrect {command}" in text for command in COMMANDS)
    readme = TEXTS["README.md"]
    assert len(readme.split()) < MAX_WORDS
    # The commands that set everything up, which .ci/run executes.
    assert len(re.findall(r"^python3 -m venv", readme, re.MULTILINE)) == 2


def test_version_and_citation_agree_and_no_address_is_invented() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    fields = dict(re.findall(r"^(\S+): (.+)$", citation, re.MULTILINE))
    assert fields["version"] == colmap_affrect.__version__
    assert {"cff-version", "message", "title", "license"} <= fields.keys()
    assert citation.count("family-names") == citation.count("given-names") == 3
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    assert all(url.startswith("https://") for url in project.get("urls", {}).values())
    extras = project["optional-dependencies"]
    assert {"dev", "docs", "test"} <= extras.keys()
    assert fields["license"] == project["license"]


@pytest.mark.long
@pytest.mark.skipif(
    not importlib.util.find_spec("mkdocs"), reason="mkdocs is not installed"
)
def test_documentation_is_built_without_warnings_and_without_the_network(
    tmp_path: Path,
) -> None:
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "--site-dir",
        str(tmp_path),
    ]
    subprocess.run(command, check=True, cwd=ROOT, capture_output=True)
    for page in tmp_path.glob("*.html"):
        assert not re.findall(
            r'(?:src|href)="https?://[^"]+\.(?:js|css)"', page.read_text()
        )
