"""bench.sbatch as run by Slurm, with a program that only prints its arguments: python3 -m unittest discover
datasets-scripts"""

import json
import os
import shutil
import subprocess
import tempfile
import unittest
from pathlib import Path
from unittest import mock

HERE = Path(__file__).resolve().parent
JOBS = [f"default/scene{i}-0" for i in range(7)]
PROGRAM = f"""#!/usr/bin/env python3
import json, os, sys
if sys.argv[1:] == ["devices", "--json"]:
    adapter = {{"name": "A GPU", "kind": "DiscreteGpu"}}
    print(json.dumps([{{"index": i, "pci_bus_id": bus, **adapter}} for i, bus in enumerate(["0000:c1:00.0", "0000:41:00.0"])]))
else:
    part, of = map(int, sys.argv[sys.argv.index("--shard") + 1].split("/"))
    print(json.dumps({{"words": sys.argv[1:], "jobs": {JOBS}[part::of], "adapter": os.environ.get("CENTAUR_ADAPTER")}}))
"""
NVIDIA_SMI = "#!/bin/sh\nprintf '0, GPU-aa, 00000000:41:00.0\\n1, GPU-bb, 00000000:C1:00.0\\n'\n"


class Array(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        for name, text in [("bin/centaur", PROGRAM), ("bin/nvidia-smi", NVIDIA_SMI)]:
            path = self.folder / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
            path.chmod(0o755)
        # Slurm runs a copy of the file, in the folder from which it was submitted.
        shutil.copy(HERE / "bench.sbatch", self.folder / "slurm_script")

    def task(self, ids, i, gpu=None, submitted_from=HERE.parent):
        ours = ["SLURM_", "CENTAUR_ADAPTER", "CENTAUR_PROGRAM", "CUDA_", "ROCR_", "HIP_"]
        environment = {name: value for name, value in os.environ.items() if not name.startswith(tuple(ours))}
        environment["PATH"] = f"{self.folder / 'bin'}:{environment['PATH']}"
        environment["SLURM_SUBMIT_DIR"] = str(submitted_from)
        for name, value in [("ID", i), ("COUNT", len(ids)), ("MIN", min(ids)), ("MAX", max(ids))]:
            environment[f"SLURM_ARRAY_TASK_{name}"] = str(value)
        if gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = gpu
        command = ["bash", self.folder / "slurm_script", "data set", "-o", "out", "--", "--no-mesh"]
        return subprocess.run(command, env=environment, cwd=self.folder, capture_output=True, text=True)

    def said(self, *arguments):
        done = self.task(*arguments)
        self.assertEqual((done.returncode, done.stderr), (0, ""))
        return json.loads(done.stdout)

    def test_tasks_do_all_jobs_once(self):
        for ids in [range(3), range(1, 4), range(9), [5]]:
            done = [job for i in ids for job in self.said(ids, i)["jobs"]]
            self.assertEqual(sorted(done), JOBS, ids)

    def test_options_are_handed_on(self):
        said = self.said(range(4), 2)
        self.assertEqual(said["words"], ["bench", "--shard", "2/4", "--wait", "1800", "data set", "-o", "out", "--", "--no-mesh"])
        self.assertIsNone(said["adapter"])
        with mock.patch.dict(os.environ, CENTAUR_WAIT="5"):
            self.assertEqual(self.said(range(4), 2)["words"][:5], ["bench", "--shard", "2/4", "--wait", "5"])

    def test_each_task_has_its_gpu(self):
        self.assertEqual([self.said(range(2), i, str(i))["adapter"] for i in range(2)], ["0000:41:00.0", "0000:c1:00.0"])

    def test_help_is_for_all_outside_slurm(self):
        environment = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
        for word in ("--help", "-h"):
            done = subprocess.run(["bash", HERE / "bench.sbatch", word], env=environment, capture_output=True, text=True)
            self.assertEqual((done.returncode, done.stderr), (0, ""))
            self.assertIn("\n  sbatch --array=0-8 datasets-scripts/bench.sbatch DATASET -o OUT", done.stdout)
            self.assertIn("\nWhere tasks have failed or their time was up, submit the same again", done.stdout)
            self.assertNotIn("#", done.stdout)

    def test_what_would_leave_jobs_undone_is_refused(self):
        for arguments, expected in [
            (([0, 2, 4], 2), "error: expected an array without gaps, found 3 tasks from 0 to 4\n"),
            ((range(2), ""), "error: expected a task of an array, as of: sbatch --array=0-8 bench.sbatch DATASET -o OUT\n"),
            ((range(2), 0, "7"), "error: GPU 7: expected it among adapters, found 0000:c1:00.0, 0000:41:00.0\n"),
            (
                (range(2), 0, None, self.folder),
                f"error: {self.folder}/datasets-scripts/assigned_adapter.py: expected a file, found none: submit from the repository's folder\n",
            ),
        ]:
            done = self.task(*arguments)
            self.assertEqual((done.returncode, done.stdout, done.stderr), (1, "", expected))


if __name__ == "__main__":
    unittest.main()
