"""Downloads of files: resumed, tried again, never of two versions in one, and only where there is room for them."""

import contextlib
import errno
import hashlib
import http.client
import re
import shutil
import signal
import socket
import ssl
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

BLOCK = 1 << 20
# Attempts at a download whose connection is dropped, and the seconds between them.
ATTEMPTS, PAUSE = 3, 5


class FetchError(Exception):
    """An error with a one-line message for the user."""


class DroppedError(Exception):
    """Reason of a dropped connection that may last longer in another attempt."""


@contextlib.contextmanager
def alone_in(folder, name=".lock"):
    """Locks a folder of archives with a file of this name, since two runs would write into the same parts."""
    with (folder / name).open("w") as lock:
        try:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FetchError(f"{folder}: another run is fetching into it") from error
        except OSError:  # file systems without locks
            pass
        yield


@contextlib.contextmanager
def locally(file):
    """Marks errors with local files, which are unrelated to the connection."""
    try:
        yield
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
        advice = "; with more room the same command goes on" if is_full else ""
        raise FetchError(f"{file}: {error.strerror or error}{advice}") from error


@contextlib.contextmanager
def connected(url):
    """Converts connection errors: to a DroppedError if another attempt may help."""
    try:
        yield
    except urllib.error.HTTPError as error:
        raise FetchError(f"{url}: {error}") from error
    except (OSError, ValueError, http.client.HTTPException) as error:
        why, host = getattr(error, "reason", error), urllib.parse.urlsplit(url).hostname
        if isinstance(why, socket.gaierror):
            raise FetchError(f"{host}: cannot find this host: {why.strerror}") from error
        if isinstance(why, ssl.SSLCertVerificationError):
            raise FetchError(f"{host}: its certificate is refused: {why.verify_message}") from error
        # A redirection to an invalid address, or a length that is not a number.
        if isinstance(error, (ValueError, http.client.InvalidURL)):
            raise FetchError(f"{url}: {error}") from error
        raise DroppedError(str(error) or type(error).__name__) from error


class Progress:
    """Progress of a download: a line that is updated on a terminal, otherwise a line every 5 %."""

    def __init__(self, name, done, expected):
        self.name, self.expected, self.is_terminal = name, expected, sys.stderr.isatty()
        part = 100 * BLOCK if expected is None else expected // 20
        self.step = BLOCK if self.is_terminal else max(part, BLOCK)
        self.next = done if self.is_terminal else done + self.step

    def say(self, done):
        if done < self.next and done != self.expected:
            return
        self.next = done + self.step
        of = f" of {self.expected / 1e6:.0f}" if self.expected else ""
        start, end = ("\r", "") if self.is_terminal else ("", "\n")
        print(f"{start}{self.name}: {done / 1e6:.0f}{of} MB", end=end, file=sys.stderr, flush=True)

    def end(self):
        """Ends the line, so that following output has its own."""
        if self.is_terminal:
            print(file=sys.stderr)


def version_of(headers):
    """Identifies a server's version of a file, for If-Range: a strong ETag, else the date."""
    etag = headers.get("ETag") or ""
    return etag if etag and not etag.startswith("W/") else headers.get("Last-Modified") or ""


def is_other_version(saved, headers):
    """Whether a part of version `saved` now has another version: some servers ignore If-Range."""
    found = headers.get("ETag" if saved.startswith('"') else "Last-Modified")
    return bool(saved) and found not in (None, saved)


def download(url, target, is_known=False):
    """Downloads url to target, in three attempts. Each resumes target.part if target.etag ensures that both halves
    belong to the same version of the file, or if `is_known`: the file's checksum reveals a mismatch."""
    part, tag = Path(f"{target}.part"), Path(f"{target}.etag")
    for left in reversed(range(ATTEMPTS)):
        try:
            return attempt(url, target, is_known)
        except DroppedError as error:
            if not left:
                goes_on = part.exists() and (tag.exists() or is_known)
                raise FetchError(f"{url}: {error}; run again{' to resume' if goes_on else ''}") from error
            print(f"{url}: {error}; another attempt in {PAUSE} s", file=sys.stderr)
            time.sleep(PAUSE)


def attempt(url, target, is_known, resumes=True):
    """Makes one request for the rest of target.part, or for the whole file."""
    part, tag = Path(f"{target}.part"), Path(f"{target}.etag")
    with locally(part):
        saved = tag.read_text() if tag.exists() else ""
        have = part.stat().st_size if resumes and part.exists() and (saved or is_known) else 0
    headers = {}
    if have:
        headers["Range"] = f"bytes={have}-"
        if saved:
            headers["If-Range"] = saved
    with connected(url):
        try:
            reply = urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60)
        except urllib.error.HTTPError as error:
            if error.code != 416 or not have:
                raise
            if error.headers.get("Content-Range") != f"bytes */{have}":  # the part does not belong to the server's present file
                return attempt(url, target, is_known, resumes=False)
            finish(part, target, tag)  # the file is complete and only has to be renamed
            return
        with reply:
            is_rest = reply.status == 206
            start, expected = extent(reply, have)
            if is_rest and (not have or start != have or is_other_version(saved, reply.headers)):
                reply.close()
                if not resumes:
                    raise FetchError(f"{url}: expected the whole file, found a part of it")
                return attempt(url, target, is_known, resumes=False)
            # Unbuffered, so that a write error is known at once, and at which byte. The part is opened before the tag
            # is written, so that no tag is ever beside a part of another version.
            with locally(part):
                out = part.open("ab" if is_rest else "wb", buffering=0)
            with out:
                version = version_of(reply.headers)
                with locally(tag):
                    # Servers need not repeat it for the rest of a file.
                    if version or not is_rest:
                        tag.write_text(version) if version else tag.unlink(missing_ok=True)
                done = receive(reply, out, part, start, expected)
    if expected is not None and done != expected:
        raise DroppedError(f"connection ended at {done} of {expected} bytes")
    finish(part, target, tag)


def extent(reply, have):
    """Start of the data that a server sends (None if unclear), and size of the whole file, or None if the server does
    not state it. For a part of the file the size is stated even without the length of that part."""
    length = reply.headers.get("Content-Length")
    if reply.status != 206:
        return 0, None if length is None else int(length)
    found = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", reply.headers.get("Content-Range", ""))
    if found is None:
        return None, None
    if found[2] != "*":
        return int(found[1]), int(found[2])
    return int(found[1]), None if length is None else have + int(length)


def receive(reply, out, part, done, expected):
    """Writes data after the first `done` bytes of the part; returns the part's new length."""
    progress = Progress(part.name.removesuffix(".part"), done, expected)
    try:
        while block := reply.read(BLOCK):
            rest = memoryview(block)
            with locally(part):
                while rest:
                    rest = rest[out.write(rest) :]
            done += len(block)
            progress.say(done)
    finally:
        progress.end()
    return done


def finish(part, target, tag):
    with locally(part):
        part.replace(target)
        tag.unlink(missing_ok=True)


def size_of(url):
    """Size of a download in bytes, or None if the server does not state it."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=60) as reply:
            length = reply.headers.get("Content-Length")
            return None if length is None else int(length)
    except (OSError, ValueError, http.client.HTTPException):  # some servers refuse HEAD; the download itself reports errors
        return None


def ensure_space(folder, urls, all_scenes=True):
    """Stops unless the rest of the archives fits on the disk, and as much again if all scenes are wanted, since
    photographs do not compress. The size of a selection is known only once an archive is there."""
    missing = 0
    for archive, url in urls.items():
        part = Path(f"{archive}.part")
        if not archive.exists() and (size := size_of(url)) is not None:
            missing += (2 if all_scenes else 1) * size - (part.stat().st_size if part.exists() else 0)
    free = shutil.disk_usage(folder).free
    if missing > free:
        for_what = "archives and what is in them" if all_scenes else "archives"
        raise FetchError(f"{folder}: needs {missing / 1e9:.1f} GB for {for_what}, has {free / 1e9:.1f} GB free")


def sha256(file):
    digest = hashlib.sha256()
    with file.open("rb") as source:
        while block := source.read(BLOCK):
            digest.update(block)
    return digest.hexdigest()


def end_on_signals():
    """Lets signals of schedulers and closed terminals end the program as Ctrl-C does, leaving no half-written files,
    except signals ignored by `nohup`."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)


def interrupted():
    print("error: stopped; the same command goes on", file=sys.stderr)
    sys.exit(130)
