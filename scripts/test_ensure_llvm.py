"""ensure-llvm.sh: python3 -m unittest discover -s scripts"""

import os
import shutil
import subprocess
import tempfile
import unittest
from pathlib import Path

SCRIPT = Path(__file__).parent / "ensure-llvm.sh"


class EnsureLlvm(unittest.TestCase):
    def test_libraries_of_another_machine_are_not_enough(self):
        with tempfile.TemporaryDirectory() as parent:
            folder = Path(parent).resolve()
            script = shutil.copy(SCRIPT, folder)
            for name, lines in [("install.sh", 'echo "$@"'), ("uname", 'if [ "${1:-}" = -m ]; then echo x86_64; else echo Linux; fi')]:
                program = folder / name
                program.write_text(f"#!/bin/sh\n{lines}\n")
                program.chmod(0o755)
            env = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}"}
            env.pop("DRJIT_LIBLLVM_PATH", None)
            installed = lambda: subprocess.run([script, folder], env=env, capture_output=True, text=True, check=True).stdout
            for name, expected in [
                ("i386-linux-gnu/libLLVM.so.19.1", "libllvm19\n"),
                ("x86_64-linux-gnu/libLLVM-15.so.1", "libllvm19\n"),
                ("x86_64-linux-gnu/libLLVM.so.19.1", ""),
            ]:
                path = folder / name
                path.parent.mkdir(exist_ok=True)
                path.touch()
                self.assertEqual(installed(), expected, name)


if __name__ == "__main__":
    unittest.main()
