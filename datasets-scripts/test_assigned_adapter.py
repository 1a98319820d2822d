"""assigned_adapter on fictitious machines: python3 -m unittest discover datasets-scripts"""

import os
import subprocess
import sys
import unittest
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from assigned_adapter import adapter_of, assigned_gpu, choose, parse_buses


def machine(*adapters):
    """Adapters as listed by `centaur devices --json`."""
    return [{"index": i, "name": "A GPU", "kind": kind, "pci_bus_id": bus} for i, (kind, bus) in enumerate(adapters)]


CPU = ("Cpu", None)
# Vulkan's order differs from that of NVIDIA's tools.
TWO = machine(("DiscreteGpu", "0000:c1:00.0"), ("DiscreteGpu", "0000:41:00.0"), CPU)
BUSES = parse_buses("0, GPU-aa, 00000000:41:00.0\n1, GPU-bb, 00000000:C1:00.0\n")


class Mapping(unittest.TestCase):
    def test_by_bus(self):
        for gpu, expected in [("0", "0000:41:00.0"), ("1", "0000:c1:00.0"), ("GPU-bb", "0000:c1:00.0"), (None, None)]:
            self.assertEqual(choose(gpu, TWO, BUSES), expected)

    def test_by_number_where_buses_are_not_known(self):
        self.assertEqual([choose(gpu, TWO, {}) for gpu in "01"], ["0000:c1:00.0", "0000:41:00.0"])
        mute = machine(("DiscreteGpu", None), ("DiscreteGpu", None), CPU)
        for buses in [{}, BUSES]:
            self.assertEqual([choose(gpu, mute, buses) for gpu in "01"], ["#0", "#1"])

    def test_one_or_none_is_no_choice(self):
        for adapters in [[], machine(CPU), machine(("DiscreteGpu", "0000:41:00.0"), CPU)]:
            self.assertIsNone(choose("3", adapters, BUSES))
        # Two drivers for one GPU.
        self.assertIsNone(choose("0", machine(*[("DiscreteGpu", "0000:41:00.0")] * 2, CPU), BUSES))

    def test_a_gpu_without_adapter_is_an_error(self):
        elsewhere = {"0": "0000:01:00.0"}
        for gpu, buses in [("2", BUSES), ("0", elsewhere), ("GPU-cc", BUSES), ("MIG-aa", {})]:
            with self.assertRaisesRegex(LookupError, f"^GPU {gpu}.*: expected it among adapters, found 0000:c1:00.0, 0000:41:00.0$"):
                choose(gpu, TWO, buses)

    def test_domains_are_shortened_and_kept(self):
        said = "No devices were found\n0, GPU-aa, [N/A]\nUnable to determine the device handle for GPU0: 0000:41:00.0: Unknown Error\n"
        self.assertEqual(parse_buses(said), {})
        self.assertEqual(parse_buses("7, GPU-aa, 00000009:0A:00.0\n"), dict.fromkeys(["7", "GPU-aa"], "0009:0a:00.0"))


class Assigned(unittest.TestCase):
    def test_variables(self):
        for environment, expected in [
            ({}, None),
            ({"CUDA_VISIBLE_DEVICES": ""}, None),
            ({"CUDA_VISIBLE_DEVICES": "NoDevFiles"}, None),
            ({"CUDA_VISIBLE_DEVICES": "3,1"}, "3"),
            ({"CUDA_VISIBLE_DEVICES": "", "ROCR_VISIBLE_DEVICES": "1"}, "1"),
            ({"HIP_VISIBLE_DEVICES": "2"}, "2"),
        ]:
            self.assertEqual(assigned_gpu(environment), expected)

    def test_the_program_is_asked_only_where_a_gpu_is_assigned(self):
        self.assertIsNone(adapter_of(None, ["/nonexistent"]))
        failing = [sys.executable, "-c", "import sys; sys.exit('error: no driver')"]
        with self.assertRaisesRegex(LookupError, "^no driver$"):
            adapter_of("0", failing)

    def test_help_is_of_this_script(self):
        script = [sys.executable, str(Path(__file__).with_name("assigned_adapter.py"))]
        for words, code in (["--help"], 0), (["-h"], 0), (["--none"], 2):
            done = subprocess.run([*script, *words], capture_output=True, text=True)
            self.assertEqual(done.returncode, code)
            self.assertIn("usage: assigned_adapter.py", done.stderr if code else done.stdout)
        # Options after the program belong to the program.
        echo = [sys.executable, "-c", "import sys; sys.exit(f'error: {sys.argv[1:]}')", "--help"]
        done = subprocess.run([*script, *echo], capture_output=True, text=True, env={**os.environ, "CUDA_VISIBLE_DEVICES": "0"})
        self.assertEqual(done.stderr, "error: ['--help', 'devices', '--json']\n")


if __name__ == "__main__":
    unittest.main()
