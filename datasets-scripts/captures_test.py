"""Errors that capture-rendering scripts report before building a scene; needs requirements.txt: see geometry_test.py"""

import contextlib
import io
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import demo_capture
import unbounded_capture


class Refused(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name) / "capture"
        for patch in (
            mock.patch.object(demo_capture, "load", side_effect=AssertionError),
            mock.patch.dict(unbounded_capture.SCENES, garden=mock.Mock(side_effect=AssertionError)),
        ):
            patch.start()
            self.addCleanup(patch.stop)

    def refused(self, pattern, folder, *options):
        """Asserts that both scripts refuse this and create nothing."""
        for main, scene in ((demo_capture.main, []), (unbounded_capture.main, ["garden"])):
            said = io.StringIO()
            with self.subTest(options), self.assertRaises(SystemExit) as end, contextlib.redirect_stderr(said):
                main([*scene, str(folder), *options])
            # argparse prints its error and exits with 2.
            self.assertRegex(said.getvalue() if end.exception.code == 2 else end.exception.code, pattern)
            self.assertFalse(self.folder.exists())

    def test_samples(self):
        for text in ("0", "-3", "2.5", "many", "", "²", "65537", "9" * 9999):
            self.refused(r"--spp: expected a whole number from 1 to 65536, found", self.folder, "--spp", text)

    def test_outputs(self):
        file = self.folder.parent / "file"
        file.touch()
        for options in ([], ["--only", "0"]):
            self.refused(r"^error: .*file\S*: cannot write in ", file, *options)
        (self.folder.parent / "other").mkdir()
        (self.folder.parent / "other/images").touch()
        self.refused(r"^error: .*other/images: cannot write in ", self.folder.parent / "other")
        self.refused(r"^error: .*: expected a capture to check, found none$", self.folder, "--check")

    def test_views(self):
        with mock.patch.dict(unbounded_capture.SCENES, garden=lambda: {"poses": [None] * demo_capture.VIEWS, "camera": None}):
            for view in ("-1", "48"):
                self.refused(f"^error: --only: expected views from 0 to 47, found {view}$", self.folder, "--only", "0", view)


if __name__ == "__main__":
    unittest.main()
