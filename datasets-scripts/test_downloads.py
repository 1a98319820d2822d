"""downloads against a local server: python3 -m unittest discover datasets-scripts"""

import contextlib
import hashlib
import io
import socket
import ssl
import subprocess
import sys
import unittest
import urllib.error
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import downloads
from captures_server import SCENE, FetchTest, Server, archive
from downloads import FetchError


class Downloads(FetchTest):
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
        with mock.patch.object(downloads, "ATTEMPTS", 3):
            self.refused("run again to resume")
            self.assertEqual(Server.requests, [None, "bytes=60000-", "bytes=60000-"])
            drops = iter([80_000, None])
            with mock.patch.object(downloads.time, "sleep", side_effect=lambda _: setattr(Server, "cut", next(drops))):
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
        with mock.patch.object(downloads, "ATTEMPTS", 3):
            self.refused(f"^{part}: No space left on device; with more room the same command goes on$")
        self.assertEqual(Server.requests, [None])

    def test_progress(self):
        for is_terminal, most in ((True, 45), (False, 22)):
            said = io.StringIO()
            said.isatty = lambda is_terminal=is_terminal: is_terminal
            with contextlib.redirect_stderr(said):
                progress = downloads.Progress("a.zip", 0, 40_000_000)
                for done in range(10_000, 40_000_001, 10_000):
                    progress.say(done)
                progress.end()
            text = said.getvalue()
            self.assertEqual((text.count("\r") > 0, text.endswith("a.zip: 40 of 40 MB\n")), (is_terminal, True))
            self.assertTrue(15 < text.count("MB") < most, text)

    def test_hangups_that_are_ignored_remain_so(self):
        code = (
            "import signal, downloads; signal.signal(signal.SIGHUP, signal.SIG_IGN); downloads.end_on_signals();"
            "print(signal.getsignal(signal.SIGHUP) is signal.SIG_IGN, signal.getsignal(signal.SIGTERM) is signal.default_int_handler)"
        )
        done = subprocess.run([sys.executable, "-B", "-c", code], cwd=Path(__file__).parent, capture_output=True, text=True)
        self.assertEqual((done.stdout, done.stderr), ("True True\n", ""))

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

    @unittest.skipIf(downloads.fcntl is None, "no locks on this system")
    def test_one_run_at_a_time(self):
        (self.folder / "archives").mkdir()
        with downloads.alone_in(self.folder / "archives"):
            self.refused("another run is fetching into it", "nerf_synthetic")
        self.fetch()

    def test_a_server_that_has_no_range_of_anything(self):
        Server.refuses = True
        self.refused("416")
        self.assertEqual(Server.requests, [None], "it is not asked again")


if __name__ == "__main__":
    unittest.main()
