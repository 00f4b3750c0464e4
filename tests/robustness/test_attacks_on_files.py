"""Attacks of kinds that had not been tried: streams, recipes, tables, files that vanish, plug-ins.

The first parts take milliseconds each; those that need a process of their own are marked long.
"""

from __future__ import annotations

import errno
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command import Call, on_photographs
from exported_model import write_model
from exported_model import write_photographs as write_its_photographs
from PIL import Image
from small_scene import write_photographs
from synthetic import texture, write_image

from colmap_affrect.colmap.cameras import read_given_cameras
from colmap_affrect.errors import (
    AffrectError,
    OptionError,
    PartError,
    damage,
    heedless_stream,
)
from colmap_affrect.images.photographs import CameraOptions, list_images
from colmap_affrect.images.reading import header_size, read_color, read_gray
from colmap_affrect.matchers.base import MATCHERS, MatcherContext, Matches
from colmap_affrect.pairs.lists import LONGEST_LINE, read_pairs
from colmap_affrect.project.given_h5 import open_given_file
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.regular_files import read_regular_text
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe

FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(
    not FULL.exists(), reason="the system has no device that is full"
)


# Part 1: streams.


@needs_full
def test_work_goes_on_where_nobody_can_be_told() -> None:
    read, written = os.pipe()
    os.close(read)
    for number in (os.open(FULL, os.O_WRONLY), written):
        with heedless_stream(number, "utf-8", closes=True) as stream:
            stream.write("lost\n" * 10_000)
            stream.flush()


@pytest.mark.long
@needs_full
@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_full_device_is_one_line_and_loses_nothing(
    photos: Path, tmp_path: Path, stream: str
) -> None:
    words = ["extract", *on_photographs(photos, tmp_path / "out")]
    command = [sys.executable, "-m", "colmap_affrect", *words]
    streams: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = {
        key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"
    }
    with FULL.open("wb") as full:
        streams[stream] = full
        ended = subprocess.run(
            command, check=False, text=True, env=environment, **streams
        )
    if stream == "stdout":
        assert ended.returncode == 1
        errors = [
            line for line in ended.stderr.splitlines() if line.startswith("error: ")
        ]
        assert errors == [
            "error: what the command prints cannot be written (No space left on device)"
        ]
    else:
        assert ended.returncode == 0
    assert "Traceback" not in (ended.stderr or "")
    assert (tmp_path / "out" / "database.db").exists()


@pytest.mark.long
def test_nothing_is_left_in_the_folder_for_temporary_files(tmp_path: Path) -> None:
    """COLMAP would leave logs there, of the warning that an orientation is odd, for one."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    (tmp_path / "photos").mkdir()
    for name in ("a.tif", "b.tif"):
        write_turned(tmp_path / "photos" / name)
    words = ["extract", *on_photographs(tmp_path / "photos", tmp_path / "out"), "-q"]
    environment = {**os.environ, "TMPDIR": str(folder)}
    command = [sys.executable, "-m", "colmap_affrect", *words]
    assert subprocess.run(command, check=False, env=environment).returncode == 0
    assert list(folder.iterdir()) == []


def write_turned(path: Path) -> None:
    """Write a photograph that lies in a way that COLMAP does not know."""
    Image.fromarray(texture((320, 240), 1)).save(path, tiffinfo={274: 7})


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="the system has no umask")
def test_umask_that_takes_rights_from_the_owner_loses_no_results(
    photos: Path, tmp_path: Path
) -> None:
    words = ["extract", *on_photographs(photos, tmp_path / "out"), "-q"]
    command = [sys.executable, "-m", "colmap_affrect", *words]
    assert subprocess.run(command, check=False, umask=0o777).returncode == 0
    assert (tmp_path / "out" / "database.db").stat().st_mode & 0o777 == 0o600


# Part 2: photographs, lists, tables and recipes.


@pytest.mark.parametrize("kind", ["int8", "int16", "uint32", "int32"])
def test_integers_of_any_kind_are_seen_as_they_are(tmp_path: Path, kind: str) -> None:
    gray = texture((120, 90), 3).astype(np.float64)
    limits = np.iinfo(np.dtype(kind))
    values = limits.min + (gray / 255 * 0.9) * (float(limits.max) - float(limits.min))
    path = tmp_path / "x.tif"
    write_tiff(path, values.astype(kind))
    for read in (read_gray(path), read_color(path, 200)[:, :, 0]):
        assert np.corrcoef(read.ravel(), gray.ravel())[0, 1] > 0.99


def write_tiff(path: Path, values: np.ndarray) -> None:
    """Write one channel of integers of any kind, as programs of measurement do."""
    height, width = values.shape
    formats = {"u": 1, "i": 2, "f": 3}
    data = values.astype(values.dtype.newbyteorder("<")).tobytes()
    bits = values.dtype.itemsize * 8
    tags = [
        (256, 4, width), (257, 4, height), (258, 3, bits), (259, 3, 1), (262, 3, 1),
        (273, 4, 8), (277, 3, 1), (278, 4, height), (279, 4, len(data)),
        (339, 3, formats[values.dtype.kind]),
    ]  # fmt: skip
    entries = b"".join(
        struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags
    )
    start = struct.pack("<2sHI", b"II", 42, 8 + len(data))
    path.write_bytes(start + data + struct.pack("<H", len(tags)) + entries + bytes(4))


def test_comment_of_any_length_in_a_picture_is_looked_through_at_once(
    tmp_path: Path,
) -> None:
    comment, pixels = b"#" + b"x" * 10_000_000 + b"\n", bytes(range(48))
    (tmp_path / "long.ppm").write_bytes(b"P6\n" + comment + b"4 4 255\n" + pixels)
    (tmp_path / "short.ppm").write_bytes(b"P6\n#x\n4 4 255\n" + pixels)
    start = time.process_time()
    assert header_size(tmp_path / "long.ppm") is None
    assert header_size(tmp_path / "short.ppm") == (4, 4)
    assert read_gray(tmp_path / "short.ppm").shape == (4, 4)
    assert time.process_time() - start < 1.0  # it took two seconds and more


LONG_LINES = (
    "a.png " + " " * 200_000 + "x",
    "a.png b.png " + "1" * 200_000 + "x",
    "a.png" + "," * 200_000 + "b.png",
    "a.png b.png " * 20_000,
    "a.png " + " " * (LONGEST_LINE - 100) + "x",
    "a.png b.png " + "1" * (LONGEST_LINE - 100) + "x",
)


@pytest.mark.parametrize("line", LONG_LINES, ids=range(len(LONG_LINES)))
def test_line_of_any_length_is_looked_through_at_once(
    tmp_path: Path, call: Call, line: str
) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text(f"{line}\n", encoding="utf-8")
    with pytest.raises(AffrectError, match="is not two names of images"):
        read_pairs(path, ["a.png", "b.png"])
    (tmp_path / "photos").mkdir()
    for name in ("a.png", "b.png"):
        write_image(tmp_path / "photos" / name, texture((64, 48), 0))
    out = ["--image-path", tmp_path / "photos", "--output-path", tmp_path / "out"]
    ended = call("extract", *out, "--image-list-path", path)
    assert (ended.code, len(ended.errors)) == (2, 1)
    assert len(ended.errors[0]) < 2100


def test_comment_of_any_length_hides_no_pair(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    comment = "# a.png c.png " * 2000
    path.write_text(f"{comment}\na.png b.png\n{' ' * 20_000}\nb.png c.png\n")
    pairs = read_pairs(path, ["a.png", "b.png", "c.png"])
    assert list(pairs) == [("a.png", "b.png"), ("b.png", "c.png")]


def test_many_lines_that_are_no_pairs_are_gone_over_at_once(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("# a comment\n" * 100_000 + "a.png b.png\n")
    start = time.process_time()
    assert list(read_pairs(path, ["a.png", "b.png"], tmp_path)) == [("a.png", "b.png")]
    path.write_text("x.png y.png\n" * 100_000)
    said = "is not two names of images.*, nor are at least 1000 more lines"
    with pytest.raises(AffrectError, match=said):
        read_pairs(path, ["a.png", "b.png"], tmp_path)
    assert time.process_time() - start < 1.0  # either took 3 seconds and more
    path.write_text("#a.png b.png\n# c\n")
    assert list(read_pairs(path, ["#a.png", "b.png"])) == [("#a.png", "b.png")]


def test_list_without_line_ends_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    with path.open("wb") as file:
        file.truncate(1 << 33)  # of holes: to read them takes minutes
    with pytest.raises(AffrectError, match=r"line 1: .* is not two names of images"):
        read_pairs(path, ["a.png", "b.png"])


def test_list_that_repeats_a_name_asks_for_it_once(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    is_file = Path.is_file
    monkeypatch.setattr(
        Path, "is_file", lambda path: asked.append(path) or is_file(path)
    )
    (tmp_path / "list.txt").write_text("a.png\n" * 1000, encoding="utf-8")
    assert list_images(photos, tmp_path / "list.txt") == ["a.png"]
    assert len(asked) < 10


@pytest.mark.parametrize(
    "setting",
    [
        "max_image_size_px=0x" + "f" * 6000,
        "max_image_size_px=" + "9" * 4000,
        "summary=[" + "1," * 5000 + "]",
    ],
)
def test_number_of_any_length_is_one_short_line(setting: str) -> None:
    with pytest.raises(OptionError) as caught:
        load_recipe("unrectified-rootsift", [setting])
    assert len(str(caught.value)) < 500


def test_text_that_is_longer_than_any_list_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "x.toml"
    path.touch()
    os.truncate(path, 3 << 30)
    with pytest.raises(OSError) as caught:  # noqa: PT011 - the number says more
        read_regular_text(path)
    assert caught.value.errno == errno.EFBIG
    with pytest.raises(OptionError, match="cannot be read"):
        load_recipe(str(path))


@pytest.mark.parametrize(
    ("flag", "value", "said"),
    [
        ("--recipe", "", "is empty"),
        ("--depth-path", "", "is empty"),
        ("--scheduler", "", "is empty"),
        ("--max-failures", "-1", "invalid count"),
        ("--reject-pair", '"a.png', "give A,B"),
        ("--reject-pair", f'"{"x" * 200_000}",b', "give A,B"),
        ("--camera-params", ",,,", "holds no numbers"),
        ("--camera-params", "1e308,1,1,1", "params='1e308'"),
        ("--principal-point", "1e9,-1e9", "less than or equal"),
    ],
)
def test_value_that_means_nothing_is_refused(
    photos: Path, tmp_path: Path, call: Call, flag: str, value: str, said: str
) -> None:
    out = ["--image-path", photos, "--output-path", tmp_path / "out"]
    ended = call("run" if flag == "--reject-pair" else "extract", *out, flag, value)
    assert (ended.code, len(ended.stderr)) == (2, 1)
    assert said in ended.errors[0]
    assert len(ended.errors[0]) < 2100
    assert not (tmp_path / "out").exists()


def test_table_of_cameras_has_no_numbers_of_no_camera(tmp_path: Path) -> None:
    (tmp_path / "cameras.csv").write_text("name,focal_px,cx,cy\na.png,300,1e9,-1e9\n")
    with pytest.raises(OptionError, match="line 2: cx="):
        read_given_cameras(CameraOptions(cameras_path=str(tmp_path / "cameras.csv")))


def test_array_that_was_never_written_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "features.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("a/keypoints", (100_000_000, 2), "f4", chunks=(4096, 2))
        file.create_dataset("b/keypoints", data=np.ones((5, 2)))
    with open_given_file(path) as given:
        assert given.read("b/keypoints", (None, 2)).shape == (5, 2)
        with pytest.raises(AffrectError, match="was never written"):
            given.read("a/keypoints", (None, 2))


def test_array_that_a_plugin_has_compressed_is_not_called_damaged(
    tmp_path: Path,
) -> None:
    path = tmp_path / "features.h5"
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((5, 2))
    properties.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, (3,))  # Zstandard
    kind = h5py.h5t.py_create(np.dtype("f4"))
    with h5py.File(path, "w") as file:
        group = file.create_group("a").id
        space = h5py.h5s.create_simple((5, 2))
        array = h5py.h5d.create(group, b"keypoints", kind, space, properties)
        array.write_direct_chunk((0, 0), bytes(30), 0)
        usual = {"compression": "gzip", "shuffle": True, "fletcher32": True}
        file.create_dataset("b/keypoints", data=np.ones((5, 2)), **usual)
    with open_given_file(path) as given:
        assert given.read("b/keypoints", (None, 2)).shape == (5, 2)
        with pytest.raises(AffrectError, match=r"h5: a/keypoints .*\(filter 32015\)"):
            given.read("a/keypoints", (None, 2))


def test_groups_of_any_depth_are_one_line(tmp_path: Path) -> None:
    """HDF5 takes the square of the depth for them."""
    path = tmp_path / "features.h5"
    with h5py.File(path, "w") as file:
        group = file
        for _ in range(150):
            group = group.create_group("d")
        group["keypoints"] = np.ones((5, 2))
    with pytest.raises(AffrectError, match="more than 100 deep"), open_given_file(path):
        pass


@pytest.mark.parametrize("metres", ["1e300", "1e-320"])
def test_model_is_given_no_scale_that_is_none(
    tmp_path: Path, call: Call, metres: str
) -> None:
    write_model(tmp_path / "model")
    ended = call(
        "align", "--model-path", tmp_path / "model", "--output-path", tmp_path / "new",
        "--distance", f"a.png,b.png,{metres}",
    )  # fmt: skip
    assert (ended.code, len(ended.errors)) == (2, 1)
    assert not (tmp_path / "new").exists()


# Part 3: links, files of the system's that cannot be read or removed, and models that are gone.


TO_NEW = ["--image-path", "{photos}", "--output-path", "{new}"]
CIRCLES = (
    ["extract", "--image-path", "{loop}", "--output-path", "{new}"],
    ["extract", "--image-path", "{photos}", "--output-path", "{loop}"],
    ["extract", *TO_NEW, "--mask-path", "{loop}"],
    ["extract", *TO_NEW, "--cameras-path", "{loop}"],
    ["extract", *TO_NEW, "--image-list-path", "{loop}"],
    ["extract", *TO_NEW, "--from-database", "{loop}"],
    ["run", *TO_NEW, "--match-list-path", "{loop}"],
    ["compare", "--image-path", "{loop}", "--output-path", "{new}"],
    ["evaluate", "evd", "--dataset-path", "{loop}", "--output-path", "{new}"],
    ["export", "--model-path", "{loop}", "--output-path", "{new}"],
    ["export", "--model-path", "{model}", "--output-path", "{loop}"],
    ["align", "--model-path", "{loop}", "--output-path", "{new}", "--distance", "a,b,1"],
    ["panoramas", "--image-path", "{loop}", "--output-path", "{new}"],
    ["convert", "--image-path", "{photos}", "--output-path", "{loop}"],
    ["doctor", "{loop}"],
)  # fmt: skip


@pytest.mark.parametrize("words", CIRCLES, ids=range(len(CIRCLES)))
def test_links_that_lead_in_a_circle_are_one_line(
    photos: Path, tmp_path: Path, call: Call, words: list[str]
) -> None:
    (tmp_path / "loop").symlink_to("loop")
    write_model(tmp_path / "model")
    names = {key: tmp_path / key for key in ("loop", "new", "model")} | {
        "photos": photos
    }
    ended = call(*(word.format(**names) for word in words))
    assert ended.code in (1, 2)
    assert (len(ended.errors), len(ended.stderr)) == (1, 1)
    assert str(tmp_path) in ended.errors[0]


def test_photographs_of_another_size_are_not_exported(
    tmp_path: Path, call: Call
) -> None:
    """COLMAP copies them, beside a model that is of others."""
    write_model(tmp_path / "model", "PINHOLE")
    for name in ("a.png", "b.png", "side/c.png", "d.png"):
        (tmp_path / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / "photos" / name, texture((80, 60), 0))
    given = ["--model-path", tmp_path / "model", "--image-path", tmp_path / "photos"]
    ended = call(
        "export", *given, "--output-path", tmp_path / "new", "--format", "nerfstudio"
    )
    assert (ended.code, len(ended.errors)) == (1, 1)
    assert "a.png: is 80 x 60 px, and its camera 160 x 120" in ended.errors[0]
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("name", ["./a.png", "side//a.png", "../a.png"])
def test_names_that_colmap_would_end_at_are_one_line(
    tmp_path: Path, call: Call, name: str
) -> None:
    model = write_model(tmp_path / "model", "PINHOLE")
    model.image(1).name = name
    model.write(tmp_path / "model")
    given = ["--model-path", tmp_path / "model", "--image-path", tmp_path / "photos"]
    write_its_photographs(tmp_path / "photos")
    ended = call(
        "export", *given, "--output-path", tmp_path / "new", "--format", "undistorted"
    )
    assert (ended.code, len(ended.errors)) == (2, 1)
    assert f"the image name {name} " in ended.errors[0]
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("number", [errno.EACCES, errno.EMFILE, errno.EIO])
def test_file_that_cannot_be_read_is_not_called_damaged(number: int) -> None:
    with (
        pytest.raises(AffrectError, match=r"x: cannot be read .*mend that") as caught,
        damage(Path("x"), "remove it"),
    ):
        raise OSError(number, os.strerror(number))
    assert "remove" not in str(caught.value)


def test_folder_that_cannot_be_removed_is_named_with_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "sparse"
    folder.mkdir()

    def refuse(_: Path) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "images.bin")

    monkeypatch.setattr("shutil.rmtree", refuse)
    with pytest.raises(AffrectError, match=f"{folder}: cannot be removed"):
        remove_own([folder])


@pytest.mark.long
def test_models_that_are_gone_are_made_again(tmp_path: Path, call: Call) -> None:
    """A run must not say that it finds none: somebody has removed them, or half of a folder."""
    write_photographs(tmp_path / "photos")
    words = [
        "run",
        *on_photographs(tmp_path / "photos", tmp_path / "out"),
        "--json",
        "--no-page",
    ]
    before = call(*words).report
    sparse = Workspace(tmp_path / "out").sparse
    (sparse / "0").rename(tmp_path / "away")
    assert call("doctor", tmp_path / "out").code == 1
    ended = call(*words)
    assert ended.code == 0
    assert ended.report["registered_names"] == before["registered_names"]
    assert (sparse / "0" / "images.bin").exists()
    assert call("doctor", tmp_path / "out").code == 0


# Part 4: parts of other packages that do not work.

START = """
from typing import Literal
import numpy as np
from colmap_affrect.matchers.base import MatcherOptions, Matches

class O(MatcherOptions):
    name: Literal["odd"] = "odd"

"""
GOOD = "class P:\n    Options = O\n    def __init__(self, *_): {}\n    def prepare(self, _): {}\n"
PARTS = {
    "raise RuntimeError('boom')": "cannot be loaded (RuntimeError: boom)",
    "def (": "cannot be loaded (SyntaxError",
    "raise SystemExit(0)": "cannot be loaded (SystemExit",
    "P = None": "has no class 'Options' with the base MatcherOptions",
    "class P:\n    pass": "has no class 'Options' with the base MatcherOptions",
    "class P:\n    class Options: pass": "has no class 'Options' with the base MatcherOptions",
    START + GOOD.format("raise KeyError('boom')", "pass")
    + "    def match(self, a, b): pass": "failed (KeyError: 'boom')",
    START + GOOD.format("pass", "pass"): "has no method 'match'",
    START + GOOD.format("pass", "raise OSError(5, 'boom')")
    + "    def match(self, a, b): pass": "prepare failed (OSError: [Errno 5] boom)",
    START + GOOD.format("pass", "pass")
    + "    def match(self, a, b): return None": "match returned NoneType, not Matches",
}  # fmt: skip


@pytest.fixture
def use_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Install a package whose code defines the matcher ``odd``, match with it once."""

    def use(code: str) -> None:
        (tmp_path / "odd_part.py").write_text(code, encoding="utf-8")
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "odd_part", raising=False)
        point = metadata.EntryPoint("odd", "odd_part:P", MATCHERS.group)
        monkeypatch.setattr(metadata, "entry_points", lambda **_: [point])
        matcher = MATCHERS.make(MATCHERS.options("odd"), MatcherContext())
        prepared = matcher.prepare(None)  # type: ignore[arg-type]
        matcher.match(prepared, prepared)

    return use


@pytest.mark.parametrize("code", PARTS, ids=range(len(PARTS)))
def test_part_of_another_package_that_fails_is_one_line(
    use_part: Callable[[str], None], code: str
) -> None:
    with pytest.raises(
        (OptionError, PartError)
    ) as caught:  # the former when it is loaded
        use_part(code)
    assert PARTS[code] in str(caught.value)
    assert "matcher 'odd' of a package without a name (odd_part:P)" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("indices", "scores", "said"), [
    ([[0, 10]], [1.0], "that there are not"), ([[-1, 0]], [1.0], "that there are not"),
    ([[0, 0], [0, 1]], [1.0, 1.0], "matched twice"), ([[0, 1], [1, 1]], [1.0, 1.0], "twice"),
    ([[0.5, 1.0]], [1.0], "no integers"), ([[0, 1]], [], "of shape"), ([[0, 1]], [np.nan], "in"),
    ([[0, 1], [2, 0]], [0.0, 1.0], ""), (np.zeros((0, 2), int), [], ""),
])  # fmt: skip
def test_matches_of_features_that_there_are_not_are_refused(
    indices: Any, scores: Any, said: str
) -> None:
    fault = Matches(np.asarray(indices), np.asarray(scores, np.float32)).fault(5, 10)
    assert said in fault
    assert bool(fault) == bool(said)
