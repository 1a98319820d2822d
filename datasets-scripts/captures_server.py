"""A local server of archives, and what tests of downloads from it share."""

import contextlib
import http.server
import io
import re
import tempfile
import threading
import unittest
import zipfile
from pathlib import Path
from unittest import mock

import downloads
import fetch_captures
from downloads import FetchError


def archive(entries):
    """A zip in memory; stored uncompressed, so that it is long enough to be cut."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as out:
        for name, content in entries:
            out.writestr(name, content)
    return buffer.getvalue()


SCENE = [("tandt/truck/sparse/0/cameras.bin", b"c"), ("tandt/truck/images/000001.jpg", bytes(range(256)) * 400)]
SCENE += [(f"{s}/sparse/0/cameras.bin", b"c") for s in ("tandt/train", "db/drjohnson", "db/playroom")]


class Server(http.server.BaseHTTPRequestHandler):
    """Serves Server.content, or Server.contents by path, with ranges; stops after Server.cut bytes if that is set."""

    content, contents, etag, cut, requests, paths, refuses = b"", {}, '"one"', None, [], [], False
    # Date of the last change; whether If-Range is respected; whether the length of a part is stated.
    modified, heeds, says_length = None, True, True

    def body(self):
        return type(self).contents.get(self.path, type(self).content)

    def do_HEAD(self):
        self.send_response(200)
        self.send_header("Content-Length", str(len(self.body())))
        self.end_headers()

    def do_GET(self):
        cls, content, start = type(self), self.body(), 0
        asked = self.headers.get("Range")
        cls.requests.append(asked)
        cls.paths.append(self.path)
        same = self.headers.get("If-Range") in (cls.etag, cls.modified, None)
        if asked and (same or not cls.heeds):
            start = int(re.match(r"bytes=(\d+)-", asked)[1])
        if (start and start >= len(content)) or cls.refuses:
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(content)}")
            self.send_header("Content-Length", "0")
            return self.end_headers()
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        for name, value in (("ETag", cls.etag), ("Last-Modified", cls.modified)):
            if value:
                self.send_header(name, value)
        if not start or cls.says_length:
            self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        self.wfile.write(content[start : cls.cut])

    def log_message(self, *_):
        pass


class FetchTest(unittest.TestCase):
    """Fetches captures from a local server into a temporary folder."""

    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Server)
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()
        self.addCleanup(self.server.server_close)
        self.addCleanup(self.server.shutdown)
        Server.content, Server.etag, Server.cut, Server.requests, Server.paths = archive(SCENE), '"one"', None, [], []
        Server.contents, Server.refuses = {}, False
        Server.modified, Server.heeds, Server.says_length = None, True, True
        for name, value in (("ATTEMPTS", 1), ("PAUSE", 0)):
            patch = mock.patch.object(downloads, name, value)
            patch.start()
            self.addCleanup(patch.stop)

    def fetch(self, name="tandt_db", scenes=None):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
            fetch_captures.fetch(name, self.folder, f"http://127.0.0.1:{self.server.server_port}/x/", scenes)
        return printed.getvalue()

    def refused(self, pattern, *arguments):
        with self.assertRaisesRegex(FetchError, pattern):
            self.fetch(*arguments)
