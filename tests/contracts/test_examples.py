"""The parts of ARCHITECTURE.md do their work, as entry points of another package."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from contracts import test_mappers
from contracts.contracts import ExtractorContract, MatcherContract
from small_scene import NAMES
from synthetic import texture, write_image

from colmap_affrect.errors import OptionError
from colmap_affrect.features.base import EXTRACTORS, FeatureExtractor, NetworkContext
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.matchers.base import MATCHERS, Matcher, MatcherContext
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.session.context import Context, Inputs
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import choose_pairs

TEXT = (Path(__file__).parents[2] / "ARCHITECTURE.md").read_text(encoding="utf-8")
PARTS = {"mutual": MATCHERS, "orb": EXTRACTORS, "plain": MAPPERS}


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package on the path, as pip leaves it, with the lines that the text gives for each part."""
    info = tmp_path / "other_affrect-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-affrect\nVersion: 1.0\n")
    points = []
    for name, registry in PARTS.items():
        line = re.search(rf'`"{name}":\s+"([\w.]+):(\w+)"`', TEXT)
        assert line is not None
        package, _, module = line[1].rpartition(".")
        path = f"{package}.{module}".replace(".", "/")
        code = re.search(rf"```python\n(# {path}\.py\n.*?)```", TEXT, re.DOTALL)
        assert code is not None
        (tmp_path / f"{module}.py").write_text(code[1], encoding="utf-8")
        points.append(f"[{registry.group}]\n{name} = {module}:{line[2]}\n")
        monkeypatch.delitem(sys.modules, module, raising=False)
    (info / "entry_points.txt").write_text("\n".join(points))
    monkeypatch.syspath_prepend(tmp_path)


class TestMutual(MatcherContract):
    def make(self) -> Matcher:
        return MATCHERS.make(MATCHERS.options("mutual"), MatcherContext())


class TestOrb(ExtractorContract):
    def make(self) -> FeatureExtractor:
        return EXTRACTORS.make(EXTRACTORS.options("orb"), NetworkContext())


task = test_mappers.task


def test_new_mapper_keeps_the_contract(task: MappingTask, tmp_path: Path) -> None:
    own = tmp_path / "own"
    own.mkdir()
    test_mappers.test_mapper_registers_tells_of_it_and_keeps_given_cameras("plain", task, own)
    test_mappers.test_mapper_has_presets_and_refuses_unknown_options("plain")


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


def test_new_mapper_is_chosen_by_name(photos: Path, tmp_path: Path) -> None:
    options = RunOptions(
        recipe=load_recipe("unrectified-rootsift"), mapping=MAPPERS.options("plain")
    )
    report = run(photos, tmp_path / "out", options)
    assert report.registered_names == tuple(sorted(NAMES))


def test_names_and_options_of_other_packages_are_checked_as_our_own() -> None:
    with pytest.raises(OptionError, match=r"unknown option 'num' .did you mean 'name'"):
        load_recipe("default", ["matching=mutual", "matching.num=3"])
    with pytest.raises(OptionError, match=r"unknown matcher 'mutal' .did you mean 'mutual'"):
        load_recipe("default", ["matching=mutal"])
