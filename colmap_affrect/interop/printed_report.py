"""The page of a run as a PDF, printed by a browser of this machine."""

import logging
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from colmap_affrect.errors import Option, OptionError
from colmap_affrect.project.workspace import Workspace

logger = logging.getLogger(__name__)

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")
"""What browsers are called that print without a window."""
OTHER_PLACES = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
)
"""Where they are where no command of theirs is found, as on macOS."""
TIMEOUT_S = 180.0  # of a browser that prints a page of a thousand photographs; resource
DRAWING_MS = 10_000  # at most, that scripts of the page get to draw the model; resource


def find_browser() -> str:
    """Return the path of a browser that can print; empty where there is none."""
    for name in BROWSERS:
        found = shutil.which(name)
        if found:
            return found
    for path in OTHER_PLACES:
        if Path(path).is_file():
            return path
    return ""


def write_report(model_path: Path, folder: Path) -> Path:
    """Write the page of a run with the files beside it, and a PDF where a browser is there.

    Args:
        model_path: folder of a model of the run.
        folder: new folder for the files.

    Returns:
        The PDF; the page where no browser has printed it, which a warning says.

    Raises:
        OptionError: the model is not of a run, or that has no page.
    """
    workspace = Workspace(model_path.resolve().parent.parent)
    if not workspace.page.is_file():
        raise OptionError(
            f"{workspace.page}: no such page",
            where="report",
            advice=(
                "give the output folder of a run, or map without ",
                Option("no-page"),
            ),
        )
    folder.mkdir()
    page = folder / "report.html"
    shutil.copyfile(workspace.page, page)
    for beside in workspace.page_files():
        shutil.copyfile(beside, folder / beside.name)
    browser = find_browser()
    if not browser:
        names = ", ".join(BROWSERS[:3])
        logger.warning(
            "report: no browser was found (%s) that makes a PDF; open %s and print it",
            names,
            page.name,
        )
        return page
    printed = folder / "report.pdf"
    why = print_page(browser, page, printed)
    if why:
        logger.warning(
            "report: %s made no PDF (%s); open %s and print it", browser, why, page.name
        )
        return page
    return printed


def print_page(browser: str, page: Path, printed: Path) -> str:
    """Print a page into a PDF.

    Args:
        browser: path of the browser, as Chromium.
        page: HTML file that loads nothing.
        printed: the PDF to make.

    Returns:
        Why there is no PDF; empty where there is one.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [
            browser,
            "--headless",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
            "--no-pdf-header-footer",
            f"--virtual-time-budget={DRAWING_MS}",
            f"--user-data-dir={profile}",
            f"--print-to-pdf={printed.resolve()}",
        ]
        if sys.platform == "linux" and os.geteuid() == 0:
            command.append("--no-sandbox")  # which root cannot have
        command.append(page.resolve().as_uri())
        try:
            done = subprocess.run(  # noqa: S603 - a browser, of its own files
                command, capture_output=True, timeout=TIMEOUT_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return str(error).partition("\n")[0]
    if not printed.is_file() or not printed.stat().st_size:
        return f"exit code {done.returncode}"
    return ""
