"""What is wrong with an output folder, a COLMAP database or the installation, and what helps.

Nothing is changed: databases are examined in a copy. No run can begin in a folder meanwhile.
"""

import shutil
import sys
from pathlib import Path

from colmap_affrect.doctor.findings import Diagnosis, Finding
from colmap_affrect.doctor.folder import examine_database, examine_folder
from colmap_affrect.errors import OptionError
from colmap_affrect.features.weights import describe_weights, remedy
from colmap_affrect.project.report import installed_versions

__all__ = ["Diagnosis", "Finding", "diagnose"]

USUAL_WEIGHTS = ("affnet", "orinet", "hardnet")  # what learned features need by default


def diagnose(
    path: Path | None = None, *, image_path: Path | None = None, weights_path: Path | None = None
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
    diagnosis = Diagnosis()
    if path is not None:
        examine = examine_folder if path.is_dir() else examine_database
        examine(diagnosis, path, image_path)
    _examine_installation(diagnosis, weights_path)
    return diagnosis


def _examine_installation(diagnosis: Diagnosis, weights_path: Path | None) -> None:
    versions = ", ".join(f"{name} {number}" for name, number in installed_versions().items())
    diagnosis.checked.append(f"installation: {versions}")
    loaded = list(sys.modules)
    if loaded.index("pycolmap") < loaded.index("colmap_affrect"):
        diagnosis.add(
            "warning", "installation",
            "pycolmap was imported before colmap_affrect; if nothing has used zlib before, "
            "Python's zlib (PNG files, compressed arrays) ends the process",
            "import colmap_affrect first",
        )  # fmt: skip
    try:
        _examine_networks(diagnosis, weights_path)
    except (ImportError, OSError) as error:
        diagnosis.add(
            "error", "installation", f"torch or kornia cannot be loaded ({error})",
            "install them again; recipes with RootSIFT work without",
        )  # fmt: skip
    if shutil.which("colmap") is None:
        diagnosis.add(
            "note", "installation", "the program colmap is not on PATH",
            "it is needed to look at models ('colmap gui') and for its own commands only",
        )  # fmt: skip


def _examine_networks(diagnosis: Diagnosis, weights_path: Path | None) -> None:
    from colmap_affrect.features.networks import resolve_device

    diagnosis.checked.append(f"networks: run on {resolve_device('auto')}")
    rows = describe_weights(weights_path)
    files = ", ".join(sorted(str(row.path) for row in rows if row.path))
    diagnosis.checked.append(f"weights: {files or 'none found'}")
    for row in rows:
        if row.path and row.verified is False:
            what, advice = f"not the published file of {row.key}", remedy(row.path)
            diagnosis.add("warning", row.path, what, f"unless it is your own, {advice}")
    missing = [row for row in rows if row.key in USUAL_WEIGHTS and not row.path]
    if missing:
        files = ", ".join(row.published.file_name for row in missing)
        diagnosis.add(
            "note", "weights", f"not found: {files}",
            "before using recipes with AffNet and HardNet without network, run: "
            f"colmap-affrect weights fetch {' '.join(row.key for row in missing)}",
        )  # fmt: skip
