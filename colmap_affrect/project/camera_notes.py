"""What may be wrong of cameras by the model, as ``report.json`` has them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from colmap_affrect.errors import Option, Words

MAX_LENSES = 3  # focal lengths in mm that a summary names; display


@dataclass(frozen=True)
class Contradiction:
    """A source of focal lengths that a model may contradict, and what to say then."""

    what: str  # that may be wrong
    sources: tuple[str, ...]  # of a focal length, as ``report.json`` calls them
    by: str  # what its number is known by
    remedy: Words


# What the user gives is usually held; that of a database only has a prior.
CONTRADICTIONS = (
    Contradiction(
        what="EXIF",
        sources=("exif", "exif-rescaled"),
        by="by EXIF",
        remedy=(Option("ignore-exif"), " leaves it out"),
    ),
    Contradiction(
        what="the given focal length",
        sources=("given",),
        by="given",
        remedy=(Option("cameras-path"), " takes another one"),
    ),
)
# Of a focal length: three standard deviations of what EXIF usually has; theory
MAX_EXIF_ERROR = 1.27


def camera_notes(cameras: Sequence[Mapping[str, Any]]) -> list[Words]:
    """Say where a model contradicts what was known of cameras, and what would tell lenses in mm.

    Args:
        cameras: entries of ``report.json``.
    """
    notes = list[Words]()
    for contradiction in CONTRADICTIONS:
        notes += _contradiction_notes(cameras, contradiction)
    notes += _principal_point_notes(cameras)
    estimated = list(filter(_is_estimated, cameras))
    num_estimates = len({camera["refined_px"] for camera in estimated})
    if num_estimates < len(estimated):
        notes.append(
            f"of those not known mapping makes {num_estimates}: photographs of one size share one"
        )
    lenses_mm = {camera.get("lens_mm") or 0.0 for camera in cameras}
    known_mm = sorted(filter(None, lenses_mm))
    if known_mm:
        texts = ", ".join(f"{mm:g}" for mm in known_mm[:MAX_LENSES])
        notes.append(
            (
                f"EXIF has {texts} mm, and not the size of the sensor: ",
                Option("focal-mm", f"{known_mm[0]:g}"),
                " and ",
                Option("film-width-mm"),
                " (its longer side) tell the focal length",
            )
        )
    return notes


def _contradiction_notes(
    cameras: Sequence[Mapping[str, Any]], contradiction: Contradiction
) -> list[Words]:
    """Return a line where models are far from the focal lengths of some sources."""
    sources = contradiction.sources
    wrong = [camera for camera in cameras if _is_contradicted(camera, sources)]
    if not wrong:
        return []
    known_px = wrong[0]["focal_px"]
    estimated_px = wrong[0]["refined_px"]
    more = f", and {len(wrong) - 1} more" if len(wrong) > 1 else ""
    differs = (
        f"{contradiction.what} may be wrong: {known_px:.0f} px {contradiction.by}, "
        f"{estimated_px:.0f} px in the model{more}; "
    )
    return [(differs, contradiction.remedy)]


def _principal_point_notes(cameras: Sequence[Mapping[str, Any]]) -> list[Words]:
    """Return a line where points of the model contradict given principal points."""
    wrong = [camera for camera in cameras if camera.get("fitting_principal_point_px")]
    if not wrong:
        return []
    given_px = _point_text(wrong[0]["given_principal_point_px"])
    fitting_px = _point_text(wrong[0]["fitting_principal_point_px"])
    more = f", and {len(wrong) - 1} more" if len(wrong) > 1 else ""
    return [
        f"the given principal point may be wrong: {given_px} px given, about {fitting_px} px fits "
        f"better{more}; give another one, or none"
    ]


def _point_text(point_px: Sequence[float]) -> str:
    """Return a point as --principal-point takes it."""
    return f"{point_px[0]:.0f},{point_px[1]:.0f}"


def merge_shared_cameras(
    cameras: Sequence[Mapping[str, Any]],
) -> list[Mapping[str, Any]]:
    """Return cameras, with those that mapping has made one as the first, with all photographs.

    Args:
        cameras: entries of ``report.json``.
    """
    merged: dict[object, Mapping[str, Any]] = {}
    for number, camera in enumerate(cameras):
        key: object = number
        if _is_estimated(camera):
            key = (camera["refined_px"], camera["focal_px"], camera["why"])
        first = merged.get(key)
        if first is None:
            merged[key] = camera
        else:
            names = [*first["names"], *camera["names"]]
            merged[key] = {**first, "names": names, "num_images": len(names)}
    return list(merged.values())


def _is_estimated(camera: Mapping[str, Any]) -> bool:
    """Return whether nothing but the model tells the focal length of a camera."""
    return camera["source"] == "guess" and bool(camera.get("refined_px"))


def _is_contradicted(camera: Mapping[str, Any], sources: Sequence[str]) -> bool:
    """Tell whether a model is far from a focal length that is known from one of some sources."""
    if camera["source"] not in sources or not camera.get("refined_px"):
        return False
    ratio = camera["refined_px"] / camera["focal_px"]
    return not 1 / MAX_EXIF_ERROR <= ratio <= MAX_EXIF_ERROR
