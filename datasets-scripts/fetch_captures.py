"""Downloads the public captures used in papers, checks them and unpacks them. Standard library only.

    python3 fetch_captures.py mipnerf360 ../captures          # nine scenes, about 13 GB
    python3 fetch_captures.py tandt_db ../captures            # Tanks and Temples' truck and train, Deep Blending, 650 MB
    python3 fetch_captures.py tandt ../captures               # Tanks and Temples: truck, train and six larger ones, 9 GB
    python3 fetch_captures.py tandt ../captures --scenes Barn,Ignatius   # two of the six, and truck and train in any case
    python3 fetch_captures.py nerf_synthetic ../captures      # eight rendered objects with alpha and their own test views

Prints where the licences are, asks for the sizes of all archives, and stops if the disk is too small. An interrupted
download is resumed, and a dropped one is retried three times. Published checksums are compared; otherwise the first
complete download is recorded in archives/SHA256SUMS (readable by `sha256sum -c`) if all files in it are intact, and
later ones must match. Each complete scene has a list of its files, .fetched.json: archives of such scenes can be
deleted, and are not downloaded again. Neither are scenes that earlier versions, which made no such lists, unpacked and
entered in scenes.json: a note names them.
Mip-NeRF 360 is complete for both protocols of `centaur bench`: full pictures (b) and images_2, images_4, images_8 (a).
scenes.json lists the scenes' folders and training flags, for `centaur bench` on the whole folder or on its --scenes.
"""

import argparse
import contextlib
import errno
import hashlib
import http.client
import json
import re
import shlex
import shutil
import signal
import socket
import ssl
import stat
import sys
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

GOOGLE = "https://storage.googleapis.com/gresearch/refraw360/"
INRIA = "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/"
# The copies that GOF and NerfBaselines evaluate on; NeRF's authors distribute theirs only through Google Drive.
GOF = "https://huggingface.co/datasets/ZehaoYu/gaussian-opacity-fields/resolve/main/"
NERFBASELINES = "https://huggingface.co/datasets/nerfbaselines/nerfbaselines-data/resolve/main/blender/"
OUTDOOR, INDOOR = ("bicycle", "flowers", "garden", "stump", "treehill"), ("room", "counter", "kitchen", "bonsai")
# The scenes that were published later, in a separate archive.
EXTRA = {"flowers", "treehill"}
SYNTHETIC = ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")
TRUCK_AND_TRAIN = ("tandt/truck", "tandt/train")
OF_GOF = tuple(f"TNT_GOF/TrainingSet/{s}" for s in ("Barn", "Caterpillar", "Courthouse", "Ignatius", "Meetingroom", "Truck"))
TANKS = "Tanks and Temples: for research that is not commercial, https://www.tanksandtemples.org/license/"


@dataclass(frozen=True)
class Collection:
    """Addresses and contents of archives, and how published tables use them."""

    archives: list
    licence: str
    # Folder of each scene and its flags for `centaur train`.
    scenes: dict
    # Scenes of each archive, if there are several.
    scenes_in: dict = field(default_factory=dict)
    # Scenes that are always fetched, whichever are chosen.
    always: tuple = ()
    # SHA-256 of archives, if known.
    sums: dict = field(default_factory=dict)
    # Arguments of `centaur bench` that replace the scenes' flags, and a remark to print.
    bench: str = ""
    # Scenes whose means are compared with published rows when those of all scenes are not, with the name of their
    # table.
    tables: dict = field(default_factory=dict)
    remark: str = ""


# Outdoor scenes at 1/4, indoor ones at 1/2, Tanks and Temples unscaled, GOF's larger pictures at 1/2.
CAPTURES = {
    "mipnerf360": Collection(
        [GOOGLE + "360_v2.zip", GOOGLE + "360_extra_scenes.zip"],
        "Mip-NeRF 360: the archives state none; see https://jonbarron.info/mipnerf360/",
        {s: "--downscale 4" for s in OUTDOOR} | {s: "--downscale 2" for s in INDOOR},
        scenes_in={"360_v2.zip": {*OUTDOOR, *INDOOR} - EXTRA, "360_extra_scenes.zip": EXTRA},
        bench="--protocol b",
        remark="protocol b scales the full pictures down, as Mip-Splatting and HERA; --protocol a takes images_4 and images_2, as INRIA",
    ),
    "tandt_db": Collection(
        [INRIA + "tandt_db.zip"],
        TANKS + "; Deep Blending: see https://github.com/Phog/DeepBlending",
        dict.fromkeys((*TRUCK_AND_TRAIN, "db/drjohnson", "db/playroom"), ""),
        tables={"truck-and-train": ("truck", "train"), "db": ("drjohnson", "playroom")},
    ),
    "tandt": Collection(
        [INRIA + "tandt_db.zip", GOF + "TNT_GOF.zip"],
        TANKS,
        dict.fromkeys(TRUCK_AND_TRAIN, "") | dict.fromkeys(OF_GOF, "--downscale 2"),
        scenes_in={"tandt_db.zip": set(TRUCK_AND_TRAIN), "TNT_GOF.zip": set(OF_GOF)},
        always=TRUCK_AND_TRAIN,
        sums={"TNT_GOF.zip": "772c034d40c1a1332757a7d2b10b91d56ede3e82930c74537278ca09940928ba"},
        tables={"truck-and-train": ("truck", "train"), "five": ("Barn", "Caterpillar", "Ignatius", "truck", "train")},
        remark="HERA does not name its five scenes, which may be others; Truck-larger is GOF's",
    ),
    "nerf_synthetic": Collection(
        [f"{NERFBASELINES}{s}.zip" for s in SYNTHETIC],
        "NeRF-synthetic, rendered from models of Blend Swap: chair, ficus, hotdog, materials, mic CC0; drums CC BY; lego CC BY-NC; ship CC BY-SA",
        {s: "--background white" for s in SYNTHETIC},
        scenes_in={f"{s}.zip": {s} for s in SYNTHETIC},
        remark="the test views are those of transforms_test.json; published scores are over white",
    ),
}
BLOCK = 1 << 20
# Attempts at a download whose connection is dropped, and the seconds between them.
ATTEMPTS, PAUSE = 3, 5
# File in every complete scene: {file in the data set: its size}.
MARKER = ".fetched.json"
# Suffix of files while they are being unpacked.
UNPACKING = ".fetch-captures-"


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


def recorded(archives):
    """{archive: checksum} from SHA256SUMS in the folder."""
    sums = archives / "SHA256SUMS"
    lines = (line.split(maxsplit=1) for line in sums.read_text().splitlines()) if sums.exists() else ()
    return {line[1]: line[0] for line in lines if len(line) == 2}


def verify(archive, published=None):
    """Compares with the published checksum, then with SHA256SUMS beside the archive; returns the line to record if it
    has none."""
    found, sums = sha256(archive), archive.parent / "SHA256SUMS"
    if published not in (None, found):
        raise FetchError(f"{archive}: SHA-256 is {found}, its publisher says {published}; delete it and run again")
    known = recorded(archive.parent)
    if known.get(archive.name, found) != found:
        advice = "delete it and run again, and its line there if it has been published anew"
        raise FetchError(f"{archive}: SHA-256 is {found}, {sums} says {known[archive.name]}; {advice}")
    return None if archive.name in known else f"{found}  {archive.name}\n"


def crc32(file):
    crc = 0
    with file.open("rb") as source:
        while block := source.read(BLOCK):
            crc = zlib.crc32(block, crc)
    return crc


def lies(path, size):
    return path.is_file() and path.stat().st_size == size


def unpack(archive, folder, wanted=lambda path: True, is_whole=True):
    """Extracts the wanted regular files into folder; refuses the whole archive if an entry would be outside. Returns
    {file: size}.

    Unless the archive is known to be intact (`is_whole`), all of it is read, including files that are not wanted or
    exist with the same size, since only then all of its checksums are compared.
    """
    with zipfile.ZipFile(archive) as source:
        entries = [e for e in source.infolist() if not e.is_dir()]
        for e in entries:
            path = PurePosixPath(e.filename)
            if path.is_absolute() or ".." in path.parts or "\\" in e.filename or ":" in e.filename:
                raise FetchError(f"{archive}: entry {e.filename!r} leaves the folder")
            if stat.S_IFMT(e.external_attr >> 16) not in (0, stat.S_IFREG):
                raise FetchError(f"{archive}: entry {e.filename!r} is not a regular file")
        entries = [e for e in entries if wanted(PurePosixPath(e.filename)) and not e.filename.startswith("__MACOSX/")]
        size, free = sum(e.file_size for e in entries if not lies(folder / e.filename, e.file_size)), shutil.disk_usage(folder).free
        if size > free:
            raise FetchError(f"{archive}: needs {size / 1e9:.1f} GB, {folder} has {free / 1e9:.1f} GB free")
        root, unread = folder.resolve(), set() if is_whole else {e for e in source.infolist() if not e.is_dir()}
        for e in entries:
            target = folder / e.filename
            if not target.parent.resolve().is_relative_to(root):  # a link that was there before
                raise FetchError(f"{target}: leads out of {folder}")
            target.parent.mkdir(parents=True, exist_ok=True)
            if lies(target, e.file_size) and (is_whole or crc32(target) == e.CRC):
                continue
            unread.discard(e)
            extract(source, e, target)
        for e in source.infolist():
            if e in unread:
                with source.open(e) as packed:
                    while packed.read(BLOCK):
                        pass
        return {e.filename: e.file_size for e in entries}


def extract(source, entry, target):
    """Extracts a file of an archive, under another name until it is complete."""
    out = tempfile.NamedTemporaryFile(dir=target.parent, prefix=UNPACKING, delete=False)
    try:
        with out, source.open(entry) as packed:
            shutil.copyfileobj(packed, out, BLOCK)
        Path(out.name).chmod(0o644)
        Path(out.name).replace(target)
    except BaseException:
        Path(out.name).unlink(missing_ok=True)
        raise


def sweep(folder):
    """Removes files left half unpacked by a killed run."""
    for file in folder.rglob(f"{UNPACKING}*"):
        file.unlink(missing_ok=True)


def mark(scenes, folder, files):
    """Records for each of these scenes in `folder` its files, {file: size}."""
    for scene in scenes:
        of_scene = {file: size for file, size in files.items() if PurePosixPath(file).is_relative_to(scene)}
        if of_scene:
            part = folder / scene / f"{MARKER}.part"
            part.write_text(json.dumps(of_scene, indent=0) + "\n")
            part.replace(folder / scene / MARKER)


def is_fetched(scene, folder):
    """Whether a scene was unpacked completely, and all its files exist."""
    try:
        files = json.loads((folder / scene / MARKER).read_text())
        return all(lies(folder / file, size) for file, size in files.items()) and is_captured(folder / scene)
    except (OSError, ValueError, AttributeError):  # no list, or one of another program
        return False


def listed(folder):
    """Folders of the scenes in the scenes.json of an earlier run."""
    try:
        return {scene["capture"] for scene in json.loads((folder / "scenes.json").read_text())["scenes"].values()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError):  # none, or one of another program
        return set()


def is_unverified(scene, folder):
    """Whether a scene was unpacked by a version of this program that made no lists of files: it may lack some."""
    return not (folder / scene / MARKER).exists() and scene in listed(folder) and is_captured(folder / scene)


def is_there(scene, folder):
    return is_fetched(scene, folder) or is_unverified(scene, folder)


def chosen(collection, names):
    """Folders of the scenes with these names or folder names, plus those always fetched; all if no names are given. An
    error lists the existing names."""
    known = {scene: {name, PurePosixPath(scene).name} for scene, name in scene_names(collection).items()}
    for name in names or ():
        if not any(name in of_scene for of_scene in known.values()):
            raise FetchError(f"--scenes: expected {', '.join(scene_names(collection).values())}, found {name or 'nothing'}")
    return [scene for scene, of_scene in known.items() if not names or of_scene & set(names) or scene in collection.always]


def holds(collection, file):
    """Whether an archive of this name belongs to the collection."""
    return any(url.endswith("/" + file) for url in collection.archives)


def scene_names(collection):
    """{scene: its name in tables}, where names differ in more than case."""
    short = {s: PurePosixPath(s).name for s in collection.scenes}
    lower = [name.lower() for name in short.values()]
    return {s: f"{name}-larger" if lower.count(name.lower()) > 1 and s in OF_GOF else name for s, name in short.items()}


def list_scenes(collection, folder):
    """Writes folder/scenes.json, with which `centaur bench` finds scenes and their training flags."""
    names, scenes = scene_names(collection), {}
    for scene, flags in collection.scenes.items():
        if is_there(scene, folder):
            # If a flag of `centaur bench` selects the pictures, they are not selected here.
            scenes[names[scene]] = {"capture": scene, "flags": [] if collection.bench else flags.split()}
    part = folder / "scenes.json.part"
    part.write_text(json.dumps({"scenes": scenes}, indent=2) + "\n")
    part.replace(folder / "scenes.json")


def is_captured(folder):
    views = [folder / f"transforms_{part}.json" for part in ("train", "test")]
    return (folder / "sparse/0").is_dir() or all(file.is_file() for file in views)


def fetch(name, folder, mirror=None, names=None):
    """Downloads, verifies and unpacks one collection, or the named scenes of it, into folder/name."""
    collection = CAPTURES[name]
    scenes = chosen(collection, names)
    if mirror is not None:
        ensure_address(mirror)
    print(f"Licence. {collection.licence}", flush=True)  # before the download, whichever way it ends
    archives, scenes_folder = folder / "archives", folder / name
    archives.mkdir(parents=True, exist_ok=True)
    scenes_folder.mkdir(parents=True, exist_ok=True)
    with alone_in(archives):
        sweep(scenes_folder)
        urls = {}
        for url in collection.archives:
            file = url.rsplit("/", 1)[1]
            of_archive = collection.scenes_in.get(file, set(scenes)) & set(scenes)
            # An existing archive is checked again, which needs no download.
            if any((archives / file).exists() or not is_there(scene, scenes_folder) for scene in of_archive):
                urls[archives / file] = url if mirror is None else f"{mirror.rstrip('/')}/{file}"
        get(collection, scenes, urls, scenes_folder)
    say_commands(name, scenes, scenes_folder)
    if kept := sum(file.stat().st_size for file in archives.glob("*.zip")):
        print(f"{archives} takes {kept / 1e9:.1f} GB; its archives can be deleted, and are not needed again for what is unpacked.")


def get(collection, scenes, urls, scenes_folder):
    """Downloads, verifies and unpacks the scenes of {archive: address} into their folder."""
    ensure_space(scenes_folder.parent, urls, len(scenes) == len(collection.scenes))
    for archive, url in urls.items():
        if not archive.exists():
            download(url, archive, archive.name in {**collection.sums, **recorded(archive.parent)})
        if not zipfile.is_zipfile(archive):
            raise FetchError(f"{archive}: not a zip file; delete it and run again")
        record = verify(archive, collection.sums.get(archive.name))
        # Content for other collections is left in the archive.
        others = [PurePosixPath(s) for c in CAPTURES.values() if holds(c, archive.name) for s in c.scenes if s not in scenes]
        try:
            is_whole = record is None or archive.name in collection.sums
            files = unpack(archive, scenes_folder, lambda path: not any(path.is_relative_to(s) for s in others), is_whole)
            mark(scenes, scenes_folder, files)
        except OSError as error:
            raise FetchError(f"{archive}: {error}") from error
        # A damaged archive, an encrypted one, or one with an unknown compression.
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
            raise FetchError(f"{archive}: {error}; delete it and run again") from error
        if record:  # recorded once the archive is known to be intact
            with (archive.parent / "SHA256SUMS").open("a") as out:
                out.write(record)


def say_commands(name, scenes, scenes_folder):
    """Prints how to train the existing scenes, and lists them for `centaur bench`."""
    collection = CAPTURES[name]
    short = scene_names(collection)
    found = [s for s in scenes if is_there(s, scenes_folder)]
    for scene in found:
        flags = f" {collection.scenes[scene]}" if collection.scenes[scene] else ""
        print(f"centaur train {shlex.quote(str(scenes_folder / scene))}{flags} -o {short[scene]}.glb")
    if found:
        list_scenes(collection, scenes_folder)
        bench = f"centaur bench {shlex.quote(str(scenes_folder))}"
        print(f"{bench} -o {shlex.quote(f'out/{name}')} {collection.bench}".rstrip())
        for table, of in collection.tables.items():
            if set(of) <= {short[s] for s in found}:
                print(f"{bench} --scenes {','.join(of)} -o out/{table}")
    if collection.remark:
        print(f"Note: {collection.remark}.")
    if unverified := [s for s in collection.scenes if is_unverified(s, scenes_folder)]:
        advice = f"to download and compare them, delete {scenes_folder / 'scenes.json'} and run again"
        print(f"Note: not verified, because an earlier version of this program unpacked them: {', '.join(unverified)}; {advice}.")
    if len(found) < len(scenes):
        missing = ", ".join(s for s in scenes if s not in found)
        raise FetchError(f"{scenes_folder}: expected a capture in each of {len(scenes)} folders, found none in {missing}: archives are laid out otherwise")


def ensure_address(mirror):
    try:
        urllib.parse.urlsplit(urllib.request.Request(mirror).full_url)
    except ValueError as error:
        raise FetchError(f"--mirror: expected an address such as https://host/folder, found {mirror or 'nothing'}") from error


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


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=CAPTURES)
    parser.add_argument("folder", type=Path, help="output folder, for archives/ and the scenes")
    parser.add_argument(
        "--scenes",
        metavar="NAMES",
        help="unpack only these scenes, comma separated, and download no other archives; for tandt, truck and train are always included [default: all]",
    )
    parser.add_argument("--mirror", help="address of a folder with the same archives")
    args = parser.parse_args(arguments)
    # An empty shell variable is not meant to select all scenes.
    names = None if args.scenes is None else [name.strip() for name in args.scenes.split(",")]
    try:
        fetch(args.name, args.folder, args.mirror, names)
    except (FetchError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        interrupted()


if __name__ == "__main__":
    end_on_signals()
    main()
