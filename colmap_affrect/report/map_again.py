"""Maps again what a page has sent, one mapping at a time, and says what has changed."""

import io
import logging
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.colmap.database_copy import read_names
from colmap_affrect.errors import AffrectError, one_line, with_flags
from colmap_affrect.mappers.mapping import read_summaries
from colmap_affrect.progress import Progress
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report.drawn import Drawn, folder_by_hand
from colmap_affrect.report.photographs import quality_of
from colmap_affrect.report.run_report import RunReport
from colmap_affrect.report.verdict import QUALITIES

logger = logging.getLogger(__name__)

MapImages = Callable[[ByHand, Progress], RunReport]
"""Maps the images of a run with what is said by hand, as the stage ``map`` does."""


class MapsAgain:
    """Maps a run again in a thread of its own, and knows how far that is."""

    def __init__(
        self, workspace: Workspace, by_hand: ByHand, map_images: MapImages
    ) -> None:
        """Take the folder of a run.

        Args:
            workspace: of the run.
            by_hand: rejected pairs and photographs left out, which stay.
            map_images: maps the run.
        """
        self.workspace = workspace
        self.names = read_names(workspace.database)
        self._by_hand = by_hand
        self._map_images = map_images
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._began_s = 0.0
        self._said = _LastLine()
        self._num_done = 0
        self._answer: Mapping[str, Any] | None = None

    @property
    def is_running(self) -> bool:
        """Whether it maps just now."""
        return self._thread is not None and self._thread.is_alive()

    def state(self) -> dict[str, Any]:
        """Return how far it is, and what came of the last mapping, as JSON has it."""
        with self._lock:
            running = self.is_running
            seconds = time.monotonic() - self._began_s if running else 0.0
            return {
                "running": running,
                "seconds": round(seconds, 1),
                "text": self._said.text if running else "",
                "number": self._num_done,
                "answer": None if running else self._answer,
            }

    def begin(self, content: Any) -> bool:
        """Begin to map with what a page has sent, unless a mapping runs.

        Args:
            content: see :meth:`Drawn.of_request`.

        Returns:
            Whether it has begun.

        Raises:
            OptionError: marks or masks that cannot be used.
        """
        drawn = Drawn.of_request(content, self.names)
        with self._lock:
            if self.is_running:
                return False
            self._began_s = time.monotonic()
            self._said = _LastLine()
            self._answer = None
            self._thread = threading.Thread(
                target=self._work, args=(drawn,), daemon=True
            )
            self._thread.start()
        return True

    def _work(self, drawn: Drawn) -> None:
        """Map, and keep what came of it; what is wrong is part of that."""
        try:
            answer = self._map(drawn)
        except AffrectError as error:
            answer = {"error": one_line(with_flags(error.words))}
        except Exception as error:  # the page has to hear of it, whatever it is
            logger.exception("mapping has failed")
            answer = {"error": f"mapping has failed, run.log says why: {error!r:.300}"}
        with self._lock:
            self._answer = answer
            self._num_done += 1

    def _map(self, drawn: Drawn) -> dict[str, Any]:
        """Map with what was drawn, and return what has changed."""
        before = read_summaries(self.workspace.sparse)
        self._keep_models()
        by_hand = drawn.keep(self.workspace, self._by_hand)
        report = self._map_images(by_hand, Progress(self._said))
        residuals = []
        for model in report.models:
            for one in model.tie_points:
                residuals.append([one.point, one.image, round(one.error_px, 2)])
        return {
            "figures": figures(before, report.models),
            "changes": changes(self.names, before, report.models),
            "residuals": residuals,
            "why": report.why_no_model,
        }

    def _keep_models(self) -> None:
        """Keep the models that there are, for :mod:`colmap_affrect.report.two_runs`."""
        kept = folder_by_hand(self.workspace) / "before"
        if kept.is_dir():
            remove_own([kept])
        if self.workspace.sparse.is_dir():
            shutil.copytree(self.workspace.sparse, kept)


def figures(
    before: Sequence[ModelSummary], after: Sequence[ModelSummary]
) -> list[list[str]]:
    """Return what can be counted of models, each as a name and two texts, before and after."""
    sides = []
    for models in (before, after):
        sides.append(_figures(models))
    return [[name, sides[0][name], sides[1][name]] for name in sides[0]]


def _figures(models: Sequence[ModelSummary]) -> dict[str, str]:
    """Return what can be counted of the models of a run."""
    placed = sum(len(model.registered_names) for model in models)
    sure = sum(len(model.sure) for model in models)
    points = sum(model.num_points3D for model in models)
    error = f"{models[0].mean_reprojection_error_px:.2f}" if models else "-"
    return {
        "photographs placed": f"{placed}",
        "of them sure": f"{sure}",
        "models": f"{len(models)}",
        "points": f"{points:,}",
        "reprojection error, px": error,
    }


def changes(
    names: Sequence[str], before: Sequence[ModelSummary], after: Sequence[ModelSummary]
) -> list[list[str]]:
    """Return the photographs whose class or model is another one.

    Args:
        names: of all photographs.
        before: models, the largest first.
        after: models, the largest first.

    Returns:
        Name, what it was and what it is, in words.
    """
    found = []
    for name in names:
        was = _fate(name, before)
        now = _fate(name, after)
        if was != now:
            found.append([name, was, now])
    return found


def _fate(name: str, models: Sequence[ModelSummary]) -> str:
    """Return the class of a photograph in words, and its model if that is not the largest."""
    for number, model in enumerate(models):
        if name in model.registered_names:
            where = f" in sparse/{number}" if number else ""
            return f"{QUALITIES[quality_of(name, model)]}{where}"
    return QUALITIES["missing"]


class _LastLine(io.StringIO):
    """Keeps the last line that was written; progress goes here."""

    def __init__(self) -> None:
        super().__init__()
        self.text = "beginning"
        self._begun = ""

    def write(self, text: str) -> int:
        """Take a piece of text."""
        lines = (self._begun + text).split("\n")
        self._begun = lines[-1]
        whole = [line.strip() for line in lines[:-1] if line.strip()]
        if whole:
            self.text = whole[-1]
        return len(text)
