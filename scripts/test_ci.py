"""Output of .ci/run if dependencies are not available, with stand-ins that do nothing for all programs it runs: python3
-m unittest discover -s scripts"""

import os
import shutil
import subprocess
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).parents[1]


class Ci(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)
        (self.folder / ".ci").mkdir()
        shutil.copy(ROOT / ".ci/run", self.folder / ".ci/run")
        # Neither Python nor ffmpeg nor Slurm is available.
        for name in ("make", "cargo", "scripts/install.sh", "scripts/ensure-llvm.sh"):
            self.program(name, f"exit {int('install' in name)}")

    def program(self, name, lines):
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"#!/bin/sh\n{lines}\n")
        path.chmod(0o755)

    def run_ci(self, **settings):
        """Exit status and output."""
        env = {name: value for name, value in os.environ.items() if not name.startswith("CENTAUR_")}
        env |= {"PATH": f"{self.folder}:{env['PATH']}", "BLENDER_PYTHON": "/none/python", **settings}
        done = subprocess.run([self.folder / ".ci/run"], env=env, capture_output=True, text=True)
        return done.returncode, done.stdout, done.stderr

    def test_what_is_left_out_is_named_and_a_failure_where_all_is_required(self):
        code, said, _ = self.run_ci()
        self.assertEqual((code, said.splitlines()[-1]), (0, "all passed"))
        self.assertIn("left out: oracle-usd, since its packages need /none/python\n", said)
        code, said, _ = self.run_ci(CENTAUR_CI_REQUIRE="all")
        self.assertEqual((code, said.splitlines()[-1]), (1, "FAILED"))
        self.assertIn("left out: oracle-usd, since its packages need /none/python\n", said)
        self.assertRegex(said, "\nCENTAUR_CI_REQUIRE=all: expected nothing left out, found [56] of the above\n")

    def test_other_words_are_refused(self):
        expected = (2, "", "error: CENTAUR_CI_REQUIRE: expected all or nothing, found usd\n")
        self.assertEqual(self.run_ci(CENTAUR_CI_REQUIRE="usd"), expected)

    def test_failures_of_python_tests_are_repeated_at_the_end(self):
        lines = ["FAIL: test_a (test_b.C.test_a)", "ERROR: test_d (test_b.C.test_d)"]
        self.program("make", f"case $* in *left-out*) ;; *test*) printf '%s\\n' '{lines[0]}' '{lines[1]}'; exit 1 ;; esac")
        code, said, _ = self.run_ci()
        self.assertEqual((code, said.splitlines()[-3:]), (1, [*sorted(lines), "FAILED"]))


if __name__ == "__main__":
    unittest.main()
