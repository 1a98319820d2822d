"""Whether an output can be written, found before the work that goes into it, and writing it whole. Standard library only."""

import os
import tempfile


def ensure_file(path):
    """An OSError of one line unless a file of this name can be written. Makes nothing: folders that are missing come with the file."""
    if os.path.isdir(path):
        raise OSError(f"{path}: cannot write: it is a folder")
    probe(path.parent, path, f".{path.name}.")


def ensure_folder(path):
    """The same of a folder and of files in it."""
    probe(path, path, ".")


def probe(folder, path, prefix):
    try:
        while not is_there(folder) and folder != folder.parent:
            folder = folder.parent
        # Modes do not say it all: nobody makes files in /proc, and root may write where disks are read-only.
        tempfile.NamedTemporaryFile(dir=folder, prefix=prefix).close()
    except OSError as error:
        raise OSError(f"{path}: cannot write in {folder}: {error.strerror}") from error


def is_there(folder):
    """Not `Path.exists`, which of names that are too long says no in some versions of Python."""
    try:
        os.stat(folder)
    except FileNotFoundError:
        return False
    return True


def write_whole(path, parts):
    """A file of these bytes, under another name until it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as out:
        try:
            for part in parts:
                out.write(part)
        except BaseException:
            out.close()
            os.unlink(out.name)
            raise
    # Closed: Windows renames no open file.
    os.chmod(out.name, 0o644)
    os.replace(out.name, path)
