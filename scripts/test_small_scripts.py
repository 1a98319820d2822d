"""Small scripts with programs that fail or are not the expected ones: python3 -m unittest discover -s scripts"""

import os
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

HERE = Path(__file__).parent


class Scripts(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)

    def program(self, name, lines):
        path = self.folder / name
        path.write_text(f"#!/bin/sh\n{lines}\n")
        path.chmod(0o755)

    def run_script(self, name, *arguments):
        """Exit status, messages and output of a script, with the stand-ins first in PATH."""
        env = {**os.environ, "PATH": f"{self.folder}:{os.environ['PATH']}"}
        done = subprocess.run([HERE / name, *arguments], env=env, capture_output=True, text=True)
        return done.returncode, done.stderr, done.stdout

    def test_no_place_of_the_program_is_a_failure(self):
        metadata = '{"packages":[],"target_directory":"/somewhere/target","version":1}'
        self.program("cargo", f"echo '{metadata}'")
        self.assertEqual(self.run_script("program.sh"), (0, "", "/somewhere/target/release/centaur\n"))
        self.program("cargo", "echo 'error: no manifest' >&2; exit 101")
        self.assertEqual(self.run_script("program.sh"), (101, "error: no manifest\n", ""))
        self.program("cargo", "echo '{}'")
        self.assertEqual(self.run_script("program.sh"), (1, "error: cargo metadata: expected a target_directory, found none\n", ""))

    def test_packages_are_installed_where_their_lists_are_old(self):
        self.program("sudo", 'exec "$@"')
        self.program("sleep", "")
        self.program("apt-get", f'case $* in *update*) exit 100 ;; *" two"*) echo "$*" >>{self.folder}/installed ;; *) exit 100 ;; esac')
        code, said, printed = self.run_script("install.sh", "one", "two")
        self.assertEqual((code, printed), (0, "installing one two\n"))
        self.assertEqual(said, "warning: apt-get update failed: installing what the lists know that are there\n")
        self.assertTrue((self.folder / "installed").read_text().endswith(" one two\n"))
        code, said, _ = self.run_script("install.sh", "three")
        self.assertEqual((code, said.splitlines()[-1]), (1, "error: could not install three"))

    def test_ignored_tests_that_are_not_there_are_a_failure(self):
        log = self.folder / "log"
        self.program("cargo", f'case $* in *--list*there*) echo "there::is_one: test" ;; *--list*) ;; *) echo "$*" >{log} ;; esac')
        self.assertEqual(self.run_script("run-ignored-tests.sh", "there::", "--nocapture")[0], 0)
        self.assertTrue(log.read_text().endswith("--no-fail-fast -- --ignored there:: --nocapture\n"))
        log.unlink()
        failed = (1, "error: no ignored test has elsewhere:: in its name\n", "")
        self.assertEqual(self.run_script("run-ignored-tests.sh", "there::", "elsewhere::"), failed)
        self.assertFalse(log.exists())

    def test_pythons_that_are_too_old_are_named(self):
        major, minor = sys.version_info[:2]
        for wanted, code in [("3.6", 0), (f"={major}.{minor}", 0), (f"{major}.{minor + 1}", 1), (f"={major}.{minor + 1}", 1)]:
            self.assertEqual(self.run_script("ensure-python.sh", wanted, sys.executable)[0], code, wanted)
        said = self.run_script("ensure-python.sh", "3.11", "/none/python")[1]
        self.assertTrue(said.startswith("error: expected Python 3.11 or later, found none that runs (/none/python): "), said)

    def test_captures_are_linked_by_their_whole_path(self):
        scenes, capture = self.folder / "scenes", self.folder / "data set/capture_skull66"
        scenes.mkdir()
        (capture / "sparse").mkdir(parents=True)
        shutil.copytree(HERE, self.folder / "scripts", ignore=shutil.ignore_patterns("__pycache__"))
        self.program("realpath", "exit 1")
        env = {**os.environ, "PATH": f"{self.folder}:{os.environ['PATH']}", "CENTAUR_DATA": "data set"}
        for _ in range(2):
            linked = ["bash", "-euc", "scenes=scenes; . scripts/link-captures.sh"]
            done = subprocess.run(linked, cwd=self.folder, env=env, capture_output=True, text=True)
            self.assertEqual((done.returncode, done.stderr), (0, ""))
            self.assertEqual([(p.name, os.readlink(p)) for p in scenes.iterdir()], [("skull66", str(capture.resolve()))])


if __name__ == "__main__":
    unittest.main()
