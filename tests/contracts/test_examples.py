"""The examples of ARCHITECTURE.md do their work, its parts as entry points of another package."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import small_run
from contracts.contracts import (
    ExtractorContract,
    MatcherContract,
    RectifierContract,
)
from contracts.mapper_contract import MapperContract
from deciding_numbers import Module, all_numbers, faults
from small_comparison import make_comparison
from small_scene import NAMES
from synthetic import texture, write_image

from colmap_affrect.comparison import results, tables
from colmap_affrect.errors import OptionError
from colmap_affrect.escalation.expected_gain import kind_of
from colmap_affrect.features.base import EXTRACTORS, FeatureExtractor, NetworkContext
from colmap_affrect.mappers.base import MAPPERS, MapperOptions
from colmap_affrect.matchers.base import MATCHERS, Matcher, MatcherContext
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Level, load_recipe
from colmap_affrect.rectifiers.base import (
    RECTIFIERS,
    Rectifier,
    RectifierInputs,
    RectifierOptions,
)
from colmap_affrect.report import run_page
from colmap_affrect.session.context import Context, Inputs
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import choose_pairs

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
PARTS = {
    "mutual": MATCHERS,
    "orb": EXTRACTORS,
    "along-street": RECTIFIERS,
    "plain": MAPPERS,
}


def example(name: str) -> tuple[str, str, str]:
    """Return the path of the file of a part, its code, and the name of its class."""
    line = re.search(rf'`"{name}":\s+"([\w.]+):(\w+)"`', TEXT)
    assert line is not None
    path = f"{line[1].replace('.', '/')}.py"
    code = re.search(rf"```python\n(# {path}\n.*?)```", TEXT, re.DOTALL)
    assert code is not None
    return path, code[1], line[2]


@pytest.fixture(autouse=True)
def _installed(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A package on the path, as pip leaves it, with the lines that the text gives for each part."""
    folder = tmp_path_factory.mktemp("installed")
    info = folder / "other_affrect-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: other-affrect\nVersion: 1.0\n"
    )
    points = []
    for name, registry in PARTS.items():
        path, code, part = example(name)
        module = Path(path).stem
        (folder / f"{module}.py").write_text(code, encoding="utf-8")
        points.append(f"[{registry.group}]\n{name} = {module}:{part}\n")
        monkeypatch.delitem(sys.modules, module, raising=False)
    (info / "entry_points.txt").write_text("\n".join(points))
    monkeypatch.syspath_prepend(folder)


class TestMutual(MatcherContract):
    def make(self) -> Matcher:
        return MATCHERS.make(MATCHERS.options("mutual"), MatcherContext())


class TestOrb(ExtractorContract):
    def make(self) -> FeatureExtractor:
        return EXTRACTORS.make(EXTRACTORS.options("orb"), NetworkContext())


class TestAlongStreet(RectifierContract):
    def options(self) -> RectifierOptions:
        return RECTIFIERS.options("along-street")

    def make(self) -> Rectifier:
        return RECTIFIERS.make(self.options(), RectifierInputs())


class TestPlain(MapperContract):
    def options(self) -> MapperOptions:
        return MAPPERS.options("plain")


def test_new_rectifier_is_escalated_to_as_what_it_declares_to_be() -> None:
    recipe = load_recipe("default", ["rectifier=along-street", "rectifier.tilt=2.5"])
    assert (recipe.rectifier.name, recipe.rectifier.warps) == ("along-street", "some")
    level = Level(recipe.rectifier, recipe.features, 2400, None, 0)
    assert kind_of(level) == "measured, warps"


def needs(package: str) -> pytest.MarkDecorator:
    missing = not importlib.util.find_spec(package)
    return pytest.mark.skipif(missing, reason=f"{package} is not installed")


@needs("ruff")
@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("check", ["check", "format --check"])
def test_example_passes_lint_where_it_is_to_be(name: str, check: str) -> None:
    path, code, _ = example(name)
    command = [
        sys.executable,
        "-m",
        "ruff",
        *check.split(),
        "--stdin-filename",
        path,
        "-",
    ]
    done = subprocess.run(
        command, input=code, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("name", PARTS)
def test_numbers_of_an_example_may_be_added_to_those_of_the_package(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = all_numbers()
    monkeypatch.setattr("deciding_numbers.ROOT", tmp_path)
    path = tmp_path / "example.py"
    path.write_text(example(name)[1], encoding="utf-8")
    assert faults([*known, *Module(path).numbers()]) == []


@needs("mypy")
@pytest.mark.long
def test_examples_pass_type_checks(tmp_path: Path) -> None:
    files = []
    for name in PARTS:
        path, code, _ = example(name)
        files.append(tmp_path / Path(path).name)
        files[-1].write_text(code, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--config-file",
        "pyproject.toml",
        *map(str, files),
    ]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def patched(folder: Path) -> list[Path]:
    """Apply the example of a column to copies of the files that it changes; return these."""
    found = re.search(r"```diff\n(.*?)```", TEXT, re.DOTALL)
    assert found is not None
    paths: list[Path] = []
    old = new = ""
    for line in [*found[1].splitlines(), "---"]:
        is_added = line.startswith("+") and not line.startswith("+++")
        if is_added:
            new += line[1:] + "\n"
            continue
        if new:
            text = paths[-1].read_text(encoding="utf-8")
            assert text.count(old) == 1, old
            changed = text.replace(old, new.removesuffix("\n"))
            paths[-1].write_text(changed, encoding="utf-8")
        if line.startswith("+++ b/"):
            source = ROOT / line.removeprefix("+++ b/")
            paths.append(folder / source.name)
            shutil.copy(source, paths[-1])
        old = line[1:]
        new = f"{old}\n" if line.startswith(" ") else ""
    return paths


def loaded(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"patched_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_new_column_of_cameras_is_in_report_and_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    templates = tmp_path / "templates"
    shutil.copytree(run_page.TEMPLATES, templates)
    cameras, schema, _ = patched(templates)
    monkeypatch.setattr(run_page, "TEMPLATES", templates)
    record = loaded(cameras).CameraRecord(("a.png",), "exif", 200.0, size=(320, 240))
    camera = record.to_report(1, None)
    assert camera["size_px"] == [320, 240]
    described = loaded(schema)
    assert described.CameraEntry(**camera).size_px == (320, 240)
    assert '"size_px"' in described.report_schema()
    report = small_run.small_report(tmp_path)
    changed = report.__class__(**vars(report) | {"cameras": (camera,)})
    monkeypatch.setattr(small_run, "small_report", lambda _: changed)
    page = small_run.make_run_page(tmp_path).read_text(encoding="utf-8")
    assert '<th scope="col">Size, px</th>' in page
    assert "320 x 240" in page


def test_new_column_of_comparisons_is_in_their_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = re.findall(r"```python\n(MEASURES.*?)```", TEXT, re.DOTALL)
    monkeypatch.setattr(results, "MEASURES", dict(results.MEASURES))
    monkeypatch.setattr(tables, "MEASURES", results.MEASURES)
    exec(code, vars(results))
    comparison = make_comparison(tmp_path)
    columns = tables.table(comparison)
    assert len(columns["models"]) == len(comparison.finished)


def test_new_extractor_and_matcher_are_chosen_by_name(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    image = texture((240, 180), 1)
    write_image(photos / "a.png", image)
    write_image(photos / "b.png", image[:, 11:])
    settings = ["features=orb", "features.max_num_features=500", "matching=mutual"]
    recipe = load_recipe("default", settings)
    context = Context(Workspace(tmp_path / "out"))
    with context.workspace.locked():
        extract(context, Inputs.of(photos), recipe)
        choose_pairs(context)
        assert context.matching.name == "mutual"
        assert match(context).num_done == 1
    features = context.features
    first, second = (features.read(name).keypoints for name in ("a.png", "b.png"))
    assert features.read("a.png").descriptors.shape[1] == 256
    (found,) = context.matches.read([("a.png", "b.png")])
    shifts = first[found.indices[:, 0]] - second[found.indices[:, 1]]
    right = abs(shifts - (11.0, 0.0)).max(axis=1) < 1.5
    assert right.sum() > 30
    assert right.mean() > 0.8


@pytest.mark.long
def test_new_mapper_is_chosen_by_name(photos: Path, tmp_path: Path) -> None:
    options = RunOptions(
        recipe=load_recipe("unrectified-rootsift"), mapping=MAPPERS.options("plain")
    )
    report = run(photos, tmp_path / "out", options)
    assert report.registered_names == tuple(sorted(NAMES))


def test_names_and_options_of_other_packages_are_checked_as_our_own() -> None:
    with pytest.raises(OptionError, match=r"unknown option 'num' .did you mean 'name'"):
        load_recipe("default", ["matching=mutual", "matching.num=3"])
    with pytest.raises(
        OptionError, match=r"unknown matcher 'mutal' .did you mean 'mutual'"
    ):
        load_recipe("default", ["matching=mutal"])
