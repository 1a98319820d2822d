"""fetch_captures against a local server: python3 -m unittest discover datasets-scripts"""

import contextlib
import dataclasses
import hashlib
import http.server
import io
import json
import re
import shutil
import socket
import ssl
import subprocess
import sys
import tempfile
import threading
import unittest
import urllib.error
import zipfile
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import fetch_captures
from fetch_captures import FetchError


def archive(entries):
    """A zip in memory; stored uncompressed, so that it is long enough to be cut."""
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
SCENE += [(f"{s}/sparse/0/cameras.bin", b"c") for s in ("tandt/train", "db/drjohnson", "db/playroom")]

# Contents of the Tanks and Temples archives: INRIA's also contains Deep Blending, and GOF's contains further scenes.
TANKS = {
    "/x/tandt_db.zip": archive(SCENE),
    "/x/TNT_GOF.zip": archive([(f"{s}/sparse/0/cameras.bin", b"c") for s in fetch_captures.OF_GOF]),
}


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


class Fetch(unittest.TestCase):
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
            patch = mock.patch.object(fetch_captures, name, value)
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

    def other_version(self):
        Server.content, Server.etag, Server.cut = archive([(n, c[::-1]) for n, c in SCENE]), '"two"', None
        return SCENE[1][1][::-1]

    def picture(self):
        return (self.folder / "tandt_db/tandt/truck/images/000001.jpg").read_bytes()

    def test_a_part_of_another_version_is_not_spliced_where_a_server_does_not_heed_if_range(self):
        Server.cut = 60_000
        self.refused("run again to resume")
        picture, Server.heeds = self.other_version(), False
        self.fetch()
        self.assertEqual((self.picture(), Server.requests), (picture, [None, "bytes=60000-", None]))

    def test_a_rest_without_a_length_is_not_taken_for_whole(self):
        Server.cut = 60_000
        self.refused("run again to resume")
        Server.says_length, Server.cut = False, 80_000
        self.refused(f"connection ended at 80000 of {len(Server.content)} bytes; run again to resume")
        self.assertEqual((self.folder / "archives/tandt_db.zip.part").stat().st_size, 80_000)
        Server.cut = None
        self.fetch()
        self.assertEqual(Server.requests, [None, "bytes=60000-", "bytes=80000-"])

    def test_goes_on_by_the_date_where_there_is_no_strong_etag(self):
        Server.etag, Server.modified, Server.cut = 'W/"one"', "Mon, 01 Jan 2024 00:00:00 GMT", 60_000
        self.refused("run again to resume")
        Server.cut = None
        self.fetch()
        self.assertEqual(Server.requests, [None, "bytes=60000-"])

    def test_does_not_splice_two_dates(self):
        Server.etag, Server.modified, Server.cut = None, "Mon, 01 Jan 2024 00:00:00 GMT", 60_000
        self.refused("run again to resume")
        picture, Server.etag, Server.modified, Server.heeds = self.other_version(), None, "Tue, 02 Jan 2024 00:00:00 GMT", False
        self.fetch()
        self.assertEqual((self.picture(), Server.requests), (picture, [None, "bytes=60000-", None]))

    def test_goes_on_with_nothing_but_a_known_sum(self):
        Server.etag, Server.cut = None, 60_000
        self.refused("at 60000 of .* bytes; run again$")
        self.refused("at 60000 of .* bytes; run again$")
        self.assertEqual(Server.requests, [None, None], "nobody would notice two versions in one")
        line = f"{hashlib.sha256(Server.content).hexdigest()}  tandt_db.zip\n"
        (self.folder / "archives/SHA256SUMS").write_text(line)
        self.refused("run again to resume")
        Server.cut = None
        self.fetch()
        self.assertEqual(Server.requests[2:], ["bytes=60000-"] * 2)

    def test_a_dropped_connection_is_tried_again(self):
        Server.cut = 60_000
        with mock.patch.object(fetch_captures, "ATTEMPTS", 3):
            self.refused("run again to resume")
            self.assertEqual(Server.requests, [None, "bytes=60000-", "bytes=60000-"])
            drops = iter([80_000, None])
            with mock.patch.object(fetch_captures.time, "sleep", side_effect=lambda _: setattr(Server, "cut", next(drops))):
                self.fetch()
        self.assertEqual(Server.requests[3:], ["bytes=60000-", "bytes=60000-", "bytes=80000-"])

    def test_what_no_attempt_helps_is_said_at_once(self):
        (self.folder / "archives").mkdir()
        certificate = ssl.SSLCertVerificationError("CERTIFICATE_VERIFY_FAILED")
        certificate.verify_message = "self-signed certificate"
        for reason, expected in (
            (socket.gaierror(-2, "Name or service not known"), "127.0.0.1: cannot find this host: Name or service not known"),
            (certificate, "127.0.0.1: its certificate is refused: self-signed certificate"),
        ):
            with mock.patch("urllib.request.urlopen", side_effect=urllib.error.URLError(reason)), self.assertRaises(FetchError) as end:
                self.fetch()
            self.assertEqual(str(end.exception), expected)

    @unittest.skipUnless(Path("/dev/full").exists(), "no disk that is always full")
    def test_a_full_disk_is_named(self):
        (self.folder / "archives").mkdir()
        part = self.folder / "archives/tandt_db.zip.part"
        part.symlink_to("/dev/full")
        with mock.patch.object(fetch_captures, "ATTEMPTS", 3):
            self.refused(f"^{part}: No space left on device; with more room the same command goes on$")
        self.assertEqual(Server.requests, [None])

    def test_progress(self):
        for is_terminal, most in ((True, 45), (False, 22)):
            said = io.StringIO()
            said.isatty = lambda is_terminal=is_terminal: is_terminal
            with contextlib.redirect_stderr(said):
                progress = fetch_captures.Progress("a.zip", 0, 40_000_000)
                for done in range(10_000, 40_000_001, 10_000):
                    progress.say(done)
                progress.end()
            text = said.getvalue()
            self.assertEqual((text.count("\r") > 0, text.endswith("a.zip: 40 of 40 MB\n")), (is_terminal, True))
            self.assertTrue(15 < text.count("MB") < most, text)

    def test_hangups_that_are_ignored_remain_so(self):
        code = (
            "import signal, fetch_captures; signal.signal(signal.SIGHUP, signal.SIG_IGN); fetch_captures.end_on_signals();"
            "print(signal.getsignal(signal.SIGHUP) is signal.SIG_IGN, signal.getsignal(signal.SIGTERM) is signal.default_int_handler)"
        )
        done = subprocess.run([sys.executable, "-B", "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True)
        self.assertEqual((done.stdout, done.stderr), ("True True\n", ""))

    def test_a_scene_that_is_half_unpacked_is_none(self):
        extract = fetch_captures.extract

        def interrupted(source, entry, target):
            if entry.filename.endswith(".jpg"):
                raise KeyboardInterrupt
            extract(source, entry, target)

        with mock.patch.object(fetch_captures, "extract", side_effect=interrupted), self.assertRaises(KeyboardInterrupt):
            self.fetch()
        self.assertTrue((self.folder / "tandt_db/tandt/truck/sparse/0").is_dir())
        with self.assertRaisesRegex(FetchError, "found none in tandt/truck"), contextlib.redirect_stdout(io.StringIO()):
            fetch_captures.say_commands("tandt_db", ["tandt/truck"], self.folder / "tandt_db")
        self.assertIn("tandt/truck", self.fetch())

    def test_no_temporary_files_are_left(self):
        def hidden():
            return [p.name for p in (self.folder / "tandt_db").rglob(".fetch-captures-*")]

        Server.content = self.damaged()
        self.refused("Bad CRC-32")
        self.assertEqual(hidden(), [])
        # Left by a killed run.
        (self.folder / "tandt_db/tandt/truck/.fetch-captures-x").touch()
        (self.folder / "archives/tandt_db.zip").unlink()
        Server.content = archive(SCENE)
        self.fetch()
        self.assertEqual(hidden(), [])

    def test_archives_can_be_deleted(self):
        self.assertIn("archives takes 0.0 GB; its archives can be deleted", self.fetch())
        (self.folder / "archives/tandt_db.zip").unlink()
        Server.requests = []
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=0)):
            self.assertIn("train", self.fetch())
        self.assertEqual(Server.requests, [], "what is whole is not downloaded again")
        (self.folder / "tandt_db/tandt/truck/images/000001.jpg").unlink()
        self.fetch(scenes=["train"])
        self.assertEqual(Server.requests, [])
        self.fetch()
        self.assertEqual(len(Server.requests), 1, "what is not, is")

    def test_scenes_of_an_earlier_version_stay_and_are_named(self):
        self.assertNotIn("not verified", self.fetch())
        (self.folder / "archives/tandt_db.zip").unlink()
        for scene in ("tandt/truck", "db/playroom"):
            (self.folder / "tandt_db" / scene / fetch_captures.MARKER).unlink()
        Server.requests, before = [], (self.folder / "tandt_db/scenes.json").read_text()
        note = "Note: not verified, because an earlier version of this program unpacked them: tandt/truck, db/playroom; "
        self.assertIn(note, self.fetch())
        # Also where they are not chosen.
        self.assertIn(note, self.fetch(scenes=["train"]))
        self.assertEqual((Server.requests, (self.folder / "tandt_db/scenes.json").read_text()), ([], before))
        for text in ("", "[]", '{"scenes": {"truck": 1}}', '{"scenes": {"truck": {"capture": []}}}'):
            (self.folder / "tandt_db/scenes.json").write_text(text)
            self.assertFalse(fetch_captures.is_there("tandt/truck", self.folder / "tandt_db"), text)
        self.assertNotIn("not verified", self.fetch())
        self.assertEqual((len(Server.requests), (self.folder / "tandt_db/scenes.json").read_text()), (1, before))

    def test_part_longer_than_the_file(self):
        (self.folder / "archives").mkdir()
        (self.folder / "archives/tandt_db.zip.part").write_bytes(bytes(len(Server.content) + 9))
        (self.folder / "archives/tandt_db.zip.etag").write_text('"one"')
        self.fetch()

    def test_part_that_lacks_nothing_but_its_name(self):
        (self.folder / "archives").mkdir()
        (self.folder / "archives/tandt_db.zip.part").write_bytes(Server.content)
        (self.folder / "archives/tandt_db.zip.etag").write_text('"one"')
        self.fetch()
        self.assertEqual(Server.requests, [f"bytes={len(Server.content)}-"])

    @unittest.skipIf(fetch_captures.fcntl is None, "no locks on this system")
    def test_one_run_at_a_time(self):
        (self.folder / "archives").mkdir()
        with fetch_captures.alone_in(self.folder / "archives"):
            self.refused("another run is fetching into it", "nerf_synthetic")
        self.fetch()

    def test_no_two_commands_write_one_file(self):
        for name, collection in fetch_captures.CAPTURES.items():
            files = {f"{scene}/sparse/0/cameras.bin": 0 for scene in collection.scenes}
            for file in files:
                (self.folder / name / file).parent.mkdir(parents=True)
                (self.folder / name / file).touch()
            fetch_captures.mark(collection.scenes, self.folder / name, files)
            printed = io.StringIO()
            with contextlib.redirect_stdout(printed):
                fetch_captures.say_commands(name, list(collection.scenes), self.folder / name)
            outputs = [line.split(" -o ")[1].split()[0].lower() for line in printed.getvalue().splitlines() if " -o " in line]
            self.assertEqual(sorted(set(outputs)), sorted(outputs), name)
        tables = [table for collection in fetch_captures.CAPTURES.values() for table in collection.tables]
        self.assertTrue({*tables}.isdisjoint(fetch_captures.CAPTURES), "a table of some scenes beside that of all")

    def test_a_server_that_has_no_range_of_anything(self):
        Server.refuses = True
        self.refused("416")
        self.assertEqual(Server.requests, [None], "it is not asked again")

    def test_compares_with_the_first_download(self):
        self.fetch()
        (self.folder / "archives/tandt_db.zip").unlink()
        (self.folder / "tandt_db/tandt/truck" / fetch_captures.MARKER).unlink()
        (self.folder / "tandt_db/scenes.json").unlink()
        Server.content = archive(SCENE[:1])
        self.refused("SHA-256.*SHA256SUMS says .*; delete it and run again")

    def test_no_entry_leaves_the_folder(self):
        for name in ("../out.txt", "/tmp/out.txt", "a/../../out.txt", "..\\out.txt", "c:out.txt"):
            with self.subTest(name):
                Server.content = archive([SCENE[0], (name, b"x")])
                self.refused("leaves the folder")
                self.assertFalse((self.folder / "tandt_db/tandt").exists(), "nothing of a bad archive is unpacked")
                (self.folder / "archives/tandt_db.zip").unlink()
                self.assertFalse((self.folder / "archives/SHA256SUMS").exists())

    def test_links_are_refused(self):
        Server.content = archive([(link("tandt/away"), "/etc")])
        self.refused("not a regular file")

    def test_old_link_in_the_folder(self):
        outside = self.folder / "outside"
        outside.mkdir()
        (self.folder / "tandt_db").mkdir()
        (self.folder / "tandt_db/tandt").symlink_to(outside)
        self.refused("leads out")
        self.assertEqual(list(outside.iterdir()), [])

    def test_a_damaged_archive_is_not_what_later_ones_must_match(self):
        whole, Server.content = Server.content, self.damaged()
        self.refused("Bad CRC-32.*; delete it and run again")
        (self.folder / "archives/tandt_db.zip").unlink()
        Server.content = whole
        self.fetch()

    def damaged(self):
        whole = archive(SCENE)
        place = whole.index(SCENE[1][1]) + 1000
        return whole[:place] + b"!" + whole[place + 1 :]

    def test_a_damaged_archive_is_not_recorded_beside_files_of_its_size(self):
        self.fetch()
        marker = f"tandt_db/tandt/truck/{fetch_captures.MARKER}"
        for name in ("archives/tandt_db.zip", "archives/SHA256SUMS", marker, "tandt_db/scenes.json"):
            (self.folder / name).unlink()
        Server.content = self.damaged()
        self.refused("Bad CRC-32.*; delete it and run again")
        self.assertFalse((self.folder / "archives/SHA256SUMS").exists())

    def test_a_damaged_archive_is_not_recorded_for_its_other_scenes(self):
        Server.content = self.damaged()
        self.refused("Bad CRC-32.*; delete it and run again", "tandt_db", ["train"])
        self.assertFalse((self.folder / "archives/SHA256SUMS").exists())

    def test_files_of_equal_size_are_compared_before_an_archive_is_recorded(self):
        file = self.folder / "tandt_db/tandt/truck/images/000001.jpg"
        file.parent.mkdir(parents=True)
        file.write_bytes(bytes(len(SCENE[1][1])))
        self.fetch()
        self.assertEqual(file.read_bytes(), SCENE[1][1])
        # An archive that is known to be intact is not read again.
        with mock.patch.object(fetch_captures, "crc32", side_effect=AssertionError):
            self.fetch()

    def test_lines_of_checksums_that_say_nothing_are_passed_over(self):
        (self.folder / "archives").mkdir()
        (self.folder / "archives/SHA256SUMS").write_text("\nnonsense\n")
        self.fetch()

    def test_scenes_that_an_archive_lacks_are_named(self):
        Server.content = archive(SCENE[:2] + [(f"other/{n}", c) for n, c in SCENE[2:]])
        self.refused("found none in tandt/train, db/drjohnson, db/playroom")

    def test_commands_can_be_pasted(self):
        self.folder = self.folder / "my captures"
        self.assertIn(f"centaur train '{self.folder}/tandt_db/tandt/truck' -o truck.glb\n", self.fetch())

    def test_not_a_zip(self):
        Server.content = b"<html>moved</html>"
        self.refused("not a zip")

    def test_a_small_disk_is_found_before_any_download(self):
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=int(1.5 * len(Server.content)))):
            self.refused("needs .* GB for archives and")
            self.assertEqual(Server.requests, [])
            # The size of chosen scenes is unknown before the archive is there.
            self.fetch(scenes=["train"])
        (self.folder / "archives/tandt_db.zip").unlink()
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=3 * len(Server.content))):
            self.fetch()

    def test_what_is_there_needs_no_space(self):
        self.fetch()
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=0)):
            self.fetch()

    def test_says_where_the_licence_stands(self):
        self.assertIn("https://www.tanksandtemples.org/license/", self.fetch())
        for name, collection in fetch_captures.CAPTURES.items():
            self.assertGreater(len(collection.licence), 20, name)

    def test_only_chosen_scenes(self):
        Server.content = archive([*SCENE, ("readme.txt", b"r")])
        printed = self.fetch(scenes=["train"])
        self.assertFalse((self.folder / "tandt_db/tandt/truck").exists())
        self.assertTrue((self.folder / "tandt_db/readme.txt").exists(), "what belongs to no scene")
        self.assertIn("tandt/train", printed)
        self.assertNotIn("tandt/truck", printed)
        self.refused("expected truck, train, drjohnson, playroom, found barn", "tandt_db", ["barn"])

    def main(self, *arguments, name="tandt_db"):
        """Exit status and error output."""
        said = io.StringIO()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
            try:
                fetch_captures.main([name, str(self.folder), *arguments])
            except SystemExit as end:
                return (1, end.code) if isinstance(end.code, str) else (end.code, said.getvalue())
        return 0, said.getvalue()

    def test_names_of_scenes_are_stripped_and_an_empty_one_is_none(self):
        with mock.patch.object(fetch_captures, "download", side_effect=AssertionError):
            for names in ("", " ", "train,", ","):
                self.assertEqual(
                    self.main("--scenes", names), (1, "error: --scenes: expected truck, train, drjohnson, playroom, found nothing")
                )
        mirror = f"http://127.0.0.1:{self.server.server_port}/x"
        self.assertEqual(self.main("--mirror", mirror, "--scenes", " train , playroom")[0], 0)
        self.assertTrue((self.folder / "tandt_db/db/playroom").exists())
        self.assertFalse((self.folder / "tandt_db/tandt/truck").exists())

    def test_addresses(self):
        for mirror in ("", "foo", "http://[::1"):
            expected = f"error: --mirror: expected an address such as https://host/folder, found {mirror or 'nothing'}"
            self.assertEqual(self.main("--mirror", mirror), (1, expected))
        self.assertEqual(list(self.folder.iterdir()), [])
        self.assertRegex(self.main("--mirror", "http://127.0.0.1:port")[1], "^error: .*tandt_db.zip: nonnumeric port: 'port'$")

    def test_an_interruption_is_one_line(self):
        with mock.patch.object(fetch_captures, "download", side_effect=KeyboardInterrupt):
            self.assertEqual(self.main("--mirror", "http://127.0.0.1:9"), (130, "error: stopped; the same command goes on\n"))

    def test_published_checksum(self):
        collection = fetch_captures.CAPTURES["tandt_db"]
        for found, content in ((True, Server.content), (False, b"other")):
            sums = {"tandt_db.zip": hashlib.sha256(content).hexdigest()}
            with mock.patch.dict(fetch_captures.CAPTURES, tandt_db=dataclasses.replace(collection, sums=sums)):
                self.fetch() if found else self.refused("its publisher says")

    def test_synthetic_scenes_are_archives_of_their_own(self):
        views = [(f"lego/{part}/r_0.png", b"p") for part in ("train", "test")]
        Server.content = archive(
            [("lego/transforms_train.json", b"{}"), ("lego/transforms_test.json", b"{}"), ("__MACOSX/lego/._r", b"m")] + views
        )
        printed = self.fetch("nerf_synthetic", ["lego"])
        self.assertEqual(Server.paths, ["/x/lego.zip"])
        folder = self.folder / "nerf_synthetic"
        self.assertEqual(sorted(p.name for p in folder.iterdir()), ["lego", "scenes.json"])
        self.assertIn(f"centaur train {folder / 'lego'} --background white -o lego.glb", printed)
        self.assertIn(f"centaur bench {folder} -o out/nerf_synthetic\n", printed)
        listed = json.loads((folder / "scenes.json").read_text())["scenes"]
        self.assertEqual(listed, {"lego": {"capture": "lego", "flags": ["--background", "white"]}})

    def test_a_synthetic_scene_without_test_views_is_none(self):
        Server.content = archive([("lego/transforms_train.json", b"{}")])
        self.refused("found none in lego", "nerf_synthetic", ["lego"])

    def tanks(self, scenes=None):
        """Fetches Tanks and Temples, for which the test's archive has another checksum than the real one."""
        collection = dataclasses.replace(fetch_captures.CAPTURES["tandt"], sums={})
        with mock.patch.dict(fetch_captures.CAPTURES, tandt=collection):
            return self.fetch("tandt", scenes)

    def captures(self):
        return sorted(str(p.parent.parent.relative_to(self.folder / "tandt")) for p in self.folder.glob("tandt/**/sparse/0"))

    def test_truck_and_train_come_with_tanks_and_temples(self):
        Server.contents = TANKS
        printed = self.tanks()
        self.assertEqual(sorted(Server.paths), sorted(TANKS))
        larger = sorted(fetch_captures.OF_GOF)
        self.assertEqual(self.captures(), larger + ["tandt/train", "tandt/truck"], "Deep Blending stays in its archive")
        folder = self.folder / "tandt"
        self.assertIn(f"centaur train {folder / larger[0]} --downscale 2 -o", printed)
        self.assertIn(f"centaur train {folder / 'tandt/train'} -o", printed)
        self.assertIn(f"centaur bench {folder} -o out/tandt\n", printed)
        self.assertIn(f"centaur bench {folder} --scenes truck,train -o out/truck-and-train\n", printed)
        self.assertIn(f"centaur bench {folder} --scenes Barn,Caterpillar,Ignatius,truck,train -o out/five\n", printed)
        listed = json.loads((folder / "scenes.json").read_text())["scenes"]
        self.assertEqual(listed["Barn"], {"capture": "TNT_GOF/TrainingSet/Barn", "flags": ["--downscale", "2"]})
        self.assertEqual(listed["truck"], {"capture": "tandt/truck", "flags": []})
        self.assertIn("Truck-larger", listed, "files of truck and Truck would be one where case does not count")
        self.assertEqual(len(listed), 8)
        # Both archives are recorded, and not downloaded again, neither under this name nor for the other collection
        # that uses INRIA's archive.
        names = [line.split()[1] for line in (self.folder / "archives/SHA256SUMS").read_text().splitlines()]
        self.assertEqual(sorted(names), ["TNT_GOF.zip", "tandt_db.zip"])
        Server.paths = []
        self.tanks()
        self.assertIn("db/playroom", self.fetch())
        self.assertEqual(Server.paths, [])

    def test_truck_and_train_come_with_any_scene_of_tanks_and_temples(self):
        Server.contents = TANKS
        printed = self.tanks(["Barn"])
        self.assertIn("--scenes truck,train", printed)
        self.assertNotIn("Ignatius", printed)
        self.assertEqual(self.captures(), ["TNT_GOF/TrainingSet/Barn", "tandt/train", "tandt/truck"])

    def test_scenes_are_named_as_in_the_list_of_them(self):
        Server.contents = TANKS
        for name in ("Truck-larger", "Truck"):
            self.assertIn("-o Truck-larger.glb", self.tanks([name]))
            self.assertIn("TNT_GOF/TrainingSet/Truck", self.captures())
            shutil.rmtree(self.folder / "tandt")
        with self.assertRaisesRegex(FetchError, "expected truck, train, Barn, .*, Truck-larger, found lorry"):
            self.tanks(["lorry"])

    def test_truck_and_train_alone_need_one_archive(self):
        Server.contents = TANKS
        self.tanks(["train"])
        self.assertEqual(Server.paths, ["/x/tandt_db.zip"], "of 650 MB, not of 8 GB")
        self.assertEqual(self.captures(), ["tandt/train", "tandt/truck"])

    def test_tanks_and_temples_need_space_for_both_archives(self):
        Server.contents = TANKS
        both = sum(map(len, TANKS.values()))
        with mock.patch("shutil.disk_usage", return_value=SimpleNamespace(free=2 * both - 1)):
            with self.assertRaisesRegex(FetchError, "needs .* GB for archives"):
                self.tanks()
        self.assertEqual(Server.paths, [])

    def test_tanks_and_temples_go_on_where_they_stopped(self):
        Server.contents, Server.cut = TANKS, 60_000
        with self.assertRaisesRegex(FetchError, "tandt_db.zip.*run again to resume"):
            self.tanks()
        Server.cut = None
        self.tanks()
        self.assertEqual(Server.requests, [None, "bytes=60000-", None])

    def test_no_archive_without_a_chosen_scene(self):
        for scene, file in (("flowers", "360_extra_scenes.zip"), ("room", "360_v2.zip")):
            Server.paths, Server.content = [], archive([(f"{scene}/sparse/0/cameras.bin", b"c")])
            self.fetch("mipnerf360", [scene])
            self.assertEqual(Server.paths, [f"/x/{file}"])

    def test_flags_are_those_of_published_tables(self):
        scenes = fetch_captures.CAPTURES["mipnerf360"].scenes
        self.assertEqual(
            {s for s, flags in scenes.items() if flags == "--downscale 4"}, {"bicycle", "flowers", "garden", "stump", "treehill"}
        )
        self.assertEqual({s for s, flags in scenes.items() if flags == "--downscale 2"}, {"room", "counter", "kitchen", "bonsai"})
        for name in ("tandt_db", "tandt"):
            flags = [fetch_captures.CAPTURES[name].scenes[s] for s in ("tandt/truck", "tandt/train")]
            self.assertEqual(flags, ["", ""], f"{name}: at the size that they come in")


if __name__ == "__main__":
    unittest.main()
