"""A server for the page of a run, for the browser of the same person on the same machine.

It listens on 127.0.0.1 alone. Its addresses begin with a secret that only the command prints;
requests that other pages make, under names of other hosts or from other origins, are refused. It
serves the page of the run and the files beside it, which are read anew each time, and nothing
else that is on the disk.
"""

import hashlib
import json
import logging
import secrets
import sys
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import TCPServer
from typing import Any

from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.errors import (
    AffrectError,
    Option,
    OptionError,
    one_line,
    with_flags,
)
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.map_again import MapImages, MapsAgain
from colmap_affrect.report.page import TEMPLATES
from colmap_affrect.report.pictures import base64_text

logger = logging.getLogger(__name__)

HOST = "127.0.0.1"
PORT = 8427  # the same each time, a browser keeps marks by it; convention
SCRIPT = TEMPLATES / "serve.js"
POLICY_BEGIN = "default-src 'none';"
"""How the Content-Security-Policy of a page begins, which then allows what the server needs."""
SCRIPTS_BEGIN = "script-src"
# Of what a page sends: masks of some hundred photographs; resource
MAX_NUM_BYTES = 64 << 20
# Of the length of what a page sends: more are no number of bytes; format
MAX_DIGITS = 19
TIMEOUT_S = 30.0  # of a browser that says nothing more; resource
NUM_TOKEN_BYTES = 16  # nobody guesses that; theory

HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class PageServer(ThreadingHTTPServer):
    """Serves the page of one run, and maps again what is drawn on it."""

    daemon_threads = True
    # There, others could take the port over
    allow_reuse_address = sys.platform != "win32"

    def __init__(
        self,
        workspace: Workspace,
        map_images: MapImages,
        by_hand: ByHand | None = None,
        port: int = PORT,
    ) -> None:
        """Begin to listen.

        Args:
            workspace: of a run that has a page.
            map_images: maps the run.
            by_hand: rejected pairs and photographs left out, which stay.
            port: of 127.0.0.1; 0 for one that is free.

        Raises:
            OptionError: there is no page, or the port is in use.
        """
        if not workspace.page.is_file():
            raise OptionError(
                "no such page",
                where=workspace.page,
                advice=(
                    "give the output folder of a run, or run it without ",
                    Option("no-page"),
                ),
            )
        self.workspace = workspace
        self.mapping = MapsAgain(workspace, by_hand or ByHand(), map_images)
        self.token = secrets.token_urlsafe(NUM_TOKEN_BYTES)
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise OptionError(
                "is in use",
                where=Option("port", port),
                advice=(Option("port"), " 0 takes one that is free"),
            ) from error

    def server_bind(self) -> None:
        """Begin to listen, without asking the network for the name of this machine."""
        TCPServer.server_bind(self)
        self.server_name = HOST
        self.server_port = self.port

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self.server_address[1])

    @property
    def address(self) -> str:
        """What a browser is to open."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    @property
    def hosts(self) -> tuple[str, str]:
        """What a browser of this machine calls the server; a page of others has another name."""
        return f"{HOST}:{self.port}", f"localhost:{self.port}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Keep what goes wrong with a request out of the terminal."""
        logger.debug("%s of %s has failed", request, client_address, exc_info=True)


def served_page(page: str) -> str:
    """Return a page with the script that talks to the server.

    Args:
        page: as ``report.html`` has it, which allows no script of others and no requests.
    """
    script = SCRIPT.read_text(encoding="utf-8")
    digest = base64_text(hashlib.sha256(script.encode()).digest())
    allowed = page.replace(POLICY_BEGIN, f"{POLICY_BEGIN} connect-src 'self';", 1)
    allowed = allowed.replace(SCRIPTS_BEGIN, f"{SCRIPTS_BEGIN} 'sha256-{digest}'", 1)
    before, end, after = allowed.rpartition("</body>")
    return f"{before}<script>{script}</script>\n{end}{after}"


class _Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    server: PageServer
    timeout = TIMEOUT_S
    protocol_version = "HTTP/1.1"
    server_version = "colmap-affrect"
    sys_version = ""

    def do_GET(self) -> None:
        """Answer with the page, or how far mapping is."""
        self._answer({"": self._send_page, "state": self._send_state})

    def do_POST(self) -> None:
        """Begin to map."""
        self._answer({"map": self._begin_mapping})

    def log_message(self, format: str, *args: Any) -> None:
        """Keep requests out of the terminal: their addresses have the secret."""

    def _answer(self, actions: dict[str, Callable[[], None]]) -> None:
        """Carry out what the path asks for, or refuse it."""
        why = self._why_refused()
        if why:
            self._send(HTTPStatus.FORBIDDEN, why)
            return
        asked = self.path.removeprefix(f"/{self.server.token}/")
        action = actions.get(asked)
        for path in self.server.workspace.page_files():
            if path.name == asked and self.command == "GET":
                action = partial(self._send_file, path)
        if action is None:
            self._send(HTTPStatus.NOT_FOUND, "there is no such page")
            return
        action()

    def _why_refused(self) -> str:
        """Return why a request is not answered; empty where it is of the page itself."""
        host = self.headers.get("Host", "")
        if host not in self.server.hosts:
            return "this server answers to its own name only"
        origin = self.headers.get("Origin")
        is_own = origin == f"http://{host}"
        if self.command == "POST" and not is_own:
            return "only the page of this server may ask for that"
        if origin is not None and not is_own:
            return "only the page of this server may ask for that"
        wanted = f"/{self.server.token}/".encode()
        given = self.path.encode("utf-8", "replace")[: len(wanted)]
        if not secrets.compare_digest(given, wanted):
            return "open the whole address that the command has printed"
        return ""

    def _send_page(self) -> None:
        page = self._read(self.server.workspace.page)
        if page is not None:
            self._send(HTTPStatus.OK, served_page(page), "text/html")

    def _send_file(self, path: Path) -> None:
        text = self._read(path)
        if text is not None:
            self._send(HTTPStatus.OK, text, "text/javascript")

    def _read(self, path: Path) -> str | None:
        """Read the page or a file beside it; where that is gone, say so and return None."""
        try:
            return path.read_text("utf-8", errors="replace")
        except OSError:
            why = "the page is being written anew: load it again in a moment"
            self._send(HTTPStatus.SERVICE_UNAVAILABLE, why)
            return None

    def _send_state(self) -> None:
        self._send_json(HTTPStatus.OK, self.server.mapping.state())

    def _begin_mapping(self) -> None:
        """Begin to map with what was sent, and say whether that was possible."""
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            self._refuse_content(
                HTTPStatus.LENGTH_REQUIRED, "how long it is, is not said"
            )
            return
        if len(length) > MAX_DIGITS or int(length) > MAX_NUM_BYTES:
            why = f"more than {MAX_NUM_BYTES >> 20} MB of masks"
            self._refuse_content(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, why)
            return
        try:
            content = json.loads(self.rfile.read(int(length)))
            has_begun = self.server.mapping.begin(content)
        except (ValueError, RecursionError) as error:
            self._send_json(HTTPStatus.BAD_REQUEST, {"error": f"not JSON: {error}"})
        except AffrectError as error:
            answer = {"error": one_line(with_flags(error.words))}
            self._send_json(HTTPStatus.BAD_REQUEST, answer)
        else:
            status = HTTPStatus.ACCEPTED if has_begun else HTTPStatus.CONFLICT
            why = "" if has_begun else "it maps already; wait until that is done"
            self._send_json(status, {"error": why})

    def _refuse_content(self, status: HTTPStatus, why: str) -> None:
        """Answer without reading what was sent."""
        self.close_connection = True
        self._send_json(status, {"error": why})

    def _send_json(self, status: HTTPStatus, content: dict[str, Any]) -> None:
        self._send(status, json.dumps(content), "application/json")

    def _send(self, status: HTTPStatus, text: str, kind: str = "text/plain") -> None:
        """Send an answer.

        Args:
            status: of HTTP.
            text: of the answer.
            kind: of the text.
        """
        if self.command == "POST" and status == HTTPStatus.FORBIDDEN:
            self.close_connection = True  # what was sent is not read
        content = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(content)


def serve(
    workspace: Workspace,
    by_hand: ByHand,
    port: int,
    map_images: MapImages,
    say: Callable[[str], None],
) -> None:
    """Serve the page of a run until Ctrl-C.

    Args:
        workspace: of a run that has a page.
        by_hand: rejected pairs and photographs left out, which stay.
        port: of 127.0.0.1; 0 for one that is free.
        map_images: maps the run.
        say: is told the address.

    Raises:
        OptionError: there is no page, or the port is in use.
        KeyboardInterrupt: Ctrl-C while it maps.
    """
    with PageServer(workspace, map_images, by_hand, port) as server:
        say(f"page        {server.address}")
        say("            open it in a browser of this machine; Ctrl-C ends")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            if server.mapping.is_running:
                raise  # the mapping is given up, too
            say("ended")
