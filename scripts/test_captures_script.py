"""captures.sh with a stand-in for centaur: python3 -m unittest discover -s scripts"""

import os
import subprocess
import tempfile
import unittest
from pathlib import Path

SCRIPT = Path(__file__).parent / "captures.sh"
# Stops in its first training and fails in its third, once each, after printing something.
CENTAUR = """#!/bin/sh
echo "$*" >>log
n=$(wc -l <log)
while [ "$1" != -o ]; do shift; done
case $n in
1) : >"$2.checkpoint"; echo '{"outcome":"interrupted"}'; exit 143 ;;
3) : >"$2.checkpoint"; echo '{"outcome":'; exit 1 ;;
esac
rm -f "$2.checkpoint"
echo '{"outcome":"finished","seconds_per_iteration":0.1,"evaluation":{"psnr":20,"ssim_inria":0.5,"splats":1,"triangles":2,"total_floats":3,"file_bytes":4}}'
"""
CARGO = """#!/bin/sh
[ "$1" = metadata ] && echo '{"target_directory":"FOLDER/target","version":1}'
exit 0
"""


class Captures(unittest.TestCase):
    def test_what_is_done_is_not_done_again_and_what_was_stopped_goes_on(self):
        with tempfile.TemporaryDirectory() as folder:
            program, out = Path(folder, "centaur"), Path(folder, "out")
            program.write_text(CENTAUR.replace("log", f"{folder}/log"))
            program.chmod(0o755)
            env = {**os.environ, "CAPTURES_CENTAUR": str(program), "CAPTURES_OUT": str(out), "CENTAUR_DATA": "/none"}
            runs = [subprocess.run([SCRIPT, "7"], env=env, capture_output=True, text=True) for _ in range(4)]
            self.assertEqual([run.returncode for run in runs], [143, 1, 0, 0])
            self.assertEqual([run.stderr for run in runs], ["demo: stopped; the same command goes on\n", "", "", ""])
            self.assertEqual(runs[3].stdout, runs[2].stdout)
            self.assertEqual(runs[2].stdout.count("20.00 dB"), 2)
            commands = Path(folder, "log").read_text().splitlines()
            self.assertEqual(["--resume" in command for command in commands], [False, True, False, True])
            self.assertEqual(["--no-mesh" in command for command in commands], [False, False, True, True])
            self.assertEqual(sorted(file.name for file in out.iterdir()), ["demo-hybrid-7.json", "demo-splats-7.json"])

    def test_what_is_built_meanwhile_has_no_part_in_a_series(self):
        with tempfile.TemporaryDirectory() as folder:
            built, out = Path(folder, "target/release/centaur"), Path(folder, "out")
            built.parent.mkdir(parents=True)
            for path, text in [
                (Path(folder, "cargo"), CARGO.replace("FOLDER", folder)),
                (built, f"#!/bin/sh\ncp {folder}/next {built}\n{CENTAUR.split(maxsplit=1)[1]}".replace("log", f"{folder}/log")),
                (Path(folder, "next"), "#!/bin/sh\nexit 9\n"),
            ]:
                path.write_text(text)
                path.chmod(0o755)
            Path(folder, "log").write_text("\n" * 9)
            env = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "CAPTURES_OUT": str(out), "CENTAUR_DATA": "/none", "TMPDIR": folder}
            env.pop("CAPTURES_CENTAUR", None)
            run = subprocess.run([SCRIPT, "7"], env=env, capture_output=True, text=True)
            self.assertEqual((run.returncode, run.stderr, run.stdout.count("20.00 dB")), (0, "", 2))
            self.assertEqual(built.read_text(), "#!/bin/sh\nexit 9\n")
            self.assertEqual(list(Path(folder).glob("centaur-program.*")), [])


if __name__ == "__main__":
    unittest.main()
