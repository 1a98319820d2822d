"""Downloads the public captures that papers report on, checks them and unpacks them. Standard library only.

    python3 fetch_captures.py mipnerf360 ../captures          # nine scenes, about 13 GB
    python3 fetch_captures.py tandt_db ../captures            # truck, train, drjohnson, playroom, 650 MB

An interrupted download goes on where it stopped. The publishers give no checksums: the first complete download is
recorded in ARCHIVES/SHA256SUMS (readable by `sha256sum -c`), later ones must match it.
"""

import argparse
import hashlib
import shutil
import stat
import sys
import tempfile
import urllib.error
import urllib.request
import zipfile
from pathlib import Path, PurePosixPath

GOOGLE = "https://storage.googleapis.com/gresearch/refraw360/"
INRIA = "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/"
OUTDOOR, INDOOR = ("bicycle", "flowers", "garden", "stump", "treehill"), ("room", "counter", "kitchen", "bonsai")

# Archives, and per scene the downscaling that published tables use (outdoor 4, indoor 2, Tanks and Temples as they come).
CAPTURES = {
    "mipnerf360": ([GOOGLE + "360_v2.zip", GOOGLE + "360_extra_scenes.zip"], {s: 4 for s in OUTDOOR} | {s: 2 for s in INDOOR}),
    "tandt_db": ([INRIA + "tandt_db.zip"], {"tandt/truck": 1, "tandt/train": 1, "db/drjohnson": 1, "db/playroom": 1}),
}
BLOCK = 1 << 20


class FetchError(Exception):
    """One line for the user."""


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
                while block := reply.read(BLOCK):
                    out.write(block)
                    done += len(block)
                    of = f" of {expected / 1e6:.0f}" if expected else ""
                    print(f"\r{target.name}: {done / 1e6:.0f}{of} MB", end="", file=sys.stderr)
            print(file=sys.stderr)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # the part is longer than the file: not ours to complete
            part.unlink()
            return download(url, target)
        raise FetchError(f"{url}: {error}") from error
    except (OSError, urllib.error.URLError) as error:
        raise FetchError(f"{url}: {error}; run again to resume") from error
    if expected is not None and done != expected:
        raise FetchError(f"{url}: connection ended at {done} of {expected} bytes; run again to resume")
    part.rename(target)
    tag.unlink(missing_ok=True)


def verify(archive):
    """Compares with SHA256SUMS beside the archive; records the sum where none is known."""
    digest = hashlib.sha256()
    with archive.open("rb") as source:
        while block := source.read(BLOCK):
            digest.update(block)
    found, sums = digest.hexdigest(), archive.parent / "SHA256SUMS"
    known = dict(reversed(line.split(maxsplit=1)) for line in sums.read_text().splitlines()) if sums.exists() else {}
    if archive.name not in known:
        with sums.open("a") as out:
            out.write(f"{found}  {archive.name}\n")
    elif known[archive.name] != found:
        raise FetchError(f"{archive}: SHA-256 is {found}, {sums} says {known[archive.name]}")


def unpack(archive, folder):
    """Extracts regular files below folder; refuses the whole archive if an entry would land elsewhere."""
    with zipfile.ZipFile(archive) as source:
        entries = [e for e in source.infolist() if not e.is_dir()]
        for e in entries:
            path = PurePosixPath(e.filename)
            if path.is_absolute() or ".." in path.parts or "\\" in e.filename or ":" in e.filename:
                raise FetchError(f"{archive}: entry {e.filename!r} leaves the folder")
            if stat.S_IFMT(e.external_attr >> 16) not in (0, stat.S_IFREG):
                raise FetchError(f"{archive}: entry {e.filename!r} is not a regular file")
        size, free = sum(e.file_size for e in entries), shutil.disk_usage(folder).free
        if size > free:
            raise FetchError(f"{archive}: needs {size / 1e9:.1f} GB, {folder} has {free / 1e9:.1f} GB free")
        root = folder.resolve()
        for e in entries:
            target = folder / e.filename
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.parent.resolve().is_relative_to(root):  # a link that lay there before
                raise FetchError(f"{target}: leads out of {folder}")
            if target.is_file() and target.stat().st_size == e.file_size:
                continue
            with tempfile.NamedTemporaryFile(dir=target.parent, delete=False) as out:
                try:
                    with source.open(e) as packed:
                        shutil.copyfileobj(packed, out, BLOCK)
                except BaseException:
                    Path(out.name).unlink()
                    raise
            Path(out.name).chmod(0o644)
            Path(out.name).replace(target)


def fetch(name, folder, mirror=None):
    """Downloads, verifies and unpacks one collection into folder/name."""
    urls, scenes = CAPTURES[name]
    archives, scenes_folder = folder / "archives", folder / name
    archives.mkdir(parents=True, exist_ok=True)
    scenes_folder.mkdir(parents=True, exist_ok=True)
    for url in urls:
        archive = archives / url.rsplit("/", 1)[1]
        if not archive.exists():
            download(f"{mirror.rstrip('/')}/{archive.name}" if mirror else url, archive)
        if not zipfile.is_zipfile(archive):
            raise FetchError(f"{archive}: not a zip file; delete it and run again")
        verify(archive)
        try:
            unpack(archive, scenes_folder)
        except (zipfile.BadZipFile, OSError) as error:
            raise FetchError(f"{archive}: {error}") from error
    for scene, downscale in scenes.items():
        if (scenes_folder / scene / "sparse/0").is_dir():
            print(f"centaur train {scenes_folder / scene} --downscale {downscale} -o out/{Path(scene).name}/scene.glb")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=CAPTURES)
    parser.add_argument("folder", type=Path, help="where archives/ and the scenes go")
    parser.add_argument("--mirror", help="address of a folder that holds the same archives")
    arguments = parser.parse_args()
    try:
        fetch(arguments.name, arguments.folder, arguments.mirror)
    except FetchError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
