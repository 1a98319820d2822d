"""ensure-blender.sh: python3 -m unittest discover -s scripts"""

import os
import subprocess
import tempfile
import unittest
from pathlib import Path

SCRIPT = Path(__file__).parent / "ensure-blender.sh"


class EnsureBlender(unittest.TestCase):
    def test_nothing_is_asked_of_macos_which_has_another_realpath(self):
        with tempfile.TemporaryDirectory() as folder:
            for name, line in [("uname", "echo Darwin"), ("realpath", "echo 'illegal option -- s' >&2; exit 1")]:
                program = Path(folder, name)
                program.write_text(f"#!/bin/sh\n{line}\n")
                program.chmod(0o755)
            env = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}
            run = subprocess.run([SCRIPT, ".venv-blender/bin/python"], env=env, capture_output=True, text=True)
            self.assertEqual((run.returncode, run.stderr), (0, ""))


if __name__ == "__main__":
    unittest.main()
