"""fetch_captures against a local server: python3 -m unittest discover datasets-scripts"""

import contextlib
import http.server
import io
import re
import sys
import tempfile
import threading
import unittest
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import fetch_captures
from fetch_captures import FetchError


def archive(entries):
    """A zip in memory; stored, so that its length is known to be large enough to cut."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as out:
        for name, content in entries:
            out.writestr(name, content)
    return buffer.getvalue()


def link(name):
    entry = zipfile.ZipInfo(name)
    entry.external_attr = 0o120777 << 16
    return entry


SCENE = [("tandt/truck/sparse/0/cameras.bin", b"c"), ("tandt/truck/images/000001.jpg", bytes(range(256)) * 400)]


class Server(http.server.BaseHTTPRequestHandler):
    """Serves Server.content with ranges; stops after Server.cut bytes where that is set."""

    content, etag, cut, requests = b"", '"one"', None, []

    def do_GET(self):
        cls, start = type(self), 0
        asked = self.headers.get("Range")
        cls.requests.append(asked)
        if asked and self.headers.get("If-Range") == cls.etag:
            start = int(re.match(r"bytes=(\d+)-", asked)[1])
        if start > len(cls.content):
            return self.send_error(416)
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(cls.content) - 1}/{len(cls.content)}")
        self.send_header("ETag", cls.etag)
        self.send_header("Content-Length", str(len(cls.content) - start))
        self.end_headers()
        self.wfile.write(cls.content[start : cls.cut])

    def log_message(self, *_):
        pass


class Fetch(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Server)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        self.addCleanup(self.server.server_close)
        self.addCleanup(self.server.shutdown)
        Server.content, Server.etag, Server.cut, Server.requests = archive(SCENE), '"one"', None, []

    def fetch(self):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
            fetch_captures.fetch("tandt_db", self.folder, f"http://127.0.0.1:{self.server.server_port}/x/")
        return printed.getvalue()

    def refused(self, pattern):
        with self.assertRaisesRegex(FetchError, pattern):
            self.fetch()

    def test_unpacks_and_names_the_command(self):
        self.assertIn("train", self.fetch())
        self.assertEqual((self.folder / "tandt_db/tandt/truck/images/000001.jpg").read_bytes(), SCENE[1][1])
        self.fetch()
        self.assertEqual(len(Server.requests), 1, "a second run downloads nothing")

    def test_resumes(self):
        Server.cut = 60_000
        self.refused("run again to resume")
        Server.cut = None
        self.fetch()
        self.assertEqual(Server.requests, [None, "bytes=60000-"])

    def test_does_not_splice_two_versions(self):
        Server.cut = 60_000
        self.refused("run again to resume")
        Server.content, Server.etag, Server.cut = archive([(n, c[::-1]) for n, c in SCENE]), '"two"', None
        self.fetch()
        self.assertEqual((self.folder / "tandt_db/tandt/truck/images/000001.jpg").read_bytes(), SCENE[1][1][::-1])

    def test_part_longer_than_the_file(self):
        (self.folder / "archives").mkdir()
        (self.folder / "archives/tandt_db.zip.part").write_bytes(bytes(len(Server.content) + 9))
        (self.folder / "archives/tandt_db.zip.etag").write_text('"one"')
        self.fetch()

    def test_compares_with_the_first_download(self):
        self.fetch()
        (self.folder / "archives/tandt_db.zip").unlink()
        Server.content = archive(SCENE[:1])
        self.refused("SHA-256")

    def test_no_entry_leaves_the_folder(self):
        for name in ("../out.txt", "/tmp/out.txt", "a/../../out.txt", "..\\out.txt", "c:out.txt"):
            with self.subTest(name):
                Server.content = archive([SCENE[0], (name, b"x")])
                self.refused("leaves the folder")
                self.assertFalse((self.folder / "tandt_db/tandt").exists(), "nothing of a bad archive is unpacked")
                (self.folder / "archives/tandt_db.zip").unlink()
                (self.folder / "archives/SHA256SUMS").unlink()

    def test_links_are_refused(self):
        Server.content = archive([(link("tandt/away"), "/etc")])
        self.refused("not a regular file")

    def test_old_link_in_the_folder(self):
        outside = self.folder / "outside"
        outside.mkdir()
        (self.folder / "tandt_db").mkdir()
        (self.folder / "tandt_db/tandt").symlink_to(outside)
        self.refused("leads out")
        self.assertFalse(any(p.is_file() for p in outside.rglob("*")))

    def test_not_a_zip(self):
        Server.content = b"<html>moved</html>"
        self.refused("not a zip")


if __name__ == "__main__":
    unittest.main()
