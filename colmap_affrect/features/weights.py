"""Weights of networks: where they are, where they come from, and reading them safely.

Files keep their upstream names. They are looked for, before any image is touched, in

1. the folder that the user gives,
2. the folder in the environment variable ``COLMAP_AFFRECT_WEIGHTS``,
3. torch's cache, where kornia keeps them too,

and else downloaded into that cache. torch and kornia are loaded only when they are needed.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from colmap_affrect.errors import WeightsError
from colmap_affrect.options import AffNetHardNetOptions
from colmap_affrect.progress import SILENT, Progress

ENVIRONMENT_VARIABLE = "COLMAP_AFFRECT_WEIGHTS"

WEIGHTLESS_RECIPES = ("default", "on-demand", "unrectified-rootsift")
"""Recipes that need no weights: the way out when there is no network."""

TIMEOUT_S = 30.0
"""Longest wait for a server, to connect and for each read."""

CHUNK_BYTES = 1 << 16


@dataclass(frozen=True)
class WeightFile:
    """A published file.

    Attributes:
        file_name: upstream's.
        used_for: the option that needs it, for people.
        licence: of the repository that publishes it; empty if it states none.
        sha256: of the file, where it could be computed; else empty.
    """

    file_name: str
    used_for: str
    licence: str = ""
    sha256: str = ""


WEIGHT_FILES: dict[str, WeightFile] = {
    "affnet": WeightFile(
        "AffNet.pth",
        "affine shapes",
        "MIT",
        "65c8bb2cf71e913818522d09dcc4262bcbcef5d756baa86a41f28526c2d61160",
    ),
    "orinet": WeightFile(
        "OriNet.pth",
        "orientation of learned features",
        "MIT",
        "030e7964ae3e136d00431c7e11c6b67df40ad299f02ac384fee0f1c3fd1dcb30",
    ),
    "hardnet": WeightFile("checkpoint_liberty_with_aug.pth", "descriptor hardnet", "MIT"),
    "hardnet8": WeightFile("hardnet8v2.pt", "descriptor hardnet8", "MIT"),
    "hynet": WeightFile("HyNet_LIB.pth", "descriptor hynet", "MIT"),
    "sosnet": WeightFile("sosnet_32x32_liberty.pth", "descriptor sosnet"),
    "tfeat": WeightFile("tfeat-liberty.params", "descriptor tfeat", "MIT"),
    "mkd": WeightFile("mkd-concat-64.pth", "descriptor mkd", "MIT"),
    "hardtfeat": WeightFile(
        "HardTFeat.pth",
        "descriptor hardtfeat",
        "MIT",
        "cd935728293309b666c20525696c8d323be5ffdac07b3340f4c1c1314e0b6542",
    ),
    "keynet": WeightFile("keynet_pytorch.pth", "detector keynet"),
}
"""Published files by key; the key of a descriptor is its name in the options."""


def profile_weights(options: AffNetHardNetOptions) -> tuple[str, ...]:
    """Return the keys of the files that a learned feature profile reads."""
    shape = ("affnet",) if options.affine_shape else ()
    detector = ("keynet",) if options.detector == "keynet" else ()
    return (*shape, "orinet", options.descriptor, *detector)


def resolve(
    keys: Iterable[str],
    weights_path: Path | None = None,
    *,
    download: bool = True,
    progress: Progress = SILENT,
    weightless_recipes: Sequence[str] = WEIGHTLESS_RECIPES,
) -> dict[str, Path]:
    """Find files of weights, or download them into torch's cache.

    Args:
        keys: of :data:`WEIGHT_FILES`.
        weights_path: folder to look into first.
        download: whether files that are nowhere may be downloaded.
        progress: where the progress of downloads goes.
        weightless_recipes: recipes that the error recommends.

    Returns:
        The path of each key.

    Raises:
        WeightsError: one for all files that are missing and cannot be downloaded.
    """
    if weights_path is not None and not weights_path.is_dir():
        raise WeightsError(f"--weights {weights_path}: not a folder")
    found = {key: _find(key, weights_path) for key in keys}
    missing = [key for key, path in found.items() if path is None]
    reason = "downloads are off"
    try:
        if download:
            for key in missing:
                found[key] = _download(key, cache_folder(), progress)
            missing = []
    except WeightsError as error:
        missing = [key for key in missing if found[key] is None]
        reason = str(error)
    if missing:
        raise _missing_error(missing, weights_path, reason, weightless_recipes)
    return {key: path for key, path in found.items() if path is not None}


def fetch(
    keys: Iterable[str], folder: Path | None = None, *, progress: Progress = SILENT
) -> dict[str, Path]:
    """Download files into a folder, torch's cache by default; those already there stay.

    Raises:
        WeightsError: for an unknown key, or when a download fails.
    """
    keys = list(keys)
    for key in keys:
        if key not in WEIGHT_FILES:
            raise WeightsError(f"unknown weights '{key}' (known: {', '.join(WEIGHT_FILES)})")
    target = cache_folder() if folder is None else folder
    paths = {}
    for key in keys:
        path = target / WEIGHT_FILES[key].file_name
        paths[key] = path if path.is_file() else _download(key, target, progress)
    return paths


@dataclass(frozen=True)
class WeightStatus:
    """What is known of one file of weights.

    Attributes:
        key: of :data:`WEIGHT_FILES`.
        file_name, used_for, licence: as published.
        path: where it was found; None if nowhere.
        verified: whether its sha256 is that of the published file; None if there is no file
            or no sha256 to compare with.
    """

    key: str
    file_name: str
    used_for: str
    licence: str
    path: Path | None
    verified: bool | None


def describe_weights(weights_path: Path | None = None) -> list[WeightStatus]:
    """Look for all files of weights, without downloading any."""
    return [_status(key, weights_path) for key in WEIGHT_FILES]


def _status(key: str, weights_path: Path | None) -> WeightStatus:
    published = WEIGHT_FILES[key]
    path = _find(key, weights_path)
    verified = None
    if path is not None and published.sha256:
        verified = file_sha256(path) == published.sha256
    return WeightStatus(
        key, published.file_name, published.used_for, published.licence, path, verified
    )


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def load_state_dict(path: Path) -> dict[str, Any]:
    """Read the parameters of a network; objects that would run code are not loaded.

    Returns:
        What the file holds by name, in general tensors on the CPU. Of a checkpoint with an
        entry ``state_dict`` only that.

    Raises:
        WeightsError: when the file cannot be read or holds other things.
    """
    import torch

    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise WeightsError(f"{path}: cannot be read ({error.strerror})") from error
    except pickle.UnpicklingError as error:
        raise WeightsError(
            f"{path}: not a file of weights, or one with objects inside that are not loaded"
        ) from error
    except UNREADABLE as error:
        raise WeightsError(f"{path}: damaged or not a file of weights") from error
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    if not isinstance(content, Mapping):
        raise WeightsError(f"{path}: holds no parameters by name")
    return dict(content)


UNREADABLE = (
    RuntimeError, EOFError, ValueError, TypeError, LookupError, AttributeError, ImportError,
    AssertionError, NotImplementedError,
)  # fmt: skip
"""What ``torch.load`` raises on damaged files of its several formats."""


def cache_folder() -> Path:
    """Return the folder where torch keeps downloaded weights, without loading torch for that.

    As ``torch.hub.get_dir`` says, but for a folder set within the process.
    """
    home = os.environ.get("TORCH_HOME")
    if home is None:
        home = str(Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "torch")
    return Path(home).expanduser() / "hub" / "checkpoints"


def download_urls(key: str) -> tuple[str, ...]:
    """Return the addresses of a file, best first: those of kornia's own tables.

    ``hardtfeat`` is not in kornia; its address is a fixed commit of the AffNet author's
    repository.
    """
    from kornia.feature import (
        affine_shape,
        hardnet,
        hynet,
        keynet,
        mkd,
        orientation,
        sosnet,
        tfeat,
    )

    urls: dict[str, str | list[str]] = {
        "affnet": affine_shape.urls["affnet"],
        "orinet": orientation.urls["orinet"],
        "hardnet": hardnet.urls["liberty_aug"],
        "hardnet8": hardnet.urls["hardnet8v2"],
        "hynet": hynet.urls["liberty"],
        "sosnet": sosnet.urls["lib"],
        "tfeat": tfeat.urls["liberty"],
        "mkd": mkd.urls["concat"],
        "hardtfeat": (
            "https://github.com/ducha-aiki/affnet/raw/"
            "789419aa70cc4419284a23463db2be214f143c74/HardTFeat.pth"
        ),
        "keynet": keynet.KeyNet_URL,
    }
    found = urls[key]
    return (found,) if isinstance(found, str) else tuple(found)


def _folders(weights_path: Path | None) -> Iterator[Path]:
    if weights_path is not None:
        yield weights_path
    if folder := os.environ.get(ENVIRONMENT_VARIABLE):
        yield Path(folder).expanduser()
    yield cache_folder()


def _find(key: str, weights_path: Path | None) -> Path | None:
    paths = (folder / WEIGHT_FILES[key].file_name for folder in _folders(weights_path))
    return next((path for path in paths if path.is_file()), None)


def _missing_error(
    missing: Sequence[str], weights_path: Path | None, reason: str, recipes: Sequence[str]
) -> WeightsError:
    names = ", ".join(WEIGHT_FILES[key].file_name for key in missing)
    given = weights_path or "not given"
    variable = os.environ.get(ENVIRONMENT_VARIABLE) or "not set"
    return WeightsError(
        f"weights not found: {names}; looked in --weights ({given}), {ENVIRONMENT_VARIABLE} "
        f"({variable}) and {cache_folder()}; {reason}; put the files into one of these folders, "
        f"or use a recipe that needs no weights: {', '.join(recipes)}"
    )


def _download(key: str, folder: Path, progress: Progress) -> Path:
    """Download a file from the first of its addresses that has it."""
    published = WEIGHT_FILES[key]
    target = folder / published.file_name
    failures = []
    for url in download_urls(key):
        try:
            _download_url(url, target, published.sha256, progress)
        except (OSError, HTTPException, WeightsError) as error:
            failures.append(f"{url}: {getattr(error, 'reason', error)}")
        else:
            return target
    raise WeightsError(f"download of {published.file_name} failed ({'; '.join(failures)})")


def _download_url(url: str, target: Path, sha256: str, progress: Progress) -> None:
    """Download to a temporary name, check, rename: ``target`` is whole or not there."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".download-") as temporary:
        partial = Path(temporary) / target.name
        request = Request(url, headers={"User-Agent": "colmap-affrect"})  # noqa: S310
        with urlopen(request, timeout=TIMEOUT_S) as response, partial.open("wb") as file:  # noqa: S310
            size = int(response.headers.get("Content-Length") or 0)
            with progress.stage(target.name, size, "bytes") as advance:
                while chunk := response.read(CHUNK_BYTES):
                    file.write(chunk)
                    advance(len(chunk))
        if size and partial.stat().st_size != size:
            raise WeightsError(f"the file ended after {partial.stat().st_size} of {size} bytes")
        if sha256 and file_sha256(partial) != sha256:
            raise WeightsError("not the file that was published (sha256 differs)")
        partial.replace(target)
