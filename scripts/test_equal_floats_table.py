"""The table of equal_floats_table: python3 -m unittest discover -s scripts"""

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

    def put(self, variant, scene, seed, psnr, splats, lpips=None, at_a_time=1):
        file = self.folder / variant / f"{scene}-{seed}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        evaluation = {"psnr": psnr, "ssim_inria": psnr / 100, "splats": splats, "total_floats": 400_000, "file_bytes": 2_345_678, "seconds_per_iteration": 0.5}
        if lpips is not None:
            evaluation["lpips"] = {"net": "vgg", "unnormalized": lpips, "normalized": 2 * lpips}
        job = {"scene": scene, "variant": variant, "seed": seed, "at_a_time": at_a_time}
        file.write_text(json.dumps({"job": job, "evaluation": evaluation}))

    def rows(self):
        return [[c.strip() for c in line.strip("|").split("|")] for line in table([self.folder]).splitlines()]

    def test_differences_are_of_the_means_of_seeds(self):
        for seed, psnr in ((0, 26.0), (1, 27.0)):
            self.put("hybrid", "demo", seed, psnr, 3000, 0.2)
            self.put("splats", "demo", seed, 25.0, 6000, 0.25)
        head, _, demo, mean = self.rows()
        self.assertIn("LPIPS by vgg of pictures in 0…1", caption([self.folder]))
        self.assertEqual(len(demo), len(head))
        self.assertIn("LPIPS 0…1: hybrid", head)
        self.assertEqual(demo[:6], ["demo", "400000", "2", "26.50", "25.00", "+1.50"])
        self.assertEqual(demo[6:9], ["0.265", "0.250", "+0.015"])
        self.assertEqual(demo[9:15], ["–"] * 3 + ["0.200", "0.250", "-0.050"], "no FLIP in older results")
        self.assertEqual(demo[15:], ["3,000", "6,000", "-50 %", "400,000", "400,000", "2.35", "2.35", "0.500", "0.500"])
        self.assertEqual([mean[0]] + mean[3:], ["**mean of 1**"] + demo[3:])

    def test_times_of_jobs_that_shared_a_machine_are_left_out(self):
        self.put("hybrid", "demo", 0, 26.0, 3000, at_a_time=4)
        self.put("splats", "demo", 0, 25.0, 6000)
        for row in self.rows()[2:]:
            self.assertEqual(row[-2:], ["–", "0.500"])

    def test_what_is_missing_is_not_in_the_mean(self):
        self.put("hybrid", "demo", 0, 26.0, 3000)
        self.put("splats", "demo", 0, 25.0, 6000)
        self.put("splats", "skull", 0, 20.0, 6000)
        _, _, demo, skull, mean = self.rows()
        self.assertEqual(skull[2:6], ["0/1", "–", "20.00", "–"])
        self.assertEqual(skull[17], "–")
        self.assertEqual(demo[9:15], ["–"] * 6, "neither FLIP nor LPIPS")
        self.assertIn("and LPIPS of pictures", caption([self.folder]))
        self.assertEqual(mean[0], "**mean of 1**")
        self.assertEqual(mean[3:6], demo[3:6])


if __name__ == "__main__":
    unittest.main()
