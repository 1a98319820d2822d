"""What make would run: python3 -m unittest discover -s scripts"""

import os
import shlex
import subprocess
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Those that name files by absolute paths.
TARGETS = ["oracle-gsplat", "oracle-lpips", "oracle-splat-transform", "oracle-usd", "oracle-tint", "convert-times"]


class Makefile(unittest.TestCase):
    def test_the_repository_may_lie_in_a_folder_with_a_space_in_its_name(self):
        with tempfile.TemporaryDirectory(prefix="make") as parent:
            folder = Path(parent).resolve() / "a b"
            folder.mkdir()
            for name in ["Makefile", "datasets-scripts", "scripts", "tests"]:
                (folder / name).symlink_to(ROOT / name)
            own = ("CENTAUR_GSPLAT_FIXTURE", "MAKEFLAGS", "MAKELEVEL", "MFLAGS")
            env = {name: value for name, value in os.environ.items() if name not in own}
            commands = subprocess.run(["make", "-n", *TARGETS], cwd=folder, env=env, capture_output=True, text=True, check=True)
            lines = commands.stdout.replace("\\\n", "").splitlines()
            words = [word for line in lines for word in shlex.split(line)]
            absolute = [word for word in words if str(folder.parent) in word]
            self.assertGreater(len(absolute), 3)
            self.assertEqual([word for word in absolute if str(folder) not in word], [])


if __name__ == "__main__":
    unittest.main()
