"""The server of a page: who is answered, what is served, and what it refuses."""

from __future__ import annotations

import base64
import http.client
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_comparison import write_scene

from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.errors import OptionError
from colmap_affrect.progress import Progress
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import page_server as serving
from colmap_affrect.report.drawn import Drawn, Mark
from colmap_affrect.report.map_again import changes, figures
from colmap_affrect.report.page_server import PageServer, served_page
from colmap_affrect.report.run_report import RunReport

NAMES = ["a.png", "side/b,c.png", "d.png"]
PAGE = (
    "<meta content=\"default-src 'none'; img-src data:; script-src 'sha256-x'\">"
    "<body>page of a run</body>"
)


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    """A folder with a page and a database of three photographs."""
    found = Workspace(tmp_path / "out")
    found.path.mkdir()
    write_scene(found.database, NAMES)
    found.page.write_text(PAGE, encoding="utf-8")
    (tmp_path / "secret.txt").write_text("secret", encoding="utf-8")
    (found.path / "report.json").write_text("{}", encoding="utf-8")
    return found


def maps_nothing(*_: object) -> RunReport:
    raise AssertionError("nothing is to be mapped")


@contextmanager
def running(workspace: Workspace) -> Iterator[PageServer]:
    with PageServer(workspace, maps_nothing, port=0) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def server(workspace: Workspace) -> Iterator[PageServer]:
    with running(workspace) as found:
        yield found


def ask(
    server: PageServer,
    path: str = "",
    method: str = "GET",
    content: object = None,
    **headers: str,
) -> tuple[int, str]:
    """Return status and text of an answer; the headers are those of a browser, and others."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    body = None if content is None else json.dumps(content)
    sent = {"Host": f"127.0.0.1:{server.port}", **headers}
    address = path if path.startswith("/") else f"/{server.token}/{path}"
    connection.request(method, address, body, sent)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


def own(server: PageServer) -> str:
    return f"http://127.0.0.1:{server.port}"


def test_it_listens_on_this_machine_alone(server: PageServer) -> None:
    assert server.server_address[0] == "127.0.0.1"
    assert server.address.startswith(f"http://127.0.0.1:{server.port}/")


def test_the_page_may_talk_to_its_server_and_run_its_script(server: PageServer) -> None:
    status, text = ask(server)
    assert status == 200
    assert "page of a run" in text
    assert "connect-src 'self'" in text
    assert served_page(PAGE) == text
    assert "connect-src" not in PAGE


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/state",
        "/wrong-secret/",
        "/report.html",
        "/../secret.txt",
        "//x/",
        "/%2e%2e/",
    ],
)
def test_who_does_not_know_the_address_is_refused(
    server: PageServer, path: str
) -> None:
    status, text = ask(server, path)
    assert status == 403
    assert "secret" not in text


@pytest.mark.parametrize(
    "path",
    [
        "report.json",
        "../secret.txt",
        "../../secret.txt",
        "%2e%2e/secret.txt",
        "/x",
        "database.db",
        "report.pairs-2.js",
        "report.pairs-1.js/",
    ],
)
def test_nothing_but_the_page_and_its_files_is_served(
    server: PageServer, path: str
) -> None:
    server.workspace.page_file(1).write_text("page.takePairs({})", encoding="utf-8")
    status, text = ask(server, f"/{server.token}/{path}")
    assert status == 404
    assert text == "there is no such page"


def test_the_files_beside_the_page_are_served(server: PageServer) -> None:
    path = server.workspace.page_file(1)
    path.write_text("page.takePairs({})", encoding="utf-8")
    assert ask(server, path.name) == (200, "page.takePairs({})")


def test_a_folder_with_the_name_of_such_a_file_is_not_read(server: PageServer) -> None:
    server.workspace.page_file(1).mkdir()
    assert ask(server, "report.pairs-1.js")[0] == 404


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "", "127.0.0.1"])
def test_other_names_of_the_machine_are_refused(server: PageServer, host: str) -> None:
    assert ask(server, Host=host)[0] == 403


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://127.0.0.1:1"]
)
def test_pages_of_others_are_refused(server: PageServer, origin: str) -> None:
    assert ask(server, "state", Origin=origin)[0] == 403
    assert ask(server, "map", "POST", {}, Origin=origin)[0] == 403
    assert ask(server, "map", "POST", {})[0] == 403
    assert not server.mapping.is_running


def test_what_is_too_large_is_not_read(
    server: PageServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "MAX_NUM_BYTES", 10)
    content = {"marks": [["long enough", "a.png", 1, 2]]}
    assert ask(server, "map", "POST", content, Origin=own(server))[0] == 413


@pytest.mark.parametrize(("content", "words"), [
    ([], "sent no marks"),
    ({"marks": 1}, "sent no marks"),
    ({"marks": [["p", "e.png", 1, 2]]}, "no such photograph"),
    ({"marks": [["p", "../secret.txt", 1, 2]]}, "no such photograph"),
    ({"marks": [["p", "a.png", None, 2]]}, "finite numbers"),
    ({"marks": [["", "a.png", 1, 2]]}, "give it a short name"),
    ({"marks": [["p", "a.png", 1]]}, "without point"),
    ({"masks": {"a.png": "!"}}, "is no picture"),
    ({"masks": {"a.png": base64.b64encode(b"no picture").decode()}}, "is no picture"),
])  # fmt: skip
def test_what_is_no_mark_and_no_mask_is_refused_in_one_line(
    server: PageServer, content: object, words: str
) -> None:
    sent = content
    if isinstance(content, dict):
        sent = {"marks": [], "masks": {}, **content}
    status, text = ask(server, "map", "POST", sent, Origin=own(server))
    assert status == 400
    assert words in json.loads(text)["error"]
    assert not (server.workspace.path / "by-hand").exists()


NESTED = b"[" * 100_000
ODD_CONTENTS = [
    (NESTED, len(NESTED), 400),
    (b"{}", "9" * 5000, 413),
    (b"{}", "-2", 411),
    (b"\xff\xfe\xff", 3, 400),
    (b'{"a": 1}', 8, 400),  # else what was drawn before would be gone
    (b'{"marks": []}', 13, 400),
]


@pytest.mark.parametrize(("content", "length", "status"), ODD_CONTENTS)
def test_what_no_page_sends_is_answered_and_changes_nothing(
    server: PageServer, content: bytes, length: object, status: int
) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    headers = {"Content-Length": f"{length}", "Origin": own(server)}
    connection.request("POST", f"/{server.token}/map", content, headers)
    assert connection.getresponse().status == status
    connection.close()
    assert not server.mapping.is_running
    assert not (server.workspace.path / "by-hand").exists()


def test_a_page_that_is_no_text_is_served_as_far_as_it_is(server: PageServer) -> None:
    server.workspace.page.write_bytes(b"\xff<body>rest of a page</body>")
    status, text = ask(server)
    assert status == 200
    assert "rest of a page" in text


def white_mask() -> bytes:
    mask = np.full((240, 320), 255, np.uint8)
    mask[:10] = 0
    return bytes(cv2.imencode(".png", mask)[1])


def test_what_is_drawn_is_kept_as_the_commands_take_it(workspace: Workspace) -> None:
    marks = [Mark("p", NAMES[0], 1.0, 2.5), Mark("p", NAMES[1], 3.0, 4.0)]
    before = ByHand(rejected=((NAMES[0], NAMES[2]),))
    said = Drawn(marks, {NAMES[1]: white_mask()}).keep(workspace, before)
    digest = said.digest()
    assert said.rejected == before.rejected
    assert {name: mark.tolist() for name, mark in said.marks(NAMES)["p"].items()} == {
        NAMES[0]: [1.0, 2.5],
        NAMES[1]: [3.0, 4.0],
    }
    folder = workspace.path / "by-hand" / "masks"
    assert [path.name for path in folder.rglob("*.png")] == ["b,c.png.png"]

    less = Drawn(marks, {}).keep(workspace, before)
    assert less.masks_path is None
    assert not list(folder.rglob("*.png"))
    assert less.digest() != digest


def test_a_photograph_outside_of_its_folder_gets_no_mask(workspace: Workspace) -> None:
    with pytest.raises(OptionError, match="is outside"):
        Drawn([], {"../../x": white_mask()}).keep(workspace, ByHand())
    assert not (workspace.path.parent / "x.png").exists()


def test_one_mapping_runs_at_a_time_and_what_goes_wrong_is_said(
    server: PageServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()

    def waits(_: ByHand, progress: Progress) -> RunReport:
        assert progress.stream
        progress.stream.write("map: 1/3 images\n")
        go_on.wait(10)
        raise OptionError("a mark is wrong")

    monkeypatch.setattr(server.mapping, "_map_images", waits)
    content = {"marks": [], "masks": {}}
    assert ask(server, "map", "POST", content, Origin=own(server))[0] == 202
    status, text = ask(server, "map", "POST", content, Origin=own(server))
    assert status == 409
    assert "maps already" in json.loads(text)["error"]
    state = json.loads(ask(server, "state")[1])
    while state["text"] != "map: 1/3 images":
        state = json.loads(ask(server, "state")[1])
    assert state["running"]
    go_on.set()
    while server.mapping.is_running:
        time.sleep(0.001)
    state = json.loads(ask(server, "state")[1])
    assert state["answer"] == {"error": "a mark is wrong"}
    assert ask(server, "map", "POST", content, Origin=own(server))[0] == 202


def test_a_port_in_use_and_a_folder_without_a_page_are_refused(
    server: PageServer, tmp_path: Path
) -> None:
    with pytest.raises(OptionError, match="is in use; --port 0"):
        PageServer(server.workspace, maps_nothing, port=server.port)
    with pytest.raises(OptionError, match="no such page"):
        PageServer(Workspace(tmp_path), maps_nothing)


def test_photographs_that_change_are_told_with_what_they_were() -> None:
    before = ModelSummary(
        ("a", "b"), 1200, 3.0, 0.5, probabilities={"a": 0.99, "b": 0.6}
    )
    after = ModelSummary(
        ("a", "b"), 900, 3.0, 0.25, probabilities={"a": 0.99, "b": 0.95}
    )
    second = ModelSummary(("c",), 100, 3.0, 0.5, probabilities={"c": 0.95})
    assert changes(["a", "b", "c"], [before], [after, second]) == [
        ["b", "unsure", "sure"],
        ["c", "not placed", "sure in sparse/1"],
    ]
    assert figures([before], [after, second]) == [
        ["photographs placed", "2", "3"],
        ["of them sure", "1", "3"],
        ["models", "1", "2"],
        ["points", "1,200", "1,000"],
        ["reprojection error, px", "0.50", "0.25"],
    ]


def test_what_is_drawn_is_not_written_where_a_link_leads(
    workspace: Workspace, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "masks").mkdir(parents=True)
    photograph = elsewhere / "masks" / "mine.png"
    photograph.write_bytes(white_mask())
    (workspace.path / "by-hand").symlink_to(elsewhere)
    with pytest.raises(OptionError, match="symbolic link"):
        Drawn([], {}).keep(workspace, ByHand())
    assert photograph.exists()
