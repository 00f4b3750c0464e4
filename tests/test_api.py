"""What a user of the package meets: names, keywords, refusals, help, reports."""

from __future__ import annotations

import ast
import inspect
import io
import re
import subprocess
import sys
import typing
from dataclasses import fields, is_dataclass, replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from small_comparison import make_comparison
from small_run import NAMES, small_report
from small_scene import INTRINSICS

import colmap_affrect
from colmap_affrect import ByHand, CameraOptions, MaskOptions, PairOptions, Resources
from colmap_affrect.cli.flags import FLAGS
from colmap_affrect.comparison import tables
from colmap_affrect.comparison.method_run import CompareKeywords, CompareOptions
from colmap_affrect.errors import (
    ARGUMENTS,
    AffrectError,
    NoModelError,
    OptionError,
    with_arguments,
)
from colmap_affrect.evaluation.evaluate import EvaluateKeywords, EvaluateOptions
from colmap_affrect.features.base import EXTRACTORS, SHAPES
from colmap_affrect.interop.align import Reference, ReferenceKeywords
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.matchers.base import MATCHERS
from colmap_affrect.options import Options, Summarized
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.rectifiers.base import RECTIFIERS
from colmap_affrect.report.run_report import RunReport
from colmap_affrect.session.run_options import RunKeywords, RunOptions

PACKAGE = Path(colmap_affrect.__file__).parent
PINHOLE = {"model": "PINHOLE", "params": INTRINSICS, "mode": "single"}
NEEDED = [
    "run", "extract", "choose_pairs", "match", "verify", "map_images", "map_database", "export",
    "align", "compare", "evaluate", "diagnose", "AffrectError", "OptionError", "NoModelError",
    "Recipe", "load_recipe", "Progress", "Resources", "RunOptions", "CameraOptions", "pycolmap",
]  # fmt: skip
PUBLIC = {name: getattr(colmap_affrect, name) for name in colmap_affrect.__all__}


@pytest.fixture(autouse=True)
def _arguments_in_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have errors name arguments, as outside of the command line."""
    monkeypatch.setattr(
        AffrectError, "__str__", lambda error: with_arguments(error.words)
    )


def test_what_users_need_is_there_and_nothing_else_is_listed() -> None:
    assert set(NEEDED) <= set(colmap_affrect.__all__)
    assert dir(colmap_affrect) == sorted(colmap_affrect.__all__)
    assert all(value.__doc__ for name, value in PUBLIC.items() if name != "__version__")
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        colmap_affrect.nothing  # noqa: B018


def test_type_checkers_read_the_names_that_are_loaded() -> None:
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    read = {alias.name: node.module for node in imports for alias in node.names}
    assert read.pop("pycolmap") == "colmap_affrect"
    assert read == {
        n: f"colmap_affrect.{m}" for n, m in colmap_affrect._MODULES.items()
    }


SCRIPT = """
import colmap_affrect
print(colmap_affrect.diagnose.__module__, colmap_affrect.pycolmap.__name__)
"""


def test_names_and_pycolmap_are_found_without_other_imports() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, check=True
    )
    assert done.stdout.decode().split() == [
        "colmap_affrect.doctor",
        "colmap_affrect.pycolmap",
    ]


# Options and keywords


PARTS = [
    registry.part(name).Options
    for registry in (EXTRACTORS, SHAPES, RECTIFIERS, MATCHERS, MAPPERS)
    for name in registry.built_in
]
OPTIONS = [
    v for v in PUBLIC.values() if isinstance(v, type) and issubclass(v, Options)
] + PARTS
RESULTS = [v for v in PUBLIC.values() if isinstance(v, type) and is_dataclass(v)]


def meanings(cls: type) -> dict[str, str]:
    """Return what ``help()`` says of each attribute."""
    section = (inspect.getdoc(cls) or "").partition("Attributes:\n")[2]
    found = re.findall(r"^ {4}(\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
    return {name: text.partition("Default: ")[0] for name, text in found}


@pytest.mark.parametrize("cls", OPTIONS, ids=lambda cls: cls.__name__)
def test_help_says_what_each_option_means(cls: type[Options]) -> None:
    said = meanings(cls)
    assert said.keys() == cls.model_fields.keys()
    assert [name for name, text in said.items() if len(text.split()) < 2] == []


@pytest.mark.parametrize("cls", RESULTS, ids=lambda cls: cls.__name__)
def test_help_says_what_each_field_of_a_result_means(cls: type) -> None:
    said = meanings(cls)
    assert list(said) == [field.name for field in fields(cls)]
    assert [name for name, text in said.items() if len(text.split()) < 2] == []


@pytest.mark.parametrize(("function", "cls", "keywords"), [
    ("run", RunOptions, RunKeywords), ("extract", RunOptions, RunKeywords),
    ("compare", CompareOptions, CompareKeywords), ("evaluate", EvaluateOptions, EvaluateKeywords),
    ("align", Reference, ReferenceKeywords),
])  # fmt: skip
def test_fields_of_options_are_keywords_of_functions(
    function: str, cls: type[Options], keywords: type
) -> None:
    assert typing.get_type_hints(keywords).keys() == cls.model_fields.keys()
    assert (
        cls.model_fields.keys() <= inspect.signature(PUBLIC[function]).parameters.keys()
    )


def test_parts_of_options_are_dictionaries_names_or_paths_too(tmp_path: Path) -> None:
    options = RunOptions(
        recipe="rectified",
        cameras={"mode": "single"},
        mapping={"name": "incremental", "min_model_size": 5},
        extend=tmp_path,
        by_hand={"rejected": [["a.jpg", "b.jpg"]], "left_out": ["c.jpg"]},
        resources={"weights_path": tmp_path},
        image_list_path="list.txt",
    )
    assert options.recipe == colmap_affrect.load_recipe("rectified")
    assert options.cameras == colmap_affrect.CameraOptions(mode="single")
    assert options.mapping == colmap_affrect.IncrementalOptions(min_model_size=5)
    assert options.extend == colmap_affrect.Extension(model_path=tmp_path)
    assert options.by_hand.rejected == (("a.jpg", "b.jpg"),)
    assert options.resources.weights_path == tmp_path
    assert options.image_list_path == Path("list.txt")
    assert (
        RunOptions(recipe={"rectifier": "identity"}).recipe.rectifier.name == "identity"
    )
    assert (
        RunOptions(mapping="global").mapper_options() == colmap_affrect.GlobalOptions()
    )
    mapped = colmap_affrect.Recipe(mapping={"name": "incremental"})
    assert (
        RunOptions(recipe=mapped).mapper_options()
        == colmap_affrect.IncrementalOptions()
    )


REFUSED: list[tuple[str, str]] = [
    ("run('a', 'b', 'rectified')",
     "options='rectified': give RunOptions; a recipe is given as recipe='NAME'"),
    ("run('a', 'b', recip='x')", "unknown option 'recip' (did you mean 'recipe'?)"),
    ("run('a', 'b', recipe='rectifed')",
     "recipe: unknown recipe 'rectifed' (did you mean 'rectified'?)"),
    ("run('a', 'b', recipe=3)", "recipe: recipe=3: give a Recipe, a name, a path or a dictionary"),
    ("run('a', 'b', cameras={'mod': 'single'})",
     "cameras: unknown option 'mod' (did you mean 'mode'?)"),
    ("run('a', 'b', cameras=3)",
     "cameras=3: should be a valid dictionary or instance of CameraOptions"),
    ("run('a', 'b', mapping='globl')",
     "mapping: unknown mapper 'globl' (did you mean 'global'?)"),
    ("run('a', 'b', effort='hihg')", "effort='hihg': should be 'low', 'normal' or 'high'"),
    ("run('a', 'b', max_minutes=-1)", "max_minutes=-1: should be greater than or equal to 0"),
    ("run('a', 'b', by_hand={'left_out': 'a.jpg'})",
     "by_hand: left_out='a.jpg': should be a list or tuple"),
    ("run('a', 'b', overwrite='no')", "overwrite='no': give True or False"),
    ("run('a', 'b', page=1)", "page=1: give True or False"),
    ("run('a', 'b', progress='x')", "progress='x': give True, False or a Progress"),
    ("run('a', 'b', executor=3)", "executor=3: has no method 'map'; give an Executor"),
    ("run(3, 'b')", "image_path=3: give a path as str or os.PathLike, not int"),
    ("run('a', 3)", "output_path=3: give a path as str or os.PathLike, not int"),
    ("extract('a', 'b', recipee='x')", "unknown option 'recipee' (did you mean 'recipe'?)"),
    ("choose_pairs('b', 'retrieval')",
     "pairs='retrieval': give PairOptions or a dictionary of its fields"),
    ("match('b', 'neerest')", "matching: unknown matcher 'neerest' (did you mean 'nearest'?)"),
    ("verify('b', {'max_error': 3})",
     "verification: unknown option 'max_error' (did you mean 'max_error_px'?)"),
    ("map_images('b', 'globl')", "mapping: unknown mapper 'globl' (did you mean 'global'?)"),
    ("map_database('a', 'b', match_type='x')", "match_type='x': give 'raw' or 'inliers'"),
    ("map_database('a', 'b', cameras=3)",
     "cameras=3: give CameraOptions or a dictionary of its fields"),
    ("compare('a', 'b', seeds=3)", "seeds=3: should be a list or tuple"),
    ("evaluate('evd', 'a', 'b', recipe='x')", "unknown option 'recipe' (did you mean 'recipes'?)"),
    ("align('a', 'b', 3)", "reference=3: give Reference"),
    ("align('a', 'b', distance=[])", "unknown option 'distance' (did you mean 'distances'?)"),
    ("diagnose(3)", "path=3: give a path as str or os.PathLike, not int"),
    ("load_recipe('default', 'rectifier')", "set rectifier: expected OPTION=VALUE"),
    ("load_recipe(3)", "name=3: give a path as str or os.PathLike, not int"),
    ("report_lines('a.jpg')", "paths: 'a.jpg' is str; give Sequence[str or PathLike[str]]"),
    ("camera_from_lines(3)", "image=3: give a path as str or os.PathLike, not int"),
    ("extract_features('a.db', 'b', 'c.jpg')",
     "image_names: 'c.jpg' is str; give Iterable[str or PathLike[str]]"),
    ("match_feature_sets({}, progress=3)", "progress: 3 is int; give Progress or bool or None"),
    ("Progress(3)", "stream=3: give None or a stream, as sys.stderr"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("call", "message"), REFUSED, ids=[call for call, _ in REFUSED]
)
def test_wrong_arguments_are_refused_by_name_before_anything_is_made(
    call: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OptionError, match=f"^{re.escape(message)}"):
        eval(f"colmap_affrect.{call}")
    assert list(tmp_path.iterdir()) == []


def test_errors_name_fields_of_options_where_flags_stand_for_them() -> None:
    fields = {
        dest for settings in FLAGS.values() if "." in (dest := settings.get("dest", ""))
    }
    fields -= {
        "cameras.model",
        "pairs.match_list_path",
    }  # of export and map_database, too
    assert fields <= set(ARGUMENTS.values())
    arguments = {name for function in PUBLIC.values() if inspect.isfunction(function)
                 for name in inspect.signature(function).parameters}  # fmt: skip
    parts = {"cameras": CameraOptions, "masks": MaskOptions, "pairs": PairOptions,
             "by_hand": ByHand, "resources": Resources}  # fmt: skip
    for name in ARGUMENTS.values():
        part, _, field = name.rpartition(".")
        known = parts[part].model_fields if part else arguments | {"mapper_options"}
        assert field in known, name


def test_a_format_is_a_word_or_several(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"^formats plx: unknown .did you mean 'ply'"):
        colmap_affrect.export(tmp_path, tmp_path / "out", "text,plx")
    with pytest.raises(OptionError, match=r"not a COLMAP model"):
        colmap_affrect.export(tmp_path, tmp_path / "out", "ply")


def test_a_stage_of_a_database_names_the_functions_that_take_one(
    tmp_path: Path,
) -> None:
    (tmp_path / "any.db").touch()
    with pytest.raises(
        OptionError, match=r"any.db': is a file; .*verify_matches take databases"
    ):
        colmap_affrect.verify(tmp_path / "any.db")


# Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_is_shown_where_somebody_looks_at_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own = Progress()
    file = io.StringIO()
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", file)
    assert Progress.given(own) is own
    assert Progress.given(None) is Progress.given(False) is SILENT
    assert Progress.given(True).stream is file
    kernel = SimpleNamespace(config={"IPKernelApp": {}})
    notebook = SimpleNamespace(get_ipython=lambda: kernel)
    monkeypatch.setitem(sys.modules, "IPython", notebook)  # type: ignore[arg-type]
    assert Progress.given(None).takes_bars
    kernel.config.clear()  # IPython on a terminal
    assert Progress.given(None) is SILENT
    monkeypatch.setattr(sys, "stderr", terminal)
    assert Progress.given(None).stream is terminal
    assert Progress.given(False) is SILENT


# Reports


class Text(HTMLParser):
    """The words of a page, tags checked to be closed."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.tags: list[str] = []
        self.feed(page)
        assert not self.tags

    def handle_starttag(self, tag: str, _: Any) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.tags.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def report_of(folder: Path, **changes: Any) -> RunReport:
    """The report of a small run, as if its folder were there."""
    values = vars(small_report(folder)) | changes | {"output_path": folder / "out"}
    return RunReport(**values)


def test_a_notebook_shows_counts_photographs_and_what_to_try(tmp_path: Path) -> None:
    report = report_of(tmp_path)
    page = report._repr_html_()
    assert NAMES[0] not in page, "names are no markup"
    text = Text(page).words
    assert text[0] == "4 of 6 photographs registered"
    pairs = dict(reversed([*pairwise(text)]))  # the first one of each word
    shown = {
        key: pairs[key]
        for key in ("verified pairs", "sure", "unsure", "doubtful", "points")
    }
    assert shown == {
        "verified pairs": "15 of 15", "sure": "2", "unsure": "1", "doubtful": "1", "points": "90",
    }  # fmt: skip
    assert pairs[NAMES[0]] == "99%"
    assert pairs["c.png"] == "70%"
    assert pairs["40%"] == "doubtful: may be a mirrored copy of <b>.jpg"
    assert pairs["e.png"] == "no verified pair"
    assert pairs["Try: one camera"].startswith("colmap-affrect run")
    assert text[-1] == str(tmp_path / "out")


def test_a_notebook_rounds_no_probability_up_to_what_it_is_not(tmp_path: Path) -> None:
    """Doubtful is below one half, and nothing is right for sure."""
    largest = report_of(tmp_path).models[0]
    doubtful = next(iter(largest.doubtful))
    changed = {**largest.probabilities, NAMES[0]: 0.999, doubtful: 0.498}
    models = (replace(largest, probabilities=changed),)
    words = Text(report_of(tmp_path, models=models)._repr_html_()).words
    shown = dict(reversed([*pairwise(words)]))
    assert (shown[NAMES[0]], shown[doubtful]) == (">99%", "49%")


def test_a_notebook_links_a_page_below_its_folder_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = report_of(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.html").touch()
    assert report.page_path == tmp_path / "out" / "report.html"
    assert 'href="' not in report._repr_html_(), (
        "a notebook serves files below its folder only"
    )
    monkeypatch.chdir(tmp_path)
    assert 'href="out/report.html"' in report._repr_html_()


def test_a_report_is_short_on_a_prompt_and_whole_when_printed(tmp_path: Path) -> None:
    report = report_of(tmp_path)
    assert repr(report) == (
        f"RunReport(registered='4 of 6 images', status='partial', output_path='{tmp_path / 'out'}')"
    )
    assert str(report) == report.summary()


def test_a_report_without_models_says_why_there_is_no_reconstruction(
    tmp_path: Path,
) -> None:
    report = report_of(tmp_path, models=(), num_verified_pairs=0)
    with pytest.raises(NoModelError, match="no pair of images is verified"):
        report.reconstruction()
    assert "no pair of images is verified" in Text(report._repr_html_()).words[0]


@pytest.mark.long
def test_stage_by_stage_makes_the_model_of_a_run(photos: Path, tmp_path: Path) -> None:
    recipe = "unrectified-rootsift"
    folder = tmp_path / "stages"
    extracted = colmap_affrect.extract(
        photos, folder, recipe=recipe, cameras=PINHOLE, pairs={"methods": ["sequence"]},
        mapping="incremental",
    )  # fmt: skip
    assert (extracted.name, extracted.num_done) == ("extract", 4)
    assert colmap_affrect.choose_pairs(folder).num_done == 6
    assert colmap_affrect.match(folder).num_done == 6
    assert colmap_affrect.verify(folder).num_done == 6
    report = colmap_affrect.map_images(folder, page=False)
    assert report.mapping["name"] == "incremental"
    model = report.reconstruction()
    assert model.num_reg_images() == 4
    assert colmap_affrect.pycolmap.Reconstruction(
        folder / "sparse" / "0"
    ).num_points3D() == (model.num_points3D())
    with pytest.raises(OptionError, match=r"^number=1: the models are 0 to 0"):
        report.reconstruction(1)
    options = RunOptions(cameras=PINHOLE, mapping="incremental")
    whole = colmap_affrect.run(
        photos, tmp_path / "run", options, recipe=recipe, pairs={"methods": ["sequence"]},
        page=False,
    )  # fmt: skip
    assert whole.registered_names == report.registered_names
    assert whole.models[0].num_points3D == report.models[0].num_points3D
    assert whole.page_path is None
    assert "output_path" not in whole.to_mapping(), "folders may be moved"


def test_other_results_show_their_summary(tmp_path: Path) -> None:
    comparison = make_comparison(tmp_path)
    assert str(comparison) == comparison.summary() == tables.summary(comparison)
    (text,) = Text(comparison._repr_html_()).words
    assert text == comparison.summary()
    diagnosis = colmap_affrect.Diagnosis(checked=["<out>"])
    assert "".join(Text(diagnosis._repr_html_()).words) == str(diagnosis)
    for name in ("StageReport", "Alignment", "Evaluation"):
        assert PUBLIC[name].__str__ is Summarized.__str__
