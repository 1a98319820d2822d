"""Downloads the public captures that papers report on, checks them and unpacks them. Standard library only.

    python3 fetch_captures.py mipnerf360 ../captures          # nine scenes, about 13 GB
    python3 fetch_captures.py tandt_db ../captures            # Tanks and Temples' truck and train, Deep Blending, 650 MB
    python3 fetch_captures.py tandt ../captures               # Tanks and Temples: truck, train and six larger ones, 9 GB
    python3 fetch_captures.py tandt ../captures --scenes Barn,Ignatius   # two of the six, and truck and train in any case
    python3 fetch_captures.py nerf_synthetic ../captures      # eight rendered objects with alpha and their own test views

Shows where the licences stand, asks for the sizes of all archives and stops where the disk is too small. An interrupted
download goes on where it stopped. Checksums that publishers give are compared; of the others the first complete download
is recorded in ARCHIVES/SHA256SUMS (readable by `sha256sum -c`) when all files in it are whole, and later ones must match.
Everything of Mip-NeRF 360 is there for both protocols of `centaur bench`: the full pictures (b) and images_2, images_4, images_8
(a). scenes.json says where scenes are and with which flags they are trained, for `centaur bench` of the whole folder or of its
--scenes.
"""

import argparse
import contextlib
import hashlib
import http.client
import json
import shlex
import shutil
import signal
import stat
import sys
import tempfile
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
# The copies that GOF and NerfBaselines evaluate on; NeRF's authors give theirs out through Google Drive only.
GOF = "https://huggingface.co/datasets/ZehaoYu/gaussian-opacity-fields/resolve/main/"
NERFBASELINES = "https://huggingface.co/datasets/nerfbaselines/nerfbaselines-data/resolve/main/blender/"
OUTDOOR, INDOOR = ("bicycle", "flowers", "garden", "stump", "treehill"), ("room", "counter", "kitchen", "bonsai")
# Of these, the scenes that came later, in an archive of their own.
EXTRA = {"flowers", "treehill"}
SYNTHETIC = ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship")
TRUCK_AND_TRAIN = ("tandt/truck", "tandt/train")
OF_GOF = tuple(f"TNT_GOF/TrainingSet/{s}" for s in ("Barn", "Caterpillar", "Courthouse", "Ignatius", "Meetingroom", "Truck"))
TANKS = "Tanks and Temples: for research that is not commercial, https://www.tanksandtemples.org/license/"


@dataclass(frozen=True)
class Collection:
    """Where archives are, what lies in them, and how published tables use it."""

    archives: list
    licence: str
    # Folder of every scene and the flags of `centaur train` for it.
    scenes: dict
    # Scenes of every archive, where there are several.
    scenes_in: dict = field(default_factory=dict)
    # Scenes that are fetched whichever are chosen.
    always: tuple = ()
    # SHA-256 of archives, where known.
    sums: dict = field(default_factory=dict)
    # What `centaur bench` needs in place of the flags of the scenes, and a word to say.
    bench: str = ""
    # Names of scenes whose means stand beside published rows where those of all do not, with the name of their table.
    tables: dict = field(default_factory=dict)
    remark: str = ""


# Outdoor scenes at 1/4, indoor ones at 1/2, Tanks and Temples as they come, GOF's larger pictures at 1/2.
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


class FetchError(Exception):
    """One line for the user."""


@contextlib.contextmanager
def alone_in(folder):
    """Holds a folder of archives, into whose parts two runs would both write."""
    with (folder / ".lock").open("w") as lock:
        try:
            if fcntl is not None:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FetchError(f"{folder}: another run is fetching into it") from error
        except OSError:  # file systems without locks
            pass
        yield


def download(url, target):
    """Fetches url to target; resumes target.part, whose ETag ensures that both halves are of one file."""
    part, tag = Path(f"{target}.part"), Path(f"{target}.etag")
    have = part.stat().st_size if part.exists() and tag.exists() else 0
    headers = {"Range": f"bytes={have}-", "If-Range": tag.read_text()} if have else {}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60) as reply:
            resumed = reply.status == 206
            if resumed and not reply.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
                raise FetchError(f"{url}: expected bytes from {have}, got {reply.headers.get('Content-Range')}")
            length = reply.headers.get("Content-Length")
            expected = None if length is None else int(length) + (have if resumed else 0)
            etag = reply.headers.get("ETag")
            tag.write_text(etag) if etag and not etag.startswith("W/") else tag.unlink(missing_ok=True)
            done = have if resumed else 0
            with part.open("ab" if resumed else "wb") as out:
                try:
                    while block := reply.read(BLOCK):
                        out.write(block)
                        done += len(block)
                        of = f" of {expected / 1e6:.0f}" if expected else ""
                        print(f"\r{target.name}: {done / 1e6:.0f}{of} MB", end="", file=sys.stderr)
                finally:  # what went wrong is said in a line of its own
                    print(file=sys.stderr)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:
            if error.headers.get("Content-Range") == f"bytes */{have}":  # nothing is missing but its name
                part.rename(target)
                return tag.unlink()
            part.unlink()  # longer than the file: not ours to complete
            return download(url, target)
        raise FetchError(f"{url}: {error}") from error
    except (ValueError, http.client.InvalidURL) as error:  # a redirection to what is no address, a length that is no number
        raise FetchError(f"{url}: {error}") from error
    except (OSError, http.client.HTTPException) as error:
        raise FetchError(f"{url}: {error or type(error).__name__}; run again to resume") from error
    if expected is not None and done != expected:
        raise FetchError(f"{url}: connection ended at {done} of {expected} bytes; run again to resume")
    part.rename(target)
    tag.unlink(missing_ok=True)


def size_of(url):
    """Bytes that a download would have, or None where the server does not say."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=60) as reply:
            length = reply.headers.get("Content-Length")
            return None if length is None else int(length)
    except (OSError, ValueError, http.client.HTTPException):  # some refuse HEAD; the download itself says what is wrong
        return None


def ensure_space(folder, urls, all_scenes=True):
    """Stops unless what is missing of the archives fits on the disk, and as much again where all scenes are wanted: photographs do not
    shrink. What parts take of it is known when an archive is there."""
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


def verify(archive, published=None):
    """Compares with the published sum, then with SHA256SUMS beside the archive; returns the line to record where it has none."""
    found, sums = sha256(archive), archive.parent / "SHA256SUMS"
    if published not in (None, found):
        raise FetchError(f"{archive}: SHA-256 is {found}, its publisher says {published}; delete it and run again")
    lines = (line.split(maxsplit=1) for line in sums.read_text().splitlines()) if sums.exists() else ()
    known = {line[1]: line[0] for line in lines if len(line) == 2}
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
    """Extracts the wanted regular files below folder; refuses the whole archive if an entry would land elsewhere.

    Where nothing yet says that the archive `is_whole`, all of it is read, also what is not wanted or lies there in the same size: only then
    are all checksums in it compared.
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
            if not target.parent.resolve().is_relative_to(root):  # a link that lay there before
                raise FetchError(f"{target}: leads out of {folder}")
            target.parent.mkdir(parents=True, exist_ok=True)
            if lies(target, e.file_size) and (is_whole or crc32(target) == e.CRC):
                continue
            unread.discard(e)
            with tempfile.NamedTemporaryFile(dir=target.parent, delete=False) as out:
                try:
                    with source.open(e) as packed:
                        shutil.copyfileobj(packed, out, BLOCK)
                except BaseException:
                    Path(out.name).unlink()
                    raise
            Path(out.name).chmod(0o644)
            Path(out.name).replace(target)
        for e in source.infolist():
            if e in unread:
                with source.open(e) as packed:
                    while packed.read(BLOCK):
                        pass


def chosen(collection, names):
    """Folders of the scenes with these names and of those that come always, of all without any; an error names those that there are."""
    known = {Path(scene).name: scene for scene in collection.scenes}
    for name in names or ():
        if name not in known:
            raise FetchError(f"--scenes: expected {', '.join(known)}, found {name or 'nothing'}")
    return [scene for name, scene in known.items() if not names or name in names or scene in collection.always]


def holds(collection, file):
    """Whether an archive of this name is one of the collection's."""
    return any(url.endswith("/" + file) for url in collection.archives)


def scene_names(collection):
    """{scene: its name in tables}, of letters that differ in more than their case."""
    short = {s: PurePosixPath(s).name for s in collection.scenes}
    lower = [name.lower() for name in short.values()]
    return {s: f"{name}-larger" if lower.count(name.lower()) > 1 and s in OF_GOF else name for s, name in short.items()}


def list_scenes(collection, folder):
    """Writes folder/scenes.json, from which `centaur bench` knows where scenes are and with which flags each is trained."""
    names, scenes = scene_names(collection), {}
    for scene, flags in collection.scenes.items():
        if is_captured(folder / scene):
            # Pictures that a flag of `centaur bench` decides are not decided here.
            scenes[names[scene]] = {"capture": scene, "flags": [] if collection.bench else flags.split()}
    part = folder / "scenes.json.part"
    part.write_text(json.dumps({"scenes": scenes}, indent=2) + "\n")
    part.replace(folder / "scenes.json")


def is_captured(folder):
    return (folder / "sparse/0").is_dir() or (folder / "transforms_train.json").is_file()


def fetch(name, folder, mirror=None, names=None):
    """Downloads, verifies and unpacks one collection, or the named scenes of it, into folder/name."""
    collection = CAPTURES[name]
    scenes = chosen(collection, names)
    if mirror is not None:
        ensure_address(mirror)
    print(f"Licence. {collection.licence}", flush=True)  # before the download, wherever it goes
    archives, scenes_folder = folder / "archives", folder / name
    archives.mkdir(parents=True, exist_ok=True)
    scenes_folder.mkdir(parents=True, exist_ok=True)
    urls = {}
    for url in collection.archives:
        file = url.rsplit("/", 1)[1]
        if collection.scenes_in.get(file, set(scenes)) & set(scenes):
            urls[archives / file] = url if mirror is None else f"{mirror.rstrip('/')}/{file}"
    with alone_in(archives):
        get(collection, scenes, urls, scenes_folder)
    say_commands(name, scenes, scenes_folder)


def get(collection, scenes, urls, scenes_folder):
    """Downloads, verifies and unpacks the scenes of {archive: its address} into their folder."""
    ensure_space(scenes_folder.parent, urls, len(scenes) == len(collection.scenes))
    for archive, url in urls.items():
        if not archive.exists():
            download(url, archive)
        if not zipfile.is_zipfile(archive):
            raise FetchError(f"{archive}: not a zip file; delete it and run again")
        record = verify(archive, collection.sums.get(archive.name))
        # What the archive holds for other collections is left in it, too.
        others = [PurePosixPath(s) for c in CAPTURES.values() if holds(c, archive.name) for s in c.scenes if s not in scenes]
        try:
            is_whole = record is None or archive.name in collection.sums
            unpack(archive, scenes_folder, lambda path: not any(path.is_relative_to(s) for s in others), is_whole)
        except OSError as error:
            raise FetchError(f"{archive}: {error}") from error
        # A damaged one, an encrypted one, one of unknown compression.
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
            raise FetchError(f"{archive}: {error}; delete it and run again") from error
        if record:  # of what is known to be whole
            with (archive.parent / "SHA256SUMS").open("a") as out:
                out.write(record)


def say_commands(name, scenes, scenes_folder):
    """Prints how to train the scenes that are there, and lists them for `centaur bench`."""
    collection = CAPTURES[name]
    short = scene_names(collection)
    found = [s for s in scenes if is_captured(scenes_folder / s)]
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
    if len(found) < len(scenes):
        missing = ", ".join(s for s in scenes if s not in found)
        raise FetchError(f"{scenes_folder}: expected a capture in each of {len(scenes)} folders, found none in {missing}: archives are laid out otherwise")


def ensure_address(mirror):
    try:
        urllib.parse.urlsplit(urllib.request.Request(mirror).full_url)
    except ValueError as error:
        raise FetchError(f"--mirror: expected an address such as https://host/folder, found {mirror or 'nothing'}") from error


def interrupted():
    print("error: stopped; the same command goes on", file=sys.stderr)
    sys.exit(130)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=CAPTURES)
    parser.add_argument("folder", type=Path, help="where archives/ and the scenes go")
    parser.add_argument(
        "--scenes",
        metavar="NAMES",
        help="unpack only these, comma separated, and download no other archives; of tandt truck and train come in any case [default: all]",
    )
    parser.add_argument("--mirror", help="address of a folder that holds the same archives")
    args = parser.parse_args(arguments)
    # Of an empty variable of the shell nobody means all scenes.
    names = None if args.scenes is None else [name.strip() for name in args.scenes.split(",")]
    try:
        fetch(args.name, args.folder, args.mirror, names)
    except (FetchError, OSError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        interrupted()


if __name__ == "__main__":
    # What schedulers and lost terminals send ends it as Ctrl-C does, without leaving what is half written.
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.default_int_handler)
    main()
