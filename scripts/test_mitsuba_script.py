"""Which camera hybrid_rf.py takes, where there is no Mitsuba: python3 -m unittest discover -s scripts"""

import runpy
import sys
import unittest
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

SCRIPT = Path(__file__).parent.parent / "src/format/mitsuba/hybrid_rf.py"
# What it needs of these to be read.
MITSUBA = SimpleNamespace(variant=lambda: "", **dict.fromkeys(["BSDF", "Sensor", "Sampler", "SamplingIntegrator"], object))
MODULES = {"mitsuba": MITSUBA, "drjit": SimpleNamespace(syntax=lambda method: method), "numpy": SimpleNamespace()}


class Cameras(unittest.TestCase):
    def setUp(self):
        # It sets a variable for Dr.Jit.
        with mock.patch.dict(sys.modules, MODULES), mock.patch.dict("os.environ"):
            self.index = runpy.run_path(str(SCRIPT))["camera_index"]

    def refused(self, labels, text):
        with self.assertRaises(LookupError) as caught:
            self.index(labels, text)
        return str(caught.exception)

    def test_a_camera_is_chosen_by_name_or_number(self):
        labels = ["front", "IMG 2.jpg", "0", "front"]
        self.assertEqual([self.index(labels, text) for text in ("front", "IMG 2.jpg", "0", "1", "3")], [0, 1, 2, 1, 3])
        for text in ("4", "back", "", "-1", "\u00b2", "9" * 9999):
            self.assertEqual(
                self.refused(labels, text), f"no camera `{text}`; there are 0 (front), 1 (IMG 2.jpg), 2 (0), 3 (front)"
            )

    def test_of_many_cameras_a_few_are_named(self):
        few = ", ".join(f"{i} ({i}.jpg)" for i in range(8))
        for count, rest in ((8, ""), (9, ", … to 8"), (300, ", … to 299")):
            labels = [f"{i}.jpg" for i in range(count)]
            self.assertEqual(self.refused(labels, "x"), f"no camera `x`; there are {few}{rest}")

    def test_none_is_said_as_convert_says_it(self):
        note = "there are no cameras; a picture needs a <sensor>"
        self.assertEqual(self.refused([], "0"), note)
        self.assertIn(f'"{note}"', SCRIPT.with_name("mod.rs").read_text(encoding="utf-8"))


if __name__ == "__main__":
    unittest.main()
