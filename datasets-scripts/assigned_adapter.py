"""Which of a machine's adapters is the GPU that a scheduler assigned.

  export CENTAUR_ADAPTER=$(python3 assigned_adapter.py centaur)

Ray and Slurm say it in CUDA_VISIBLE_DEVICES (AMD's in ROCR_ or HIP_VISIBLE_DEVICES), of which Vulkan knows nothing, and number GPUs
otherwise than `centaur devices`. Prints nothing where there is no choice: without a GPU assigned, or with one in the machine.
"""

import argparse
import json
import os
import re
import subprocess

VARIABLES = ["CUDA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES"]
# What stands there where none is assigned; the last is Slurm's.
NONE = ["", "-1", "none", "NoDevFiles"]
BUS = re.compile(r"[0-9A-Fa-f]{4,8}:[0-9A-Fa-f]{2}:[0-9A-Fa-f]{2}\.[0-7]")


def assigned_gpu(environment):
    """The first GPU of this process, an index or a UUID, or None."""
    given = [environment.get(name, "").split(",")[0].strip() for name in VARIABLES]
    return next((gpu for gpu in given if gpu not in NONE), None)


def choose(gpu, adapters, buses):
    """What CENTAUR_ADAPTER is to be for that GPU, or None where there is no choice.

    `adapters` as `centaur devices --json` lists them; `buses`: PCI bus ids by index and UUID, none without NVIDIA's tools.
    """
    # One GPU that two drivers know is listed twice.
    hardware = list(dict.fromkeys(a["pci_bus_id"] or f"#{a['index']}" for a in adapters if a["kind"] != "Cpu"))
    if gpu is None or len(hardware) < 2:
        return None
    bus = buses.get(gpu)
    if bus in hardware:
        return bus
    # By number only where nothing says that it is another: jobs of different GPUs then have different adapters.
    if (bus is None or all(a.startswith("#") for a in hardware)) and gpu.isdecimal() and int(gpu) < len(hardware):
        return hardware[int(gpu)]
    raise LookupError(f"GPU {gpu}{f' at {bus}' if bus else ''}: expected it among adapters, found {', '.join(hardware)}")


def nvidia_buses():
    """PCI bus ids by index and UUID, written as wgpu writes them."""
    query = ["nvidia-smi", "--query-gpu=index,uuid,pci.bus_id", "--format=csv,noheader"]
    try:
        listed = subprocess.run(query, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    except OSError:
        return {}
    return parse_buses(listed.stdout) if listed.returncode == 0 else {}


def parse_buses(text):
    """From lines such as `0, GPU-5e1c…, 00000000:C1:00.0`."""
    buses = {}
    for line in text.splitlines():
        words = [word.strip() for word in line.split(",")]
        # It says in words, too, that there is no GPU, or of one that it does not know where it is.
        if len(words) != 3 or not BUS.fullmatch(words[2]):
            continue
        index, uuid, bus = words
        domain, rest = bus.lower().split(":", 1)
        buses[index] = buses[uuid] = f"{int(domain, 16):04x}:{rest}"
    return buses


def adapter_of(gpu, program):
    """As `choose`, of this machine; `program` is how to call `centaur`, in words."""
    if gpu is None:
        return None
    listed = subprocess.run([*program, "devices", "--json"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if listed.returncode:
        said = listed.stderr.strip().splitlines() or ["centaur devices failed"]
        raise LookupError(said[-1].removeprefix("error: "))
    return choose(gpu, json.loads(listed.stdout), nvidia_buses())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", nargs=argparse.REMAINDER, help="how to call centaur, in words (default: centaur)")
    program = parser.parse_args().program or ["centaur"]
    try:
        adapter = adapter_of(assigned_gpu(os.environ), program)
    except (LookupError, OSError, ValueError) as e:
        raise SystemExit(f"error: {e}")
    if adapter:
        print(adapter)


if __name__ == "__main__":
    main()
