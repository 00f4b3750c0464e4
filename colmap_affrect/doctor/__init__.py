"""What is wrong with an output folder, a COLMAP database or the installation, and what helps.

Nothing is changed: databases are examined in a copy. No run can begin in a folder meanwhile.
"""

from pathlib import Path

from colmap_affrect.doctor.findings import Diagnosis, Finding
from colmap_affrect.doctor.folder import examine_database, examine_folder
from colmap_affrect.errors import OptionError
from colmap_affrect.features.weights import WEIGHT_FILES, find, is_published, remedy
from colmap_affrect.project.report import installed_versions

__all__ = ["Diagnosis", "Finding", "diagnose"]


def diagnose(path: Path | None = None, *, weights_path: Path | None = None) -> Diagnosis:
    """Examine the installation and, if a path is given, an output folder or a COLMAP database.

    OptionError when something that is given is not there.
    """
    if path is not None and not path.exists():
        raise OptionError(
            f"{path}: no such file or folder; give a COLMAP database or output folder"
        )
    if weights_path is not None and not weights_path.is_dir():
        raise OptionError(f"--weights {weights_path}: no such folder")
    diagnosis = Diagnosis()
    if path is not None:
        examine = examine_folder if path.is_dir() else examine_database
        examine(diagnosis, path)
    _examine_installation(diagnosis, weights_path)
    return diagnosis


def _examine_installation(diagnosis: Diagnosis, weights_path: Path | None) -> None:
    versions = ", ".join(f"{name} {number}" for name, number in installed_versions().items())
    diagnosis.checked.append(f"installation: {versions}")
    try:
        from colmap_affrect.features.networks import resolve_device
    except (ImportError, OSError) as error:
        diagnosis.add(
            "error", "installation", f"torch or kornia cannot be loaded ({error})",
            "install them again; recipes with RootSIFT work without",
        )  # fmt: skip
        return
    diagnosis.checked.append(f"networks: run on {resolve_device('auto')}")
    found = {key: path for key in WEIGHT_FILES if (path := find(key, weights_path))}
    files = ", ".join(sorted(map(str, found.values())))
    diagnosis.checked.append(f"weights: {files or 'none found'}")
    for key, path in found.items():
        if is_published(key, path) is False:
            what, advice = f"not the published file of {key}", remedy(path)
            diagnosis.add("warning", path, what, f"unless it is your own, {advice}")
