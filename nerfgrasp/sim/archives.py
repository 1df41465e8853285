"""Archives from elsewhere: fetched once, checked, and unpacked so that nothing lands outside."""

import hashlib
import logging
import shutil
import tarfile
import zipfile
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

import pooch
import requests

from nerfgrasp.errors import UserError
from nerfgrasp.files import make_folder

SUFFIXES = (".tgz", ".tar.gz", ".tar", ".zip")
"""Of archives that are unpacked."""
RETRIES = 2
"""Of a download that broke off."""
TIMEOUT = 60.0
"""Seconds without an answer."""


def is_url(source: str) -> bool:
    """Returns whether a source is to be fetched."""
    return source.startswith(("http://", "https://"))


def fetch(url: str, folder: Path, sha256: str | None = None) -> Path:
    """Fetches a file into `folder`, unless it lies there, and returns it.

    A file that was fetched half is fetched anew: only whole ones get their name.

    Args:
        url: http or https.
        folder: where files are kept.
        sha256: what the file's checksum must be; one that lies there with another is fetched again.

    Raises:
        UserError: it cannot be had, or its checksum is another.
    """
    # Two sites may give two files one name.
    name = f"{hashlib.sha256(url.encode()).hexdigest()[:8]}-{PurePosixPath(unquote(urlsplit(url).path)).name}"
    known = None if sha256 is None else f"sha256:{sha256.lower()}"
    make_folder(folder)
    pooch.get_logger().setLevel(logging.WARNING)
    keeper = pooch.create(folder, base_url="", registry={name: known}, urls={name: url}, retry_if_failed=RETRIES)
    try:
        return Path(keeper.fetch(name, downloader=pooch.HTTPDownloader(progressbar=True, timeout=TIMEOUT)))
    except requests.RequestException as error:
        raise UserError(f"cannot fetch {url}: {error}") from error
    except ValueError as error:
        raise UserError(f"{url} has another checksum than --sha256 says: {error}") from error


def check_sha256(file: Path, sha256: str | None) -> None:
    """Raises a UserError where a file's checksum is not `sha256`."""
    if sha256 is not None and (found := pooch.file_hash(str(file), alg="sha256")) != sha256.lower():
        raise UserError(f"{file} has the checksum {found}, and --sha256 says {sha256}")


def unpack(archive: Path, folder: Path) -> None:
    """Unpacks an archive into `folder`.

    Raises:
        UserError: it is none, it is damaged, or something in it would land outside of `folder`.
    """
    if not archive.name.lower().endswith(SUFFIXES):
        raise UserError(f"{archive}: not an archive ({', '.join(SUFFIXES)})")
    try:
        if archive.name.lower().endswith(".zip"):
            _unpack_zip(archive, folder)
        else:
            _unpack_tar(archive, folder)
    except (tarfile.TarError, zipfile.BadZipFile, EOFError, OSError) as error:
        raise UserError(f"{archive}: the archive is damaged or cannot be unpacked ({error})") from error


def _unpack_zip(archive: Path, folder: Path) -> None:
    with zipfile.ZipFile(archive) as file:
        for name in file.namelist():
            _check_inside(archive, name)
        file.extractall(folder)


def _unpack_tar(archive: Path, folder: Path) -> None:
    # Not by extractall and its filter, which Python 3.11 has from 3.11.4 on only.
    with tarfile.open(archive) as tar:
        for member in tar:
            _check_inside(archive, member.name)
            if member.isdir():
                continue
            content = tar.extractfile(member) if member.isfile() else None
            if content is None:
                raise UserError(f"{archive}: refused, {member.name!r} is neither a file nor a folder")
            path = folder / member.name
            path.parent.mkdir(parents=True, exist_ok=True)
            with content, path.open("wb") as file:
                shutil.copyfileobj(content, file)


def _check_inside(archive: Path, name: str) -> None:
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts:
        raise UserError(f"{archive}: refused, something in it would land outside: {name!r}")
