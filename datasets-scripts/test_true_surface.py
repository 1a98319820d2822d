"""Errors that true_surface.py reports before making a surface; needs no NumPy: python3 -m unittest discover
datasets-scripts"""

import contextlib
import io
import sys
import tempfile
import unittest
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).parent))
import true_surface


class Surface(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)

    def run_with(self, *arguments):
        """Exit status and output."""
        said = io.StringIO()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said), self.assertRaises(SystemExit) as end:
            true_surface.main(list(map(str, arguments)))
        code = end.exception.code
        return (1, code) if isinstance(code, str) else (code, said.getvalue())

    def test_help_is_no_failure(self):
        code, said = self.run_with("--help")
        self.assertEqual(code, 0)
        self.assertIn("truth.ply", said)

    def test_outputs(self):
        file, folder = self.folder / "file", self.folder / "folder.ply"
        file.touch()
        folder.mkdir()
        with mock.patch.object(true_surface, "surface", side_effect=AssertionError):
            for name in ("ts.obj", "ply", ""):
                code, said = self.run_with("demo", name)
                self.assertEqual(code, 2)
                self.assertIn("expected a name that ends in .ply", said)
            self.assertEqual(self.run_with("demo", folder), (1, f"error: {folder}: cannot write: it is a folder"))
            self.assertEqual(self.run_with("demo", file / "a.ply"), (1, f"error: {file}/a.ply: cannot write in {file}: Not a directory"))
            long = self.folder / f"{'a' * 300}.ply"
            self.assertRegex(self.run_with("demo", long)[1], "^error: .*: cannot write in .*: File name too long$")
        self.assertEqual(sorted(p.name for p in self.folder.iterdir()), ["file", "folder.ply"])

    def test_what_is_missing_is_named(self):
        with mock.patch.dict(sys.modules, numpy=None):
            code, said = self.run_with("demo", self.folder / "a.ply")
        self.assertRegex(said, "^error: .*numpy.*; install it with: pip install numpy pillow$")

    def test_files_are_whole_in_folders_that_are_made(self):
        file, said = self.folder / "new/a.PLY", io.StringIO()
        with mock.patch.object(true_surface, "surface", return_value=([b"ply\n", b"rest"], 7)), contextlib.redirect_stdout(said):
            true_surface.main(["demo", str(file)])
        self.assertEqual((file.read_bytes(), said.getvalue()), (b"ply\nrest", f"{file}: 7 triangles\n"))
        self.assertEqual(list(file.parent.iterdir()), [file])


if __name__ == "__main__":
    unittest.main()
