"""order-modes.sh with stand-ins for centaur and Python: python3 -m unittest discover -s scripts"""

import os
import subprocess
import tempfile
import unittest
from pathlib import Path

SCRIPT = Path(__file__).parent / "order-modes.sh"


class OrderModes(unittest.TestCase):
    def test_a_surface_is_made_anew_where_scripts_are_newer(self):
        with tempfile.TemporaryDirectory() as folder:
            out, surface = Path(folder, "out"), Path(folder, "surface")
            truth = out / "demo.ply"
            for name, line in [("centaur", "exit 0"), ("python", f'echo made >>{folder}/log; cp {surface} "$3"')]:
                program = Path(folder, name)
                program.write_text(f"#!/bin/sh\n{line}\n")
                program.chmod(0o755)
            env = {**os.environ, "CENTAUR_DATA": "/none", "ORDER_MODES_OUT": str(out)}
            env |= {"ORDER_MODES_CENTAUR": f"{folder}/centaur", "ORDER_MODES_PYTHON": f"{folder}/python"}

            def run():
                done = subprocess.run([SCRIPT], env=env, capture_output=True, text=True)
                return done.returncode, done.stderr, Path(folder, "log").read_text().count("made")

            surface.write_text("one")
            made = run()[2]
            self.assertEqual((truth.read_text(), run()), ("one", (0, "", made)), "made once")
            os.utime(truth, (0, 0))
            self.assertEqual((run()[0], truth.stat().st_mtime > 0), (0, True), "the same surface")
            # The other scene has no results.
            surface.write_text("two")
            os.utime(truth, (0, 0))
            self.assertEqual((run()[0], truth.read_text()), (0, "two"))
            surface.write_text("three")
            os.utime(truth, (0, 0))
            (out / "demo").mkdir()
            code, said, _ = run()
            expected = f"error: {out}/demo: its results are of another surface than scripts make now: delete it and {truth}\n"
            self.assertEqual((code, said, truth.read_text()), (1, expected, "two"))

    def test_a_stopped_bench_stops_its_script_and_a_failed_one_does_not(self):
        for script, variable, most in (("order-modes.sh", "ORDER_MODES", 1), ("equal-floats.sh", "EQUAL_FLOATS", 2)):
            for code, benches in ((143, 1), (1, most)):
                with self.subTest(script=script, code=code), tempfile.TemporaryDirectory() as folder:
                    # Where Python is called for a surface, that is its third argument.
                    table = f"{folder}/table"
                    for name, line in [
                        ("centaur", f"echo bench >>{folder}/log; exit {code}"),
                        ("python3", f'case $1 in *table.py) : >{table} ;; *) : >"$3" ;; esac'),
                    ]:
                        program = Path(folder, name)
                        program.write_text(f"#!/bin/sh\n{line}\n")
                        program.chmod(0o755)
                    env = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "CENTAUR_DATA": "/none", "EQUAL_FLOATS_BUDGETS": "1 2"}
                    env |= {f"{variable}_OUT": f"{folder}/out", f"{variable}_CENTAUR": f"{folder}/centaur"}
                    env |= {"ORDER_MODES_PYTHON": f"{folder}/python3"}
                    done = subprocess.run([SCRIPT.with_name(script)], env=env, capture_output=True, text=True)
                    self.assertEqual((done.returncode, done.stderr, Path(table).exists()), (code, "", code == 1))
                    # Other scenes may have been made here.
                    count = Path(folder, "log").read_text().count("bench")
                    self.assertTrue(count == benches or code == 1 and count >= benches, count)


if __name__ == "__main__":
    unittest.main()
