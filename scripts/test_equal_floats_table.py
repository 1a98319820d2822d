"""The table of equal_floats_table: python3 -m unittest discover -s scripts"""

import contextlib
import io
import json
import sys
import tempfile
import unittest
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from equal_floats_table import caption, table


class Table(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name) / "400000"

    def put(self, variant, scene, seed, psnr, splats, lpips=None, at_a_time=1, triangles=None):
        file = self.folder / variant / f"{scene}-{seed}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        evaluation = {"psnr": psnr, "ssim_inria": psnr / 100, "splats": splats, "total_floats": 400_000, "file_bytes": 2_345_678, "seconds_per_iteration": 0.5}
        if triangles is not None:
            evaluation["triangles"] = triangles
        if lpips is not None:
            evaluation["lpips"] = {"net": "vgg", "unnormalized": lpips, "normalized": 2 * lpips}
        job = {"scene": scene, "variant": variant, "seed": seed, "at_a_time": at_a_time}
        file.write_text(json.dumps({"job": job, "evaluation": evaluation}))

    def rows(self):
        return [[c.strip() for c in line.strip("|").split("|")] for line in table([self.folder]).splitlines()]

    def test_differences_are_of_the_means_of_seeds(self):
        for seed, psnr in ((0, 26.0), (1, 27.0)):
            self.put("hybrid", "demo", seed, psnr, 3000, 0.2, triangles=1000 * seed)
            self.put("splats", "demo", seed, 25.0, 6000, 0.25, triangles=0)
        head, _, demo, mean = self.rows()
        self.assertIn("LPIPS by vgg of pictures in 0…1", caption([self.folder]))
        self.assertEqual(len(demo), len(head))
        self.assertIn("LPIPS 0…1: hybrid", head)
        self.assertEqual(demo[:6], ["demo", "400000", "2", "26.50", "25.00", "+1.50"])
        self.assertEqual(demo[6:9], ["0.265", "0.250", "+0.015"])
        self.assertEqual(demo[9:15], ["–"] * 3 + ["0.200", "0.250", "-0.050"], "no FLIP in older results")
        self.assertEqual(head[18:20], ["triangles: hybrid", "floats: hybrid"])
        self.assertEqual(demo[15:], ["3,000", "6,000", "-50 %", "500", "400,000", "400,000", "2.35", "2.35", "0.500", "0.500"])
        self.assertEqual([mean[0]] + mean[3:], ["**mean of 1**"] + demo[3:])

    def test_times_of_jobs_that_shared_a_machine_are_left_out(self):
        self.put("hybrid", "demo", 0, 26.0, 3000, at_a_time=4)
        self.put("splats", "demo", 0, 25.0, 6000)
        for row in self.rows()[2:]:
            self.assertEqual(row[-2:], ["–", "0.500"])

    def said(self):
        """Rows, and messages about other runs."""
        said = io.StringIO()
        with contextlib.redirect_stderr(said):
            rows = self.rows()
        return rows, said.getvalue()

    def test_what_has_no_partner_is_left_out_and_said(self):
        self.put("hybrid", "demo", 0, 26.0, 3000)
        self.put("splats", "demo", 0, 25.0, 6000)
        self.put("splats", "skull", 0, 20.0, 6000)
        (_, _, demo, mean), said = self.said()
        self.assertEqual(said, "400000, skull: left out, splats alone has seed 0\n")
        self.assertEqual(demo[9:15], ["–"] * 6, "neither FLIP nor LPIPS")
        self.assertEqual(demo[18], "–", "no triangles in older results")
        self.assertIn("and LPIPS of pictures", caption([self.folder]))
        self.assertEqual(mean[0], "**mean of 1**")
        self.assertEqual(mean[3:6], demo[3:6])

    def test_differences_are_of_equal_seeds(self):
        for seed, psnr in enumerate((25.0, 27.0, 29.0)):
            self.put("hybrid", "demo", seed, psnr, 3000, 0.2 + seed / 10)
        self.put("splats", "demo", 0, 25.0, 6000)
        (_, _, demo, mean), said = self.said()
        self.assertEqual(said, "400000, demo: left out, hybrid alone has seed 1, 2\n")
        self.assertEqual(demo[2:6], ["1", "25.00", "25.00", "+0.00"])
        self.assertEqual(mean[3:], demo[3:])
        # Nor a column of scores that only some seeds have.
        self.put("splats", "demo", 2, 28.0, 6000, 0.5)
        (_, _, demo, _), said = self.said()
        self.assertEqual(demo[2:6], ["2", "27.00", "26.50", "+0.50"])
        self.assertEqual(demo[12:15], ["0.400", "0.500", "-0.100"])

    def test_runs_without_any_partner_are_no_table(self):
        self.put("hybrid", "demo", 1, 26.0, 3000)
        self.put("splats", "demo", 0, 25.0, 6000)
        rows, said = self.said()
        self.assertEqual((len(rows), said.count("left out")), (2, 2))


if __name__ == "__main__":
    unittest.main()
