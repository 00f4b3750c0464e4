"""What the doctor finds, and what it has examined."""

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Attributes:
        severity: ``error`` (a program will fail, or results are wrong), ``warning`` (something
            is missing from the results), or ``note`` (worth knowing).
        where: file, folder or part of the installation.
    """

    severity: Severity
    where: str
    what: str
    advice: str


@dataclass
class Diagnosis:
    """The result of an examination: what was found, and what was looked at."""

    checked: list[str] = field(default_factory=list)
    _found: list[Finding] = field(default_factory=list, init=False)

    def add(self, severity: Severity, where: Path | str, what: str, advice: str) -> None:
        """Add what is wrong with a file, folder or part of the installation, and what helps."""
        self._found.append(Finding(severity, str(where), what, advice))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What was found, the worst first."""
        return tuple(sorted(self._found, key=lambda found: SEVERITIES.index(found.severity)))

    @property
    def num_errors(self) -> int:
        """Number of findings that are errors."""
        return self._count("error")

    def _count(self, severity: Severity) -> int:
        return sum(finding.severity == severity for finding in self._found)

    def summary(self) -> str:
        """Return text for people."""
        lines = [f"checked  {line}" for line in self.checked]
        for finding in self.findings:
            lines.append(f"{finding.severity:8s} {finding.where}: {finding.what}")
            lines.append(f"         -> {finding.advice}")
        counts = {severity: self._count(severity) for severity in SEVERITIES[:2]}
        found = [f"{count} {name}{'s' * (count > 1)}" for name, count in counts.items() if count]
        return "\n".join([*lines, ", ".join(found) or "no problems found"])

    def to_json(self) -> str:
        """Return the same for programs."""
        content = {
            "num_errors": self.num_errors,
            "num_warnings": self._count("warning"),
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
            "checked": self.checked,
        }
        return json.dumps(content, indent=2, ensure_ascii=False)
