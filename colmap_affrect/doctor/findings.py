"""What the doctor finds, what it says about it, and what it has examined."""

import dataclasses
import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_affrect.colmap.checks import CHECKS, SEVERITIES, Check, Severity
from colmap_affrect.errors import such_as
from colmap_affrect.progress import Progress

MAX_ITEMS_SHOWN = 5

RECOVER = "'sqlite3 FILE .recover' may save a part"
SAME_RUN = "run the same 'extract' or 'run' again (run.log has the command)"
EXTRACT_AGAIN = "run the same 'extract' or 'run' with --overwrite (run.log has the command)"
PAIRS_AGAIN = "run 'colmap-affrect pairs --output-path {folder}' --overwrite"
MATCH = "run 'colmap-affrect match --output-path {folder}'"
MATCH_AGAIN = "run 'colmap-affrect match --output-path {folder} --overwrite', verify and map"
VERIFY_AGAIN = "run 'colmap-affrect verify --output-path {folder} --overwrite' and map"
MAP = "run 'colmap-affrect map --output-path {folder}'"
MAP_AGAIN = "run 'colmap-affrect map --output-path {folder} --overwrite'"

TEXTS: dict[str, Check] = CHECKS | {
    # the installation
    "import-order": ("warning",
        "pycolmap was imported before colmap_affrect; if nothing has used zlib before, "
        "Python's zlib (PNG files, compressed arrays) ends the process",
        "import colmap_affrect first"),
    "no-torch": ("error", "torch or kornia cannot be loaded ({error})",
        "install them again; recipes with RootSIFT work without"),
    "no-colmap": ("note", "the program colmap is not on PATH",
        "it is needed to look at models ('colmap gui') and for its own commands only"),
    "no-gpu": ("note", "torch sees no GPU that it can use",
        "nothing to do for RootSIFT; learned features and depth networks take longer"),
    "other-weights": ("warning", "not the published file of {key}",
        "unless it is your own, {remedy}"),
    "no-weights": ("note", "not found: {missing}",
        "before using recipes with AffNet and HardNet without network, run: "
        "colmap-affrect weights fetch {keys}"),
    # a database as a whole
    "no-database": ("error", "{error}",
        "give a COLMAP database or an output folder of colmap-affrect; of a damaged database, "
        f"{RECOVER}"),
    "old-schema": ("note",
        "has the tables of an older COLMAP (schema {version}, now {newest}); COLMAP 4 and pycolmap "
        "change them as soon as they open it, and an older COLMAP cannot read it any more",
        "keep a copy: cp {path} {copy}"),
    "database-damaged": ("error", "{error}", f"{RECOVER} of it; else make it anew"),
    # an output folder
    "foreign-folder": ("note",
        "is no output folder of colmap-affrect (it has no config.toml); only its database is "
        "checked",
        "use another --output-path for colmap-affrect"),
    "no-folder": ("error",
        "neither an output folder of colmap-affrect nor one with a database.db",
        "give the --output-path of a run, or a COLMAP database"),
    "in-use": ("warning", "{error}", "run doctor again when it is done"),
    "read-only": ("warning", "{error}", "make it writable before running anything in it"),
    "leftover": ("note", "left behind by a run that was killed", "remove it: rm -r {path}"),
    "damaged": ("error", "{error}", "restore it, or use another --output-path than {folder}"),
    "stages-missing": ("note", "not run yet: {stages}", "run the same 'run' again"),
    "photographs-gone": ("warning", "its photographs are not there ({error})",
        "put them back before running another stage"),
    "no-features": ("warning",
        "images without features: added later, half done, or not readable", SAME_RUN),
    "only-features": ("warning", "images with features that are gone or not listed any more",
        f"put them back; or {SAME_RUN}, which leaves them out"),
    "photographs-changed": ("warning",
        "images that have changed since their features were extracted, or their masks or depth "
        "maps", SAME_RUN),
    "missing": ("error", "is missing", f"{SAME_RUN} to make it anew"),
    "database-changed": ("warning", "was changed since the last run: {edits}",
        f"{SAME_RUN}, or any stage: what features.h5 and matches.h5 hold is made again from these"),
    "pairs-changed": ("error", "is not the list whose pairs were matched",
        f"if you have edited it, {MATCH}; else {PAIRS_AGAIN}"),
    "pairs-not-matched": ("warning", "listed pairs that are not matched", MATCH),
    "map-unfinished": ("warning", "mapping did not finish", MAP),
    "map-stale": ("warning", "the models were made before pairs were verified anew", MAP),
    "summary-damaged": ("error",
        "is missing or damaged: how the model came about is not known any more",
        MAP_AGAIN),
    "no-model": ("warning", "mapping found no model",
        "see 'unregistered' in report.json for reasons"),
}  # fmt: skip
"""By kind: how serious a finding is, what is wrong, and what to do about it."""

OWN_ADVICE: dict[str, str] = {
    **dict.fromkeys(
        ("no-images", "no-parent", "no-frame", "keypoint-data", "keypoints-not-finite",
         "keypoints-outside", "descriptor-data"), EXTRACT_AGAIN,
    ),
    "match-data": MATCH_AGAIN,
    "no-matches": MATCH,
    "no-geometry": "run 'colmap-affrect verify --output-path {folder}' and map",
    "undefined-geometry": VERIFY_AGAIN,
}  # fmt: skip
"""What to do instead where the database is in a folder of ours."""


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


@dataclass(frozen=True)
class Diagnosis:
    """The result of an examination: what was found, worst first, and what was looked at."""

    findings: tuple[Finding, ...]
    checked: tuple[str, ...]

    @property
    def num_errors(self) -> int:
        """Number of findings that are errors."""
        return self._count("error")

    def _count(self, severity: Severity) -> int:
        return sum(finding.severity == severity for finding in self.findings)

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
            "checked": list(self.checked),
        }
        return json.dumps(content, indent=2, ensure_ascii=False)


class Findings:
    """Collects what is found and what was examined; progress is shown by the parts of it."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.checked: list[str] = []
        self._found: list[Finding] = []

    def diagnosis(self) -> Diagnosis:
        """Return what was found, the worst first."""
        ordered = sorted(self._found, key=lambda finding: SEVERITIES.index(finding.severity))
        return Diagnosis(tuple(ordered), tuple(self.checked))

    def add(
        self,
        kind: str,
        where: Path | str,
        items: Sequence[str] = (),
        *,
        advice: str = "",
        **values: object,
    ) -> None:
        """Add a finding of a kind of ``TEXTS`` about a file, folder or part of the installation.

        Of ``items`` it says how many there are, and the first ones. ``advice`` is what to do, where
        it is not what ``TEXTS`` says; ``values`` are for the placeholders in both, paths quoted for
        a shell.
        """
        severity, what, usual_advice = TEXTS[kind]
        values = {k: shlex.quote(str(v)) if isinstance(v, Path) else v for k, v in values.items()}
        what, advice = what.format(**values), (advice or usual_advice).format(**values)
        if items:
            what = f"{what} ({len(items)}): {such_as(items, MAX_ITEMS_SHOWN)}"
        self._found.append(Finding(severity, str(where), what, advice))


def without_path(path: Path, error: Exception) -> str:
    """Return the message of an error without the path that it begins with."""
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}/") or type(error).__name__
