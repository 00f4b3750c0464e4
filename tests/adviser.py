"""What is advised after a run, as commands that the parser takes."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from typing import Any

from colmap_affrect.cli.parser import build_parser
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.report.advice import advice
from colmap_affrect.session.context import Context

AGAIN = "colmap-affrect run --image-path 'a b' --output-path out -q"
"""The command of the run."""


@dataclass(frozen=True)
class Adviser:
    """Asks what may help the run of a command."""

    context: Context
    model: ModelSummary

    def commands(self, missing: list[str], **changes: Any) -> list[str]:
        """Return what is advised where the model is another one; the parser takes it all."""
        model = replace(self.model, **changes)
        found = [one.command for one in advice(self.context, missing, [model], 0)]
        for words in filter(None, found):
            build_parser().parse_args(shlex.split(words)[1:])
        return found

    def anew(self, flags: str) -> str:
        """Return the command of a run with other flags, into a folder beside the first one."""
        path = self.context.workspace.path
        other = path.with_name(f"{path.name}-2")
        return f"colmap-affrect run --image-path 'a b' -q {flags} --output-path {other}"
