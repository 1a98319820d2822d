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
import json
import shlex
import shutil
import stat
import sys
import tempfile
import urllib.parse
import urllib.request
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from downloads import BLOCK, FetchError, alone_in, download, end_on_signals, ensure_space, interrupted, sha256

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
# File in every complete scene: {file in the data set: its size}.
MARKER = ".fetched.json"
# Suffix of files while they are being unpacked.
UNPACKING = ".fetch-captures-"


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
