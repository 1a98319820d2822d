"""rendering.py with pictures that record how they were made: python3 -m unittest discover datasets-scripts"""

import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import rendering

FILES = ["000.jpg", "001.jpg", "002.jpg"]


class Rendering(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder, self.made = Path(temporary.name, "capture"), []

    def pictures(self, spp, stop_at=None):
        def save(i, path):
            self.made.append(i)
            path.write_text(f"half of {spp}")
            if i == stop_at:
                raise KeyboardInterrupt
            path.write_text(f"{spp}")

        rendering.pictures(self.folder, FILES, {"spp": spp}, save)

    def whole(self, spp, stop_at=None):
        def write(model):
            model.mkdir(parents=True)
            (model / "cameras.bin").touch()
            if stop_at == "model":
                raise KeyboardInterrupt
            for file in rendering.MODEL:
                (model / file).touch()

        self.pictures(spp, stop_at)
        rendering.finish(self.folder, write)

    def interrupted(self, *arguments):
        self.made = []
        with self.assertRaises(KeyboardInterrupt):
            self.whole(*arguments)
        self.assertFalse((self.folder / "sparse").exists(), "no capture")

    def ends(self, spp, made):
        self.made = []
        self.whole(spp)
        self.assertEqual(self.made, made)
        files = sorted(str(p.relative_to(self.folder)) for p in self.folder.rglob("*") if p.is_file())
        self.assertEqual(files, [*(f"images/{f}" for f in FILES), *(f"sparse/0/{f}" for f in sorted(rendering.MODEL))])
        self.assertEqual({(self.folder / "images" / f).read_text() for f in FILES}, {str(spp)})

    def test_what_was_interrupted_goes_on(self):
        self.interrupted(4, 1)
        self.ends(4, [1, 2])
        # A complete capture is rendered anew when requested.
        self.ends(4, [0, 1, 2])

    def test_making_it_anew_is_not_whole_until_its_end(self):
        self.ends(4, [0, 1, 2])
        self.interrupted(4, 0)
        self.ends(4, [0, 1, 2])
        self.interrupted(4, "model")
        self.assertEqual(self.made, [0, 1, 2])
        self.ends(4, [])

    def test_what_is_made_otherwise_is_made_anew(self):
        self.interrupted(4, 2)
        self.ends(16, [0, 1, 2])
        self.interrupted(16, 2)
        with mock.patch.object(rendering, "sources", return_value="others"):
            self.ends(16, [0, 1, 2])

    def test_nothing_else_is_deleted(self):
        other = self.folder / "sparse/1/cameras.bin"
        other.parent.mkdir(parents=True)
        other.touch()
        model = self.folder / "sparse/0/cameras.bin"
        model.parent.mkdir()
        model.touch()
        with self.assertRaisesRegex(OSError, "^.*sparse/1: expected nothing in .*sparse but the model, which is made anew$"):
            self.pictures(4)
        self.assertEqual((other.exists(), model.exists(), self.made), (True, True, []))


if __name__ == "__main__":
    unittest.main()
