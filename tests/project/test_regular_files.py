"""Files of others: pipes, devices and sockets are refused before they could be waited for."""

from __future__ import annotations

import hashlib
import os
import socket
import stat
from pathlib import Path

import pytest

from colmap_affrect.project.outputs import fitting_name
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.regular_files import (
    NotAFileError,
    open_regular,
    read_regular,
    read_regular_text,
    require_regular,
    sha256_of_regular,
)

pytestmark = pytest.mark.skipif(
    not hasattr(os, "mkfifo"), reason="the system has no pipes"
)


@pytest.fixture(
    params=["pipe", "device", "socket", "folder", "link to a pipe", "link to a device"]
)
def odd(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Something that has the name of a file."""
    path = tmp_path / "x.jpg"
    match request.param:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "socket":
            os.chdir(tmp_path)  # names of sockets are short
            with socket.socket(socket.AF_UNIX) as opened:
                opened.bind(path.name)
        case "folder":
            path.mkdir()
        case "link to a pipe":
            os.mkfifo(tmp_path / "pipe")
            path.symlink_to(tmp_path / "pipe")
        case _:
            path.symlink_to("/dev/null")
    return path


@pytest.fixture(autouse=True)
def _in_its_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


def test_what_is_no_regular_file_is_refused_at_once(odd: Path) -> None:
    for read in (
        open_regular,
        read_regular,
        read_regular_text,
        sha256_of_regular,
        require_regular,
    ):
        with pytest.raises(NotAFileError, match="is not a file, but a"):
            read(odd)


def test_regular_files_are_read_through_links_too(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"\xef\xbb\xbfone\r\ntwo")
    (tmp_path / "link.txt").symlink_to(tmp_path / "a.txt")
    assert read_regular_text(tmp_path / "link.txt", "utf-8-sig") == "one\ntwo"
    expected = hashlib.sha256(read_regular(tmp_path / "a.txt")).hexdigest()
    assert sha256_of_regular(tmp_path / "link.txt") == expected
    require_regular(tmp_path / "nowhere")  # is left to whoever opens it
    with pytest.raises(FileNotFoundError):
        open_regular(tmp_path / "nowhere")


def test_a_pipe_that_takes_the_place_of_a_file_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "x")
    monkeypatch.setattr(
        "colmap_affrect.project.regular_files.require_regular", lambda _: None
    )
    with pytest.raises(NotAFileError):
        open_regular(tmp_path / "x")


@pytest.mark.skipif(
    not Path("/proc/self/pagemap").exists(), reason="only Linux has such files"
)
def test_files_that_never_end_are_read_as_long_as_they_say_they_are() -> None:
    assert stat.S_ISREG(Path("/proc/self/pagemap").stat().st_mode)
    assert read_regular(Path("/proc/self/pagemap")) == b""
    assert sha256_of_regular(Path("/proc/self/pagemap")) == hashlib.sha256().hexdigest()


def test_a_pipe_keeps_its_name_and_a_link_does_not(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    assert resolved(Path(f"/dev/fd/{reading}")) == Path(f"/dev/fd/{reading}")
    os.close(reading)
    os.close(writing)
    (tmp_path / "a").touch()
    (tmp_path / "link").symlink_to("a")
    assert resolved(Path("link")) == (tmp_path / "a").resolve()


@pytest.mark.parametrize("stem", ["b" * 250, "č" * 130, "\udcff" * 230])
def test_names_that_are_too_long_are_cut_and_stay_different(
    tmp_path: Path, stem: str
) -> None:
    names = [fitting_name(f"{stem}{end}", ".png") for end in "ab"]
    assert len(set(names)) == 2
    for name in names:
        assert name.endswith(".png")
        (tmp_path / f"{name}.{'0' * 8}.affrect-new").touch()
