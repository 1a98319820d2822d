"""The table of order_modes_table: python3 -m unittest discover -s scripts"""

import contextlib
import io
import json
import sys
import tempfile
import unittest
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from order_modes_table import table


class Table(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)

    def put(self, variant, scene, seed, psnr, flip=None):
        file = self.folder / scene / variant / f"{scene}-{seed}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        evaluation = {"psnr": psnr, "ssim_inria": 0.9, "flip": flip}
        file.write_text(json.dumps({"job": {"scene": scene, "variant": variant, "seed": seed}, "evaluation": evaluation}))

    def rows(self):
        return [[c.strip() for c in line.strip("|").split("|")] for line in table(self.folder).splitlines()]

    def test_pairs_are_of_one_seed(self):
        for seed, (stable, consistent, direct) in enumerate(((26.0, 27.0, 25.0), (26.0, 24.0, 25.5))):
            for variant, psnr in (("stable", stable), ("surface-consistent", consistent), ("direct", direct)):
                self.put(variant, "demo", seed, psnr, 1 / psnr)
        head, _, stable, consistent, all_stable, _ = self.rows()
        self.assertEqual(len(head), len(stable))
        self.assertEqual(stable[:4], ["demo", "stable", "+0.750 ± 0.250", "2 of 2"])
        self.assertEqual(stable[6:], ["-0.0011 ± 0.0004", "2 of 2"], "FLIP: less is better")
        self.assertEqual(stable[4:6], ["+0.0000 ± 0.0000", "0 of 2"])
        self.assertEqual(consistent[1:4], ["surface-consistent", "+0.250 ± 1.750", "1 of 2"])
        self.assertEqual(all_stable[1:], stable[1:])

    def test_what_is_not_done_is_left_out_and_said(self):
        # The same number of runs of each variant, but with different seeds.
        for variant, seed in (("stable", 0), ("surface-consistent", 0), ("direct", 1)):
            self.put(variant, "demo", seed, 26.0)
        said = io.StringIO()
        with contextlib.redirect_stderr(said):
            *_, last = self.rows()
        self.assertEqual(last, ["**all**", "surface-consistent"] + ["–"] * 6)
        self.assertIn("demo: left out", said.getvalue())


if __name__ == "__main__":
    unittest.main()
