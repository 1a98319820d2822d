"""Checks before the work that an output can be written, and writes it atomically. Standard library only."""

import os
import tempfile


def ensure_file(path):
    """Raises a one-line OSError unless a file of this name can be written. Creates nothing: missing folders are made
    later with the file."""
    if os.path.isdir(path):
        raise OSError(f"{path}: cannot write: it is a folder")
    probe(path.parent, path, f".{path.name}.")


def ensure_folder(path):
    """Raises a one-line OSError unless a folder of this name, and files in it, can be written."""
    probe(path, path, ".")


def probe(folder, path, prefix):
    try:
        while not is_there(folder) and folder != folder.parent:
            folder = folder.parent
        # Permissions are not sufficient: nobody can create files in /proc, and root could write to read-only disks.
        tempfile.NamedTemporaryFile(dir=folder, prefix=prefix).close()
    except OSError as error:
        raise OSError(f"{path}: cannot write in {folder}: {error.strerror}") from error


def is_there(folder):
    """Like `Path.exists`, which in some versions of Python returns False for names that are too long."""
    try:
        os.stat(folder)
    except FileNotFoundError:
        return False
    return True


def write_whole(path, parts):
    """Writes a file under another name until it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as out:
        try:
            for part in parts:
                out.write(part)
        except BaseException:
            out.close()
            os.unlink(out.name)
            raise
    # Closed first: Windows cannot rename an open file.
    os.chmod(out.name, 0o644)
    os.replace(out.name, path)
