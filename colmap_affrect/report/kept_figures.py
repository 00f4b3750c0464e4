"""Figures of photographs that the report before has of the same models.

To read a model of thousands of photographs, and to count the points that they share, takes most of
the time of a command that finds everything done. ``report.json`` says by a digest which models its
figures are of; it is of the figures, too, so that none are taken that somebody has edited.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from colmap_affrect import errors
from colmap_affrect.colmap.model_files import kept_digests
from colmap_affrect.options import digest_of
from colmap_affrect.project.regular_files import read_regular_text
from colmap_affrect.project.report import PLAIN, installed_versions
from colmap_affrect.report.photographs import MODEL_FIGURES, PhotographReport

_PHOTOGRAPHS = TypeAdapter(dict[str, PhotographReport])


def models_key(sparse_path: Path, num_models: int) -> str:
    """Return a digest of models, and of the versions that figures are counted by.

    Args:
        sparse_path: folder of all models.
        num_models: of the run.

    Returns:
        The digest; empty where the files of a model have none.
    """
    digests = []
    for number in range(num_models):
        digests.append(kept_digests(sparse_path / str(number)))
    if not digests or not all(digests):
        return ""
    return digest_of([digests, installed_versions()])


def figures_digest(key: str, photographs: Mapping[str, PhotographReport]) -> str:
    """Return what a report says of where its figures are from; empty without a key.

    Args:
        key: of the models.
        photographs: as the report has them.
    """
    return digest_of([key, PLAIN.dump_python(photographs)]) if key else ""


def kept_figures(report_path: Path, key: str) -> dict[str, dict[str, Any]] | None:
    """Return what models say of photographs, as a report has it; None if that is of other models.

    Args:
        report_path: ``report.json`` of the command before.
        key: of the models that there are now.

    Returns:
        By name the values of ``MODEL_FIGURES``.
    """
    with suppress(*errors.DAMAGE):
        content = json.loads(read_regular_text(report_path))
        photographs = _PHOTOGRAPHS.validate_python(content["photographs"])
        if key and content["made_from"] == figures_digest(key, photographs):
            return {
                name: {figure: getattr(found, figure) for figure in MODEL_FIGURES}
                for name, found in photographs.items()
            }
    return None
