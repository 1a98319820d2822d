"""Slow rendering of a capture, such that an interrupted run is neither mistaken for a complete one nor restarted from
the beginning. Standard library only.

While pictures are rendered, FOLDER has no sparse/, so it is not a capture, and FOLDER/unfinished.json contains the
settings: a run with the same settings keeps existing pictures, any other renders all of them anew.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path

STAMP = "unfinished.json"
MODEL = ("cameras.bin", "images.bin", "points3D.bin")


def sources():
    """A checksum of the scripts in this folder, some of which define scenes."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).resolve().parent.glob("*.py")):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def pictures(folder, files, settings, save):
    """Renders the pictures of a capture: `save(i, path)` writes the i-th of `files`. All are rendered anew unless a run
    with the same `settings` (JSON values) was interrupted. Raises an OSError if sparse/ contains files that do not
    belong to a model."""
    folder, stamp, images = Path(folder), Path(folder, STAMP), Path(folder, "images")
    how = json.dumps({**settings, "sources": sources()}, sort_keys=True) + "\n"
    images.mkdir(parents=True, exist_ok=True)
    remove_model(folder / "sparse")
    if not (stamp.is_file() and stamp.read_text() == how):
        stamp.unlink(missing_ok=True)
        for file in files:
            (images / file).unlink(missing_ok=True)
        stamp.write_text(how)
    for i, file in enumerate(files):
        if not (images / file).exists():
            # With the same suffix, by which programs recognise the format.
            part = images / f".part.{file}"
            save(i, part)
            os.replace(part, images / file)


def remove_model(sparse):
    others = sorted({*sparse.rglob("*")} - {sparse / "0", *(sparse / "0" / file for file in MODEL)})
    if others:
        raise OSError(f"{others[0]}: expected nothing in {sparse} but the model, which is made anew")
    for file in MODEL:
        (sparse / "0" / file).unlink(missing_ok=True)
    for folder in (sparse / "0", sparse):
        if folder.is_dir():
            folder.rmdir()


def finish(folder, write):
    """Completes the capture: `write(path)` writes the model into a folder, which gets its final name when complete."""
    part = Path(folder, "sparse.part")
    shutil.rmtree(part, ignore_errors=True)
    write(part / "0")
    part.rename(Path(folder, "sparse"))
    Path(folder, STAMP).unlink()
