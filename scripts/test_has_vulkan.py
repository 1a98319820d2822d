"""has-vulkan.sh: python3 -m unittest discover -s scripts"""

import os
import subprocess
import unittest
from pathlib import Path

SCRIPT = Path(__file__).parent / "has-vulkan.sh"


class HasVulkan(unittest.TestCase):
    def test_a_user_without_a_home_has_the_drivers_of_the_system(self):
        with_home = {"PATH": os.environ["PATH"], "HOME": "/none"}
        found = [subprocess.run([SCRIPT], env=env, capture_output=True, text=True) for env in (with_home, {"PATH": with_home["PATH"]})]
        self.assertEqual([run.stderr for run in found], ["", ""])
        self.assertEqual(found[0].returncode, found[1].returncode)


if __name__ == "__main__":
    unittest.main()
