"""Commands that make would run: python3 -m unittest discover -s scripts"""

import os
import shlex
import subprocess
import tempfile
import unittest
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Targets that use absolute paths of files.
TARGETS = ["oracle-gsplat", "oracle-lpips", "oracle-splat-transform", "oracle-usd", "oracle-tint", "convert-times"]
TARGETS += ["crosscheck", "oracle-composition"]


class Makefile(unittest.TestCase):
    def test_the_repository_and_data_may_lie_in_folders_with_spaces_in_their_names(self):
        with tempfile.TemporaryDirectory(prefix="make") as parent:
            folder, data = Path(parent).resolve() / "a b", Path(parent).resolve() / "c d"
            folder.mkdir()
            for name in ["Makefile", "datasets-scripts", "scripts", "tests"]:
                (folder / name).symlink_to(ROOT / name)
            own = ("CENTAUR_GSPLAT_FIXTURE", "MAKEFLAGS", "MAKELEVEL", "MFLAGS")
            env = {name: value for name, value in os.environ.items() if name not in own}
            env |= {"CENTAUR_DATA": str(data), "TRAINED": str(data / "scene.glb")}
            commands = subprocess.run(["make", "-n", *TARGETS], cwd=folder, env=env, capture_output=True, text=True, check=True)
            words = shlex.split(commands.stdout.replace("\\\n", ""), comments=True)
            absolute = [word for word in words if str(folder.parent) in word]
            self.assertGreater(len([word for word in absolute if str(folder) in word]), 3)
            of_data = [word for word in absolute if word.startswith(f"{data}/")]
            samples = [word for word in of_data if "/meshes_gltf_samples/" in word and Path(word).suffix in (".glb", ".gltf")]
            self.assertEqual((len(samples), of_data.count(f"{data}/scene.glb")), (5, 1))
            self.assertIn(f"{data}/oracle_gsplat/assets/test_garden.npz", of_data)
            self.assertEqual([word for word in absolute if str(folder) not in word and word not in of_data], [])


if __name__ == "__main__":
    unittest.main()
