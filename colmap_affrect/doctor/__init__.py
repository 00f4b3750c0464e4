"""What is wrong with an output folder, a COLMAP database or the installation, and what helps.

Nothing is changed: databases are examined in a copy. No run can begin in a folder meanwhile.
"""

import shutil
import sys
from pathlib import Path

from colmap_affrect.doctor.findings import Diagnosis, Finding, Findings
from colmap_affrect.doctor.folder import examine_database, examine_folder
from colmap_affrect.errors import OptionError
from colmap_affrect.features.weights import describe_weights, remedy
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.report import installed_versions

__all__ = ["Diagnosis", "Finding", "diagnose"]

USUAL_WEIGHTS = ("affnet", "orinet", "hardnet")  # what learned features need by default


def diagnose(
    path: Path | None = None,
    *,
    image_path: Path | None = None,
    weights_path: Path | None = None,
    progress: Progress = SILENT,
) -> Diagnosis:
    """Examine the installation and, if a path is given, an output folder or a COLMAP database.

    ``path`` may be damaged. With the folder of the photographs their sizes are compared with the
    cameras. Weights of networks are looked for in ``weights_path`` first. OptionError when
    something that is given is not there.
    """
    if path is not None and not path.exists():
        raise OptionError(
            f"{path}: no such file or folder; give a COLMAP database or output folder"
        )
    for folder, option in ((image_path, "--image-path"), (weights_path, "--weights")):
        if folder is not None and not folder.is_dir():
            raise OptionError(f"{option} {folder}: no such folder")
    findings = Findings(progress)
    if path is not None and path.is_dir():
        examine_folder(findings, path, image_path)
    elif path is not None:
        examine_database(findings, path, image_path)
    _examine_installation(findings, weights_path)
    return findings.diagnosis()


def _examine_installation(findings: Findings, weights_path: Path | None) -> None:
    versions = ", ".join(f"{name} {number}" for name, number in installed_versions().items())
    findings.checked.append(f"installation: {versions}")
    loaded = list(sys.modules)
    if loaded.index("pycolmap") < loaded.index("colmap_affrect"):
        findings.add("import-order", "installation")
    try:
        _examine_networks(findings, weights_path)
    except (ImportError, OSError) as error:
        findings.add("no-torch", "installation", error=error)
    if shutil.which("colmap") is None:
        findings.add("no-colmap", "installation")


def _examine_networks(findings: Findings, weights_path: Path | None) -> None:
    from colmap_affrect.features.networks import resolve_device

    device = resolve_device("auto")
    findings.checked.append(f"networks: run on {device}")
    if device.type == "cpu":
        findings.add("no-gpu", "networks")
    rows = describe_weights(weights_path)
    files = ", ".join(sorted(str(row.path) for row in rows if row.path))
    findings.checked.append(f"weights: {files or 'none found'}")
    for row in rows:
        if row.path and row.verified is False:
            findings.add("other-weights", row.path, key=row.key, remedy=remedy(row.path))
    missing = [row for row in rows if row.key in USUAL_WEIGHTS and not row.path]
    if missing:
        names = ", ".join(row.published.file_name for row in missing)
        keys = " ".join(row.key for row in missing)
        findings.add("no-weights", "weights", missing=names, keys=keys)
