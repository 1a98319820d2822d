"""Prints which of a machine's adapters is the GPU that a scheduler assigned.

  export CENTAUR_ADAPTER=$(python3 assigned_adapter.py centaur)

Ray and Slurm state it in CUDA_VISIBLE_DEVICES (for AMD in ROCR_ or HIP_VISIBLE_DEVICES), which Vulkan does not use, and
number GPUs differently from `centaur devices`. Prints nothing if there is no choice: no GPU is assigned, or the machine
has only one.
"""

import argparse
import json
import os
import re
import subprocess

VARIABLES = ["CUDA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES"]
# Values if no GPU is assigned; the last is Slurm's.
NONE = ["", "-1", "none", "NoDevFiles"]
BUS = re.compile(r"[0-9A-Fa-f]{4,8}:[0-9A-Fa-f]{2}:[0-9A-Fa-f]{2}\.[0-7]")


def assigned_gpu(environment):
    """The first GPU of this process, an index or a UUID, or None."""
    given = [environment.get(name, "").split(",")[0].strip() for name in VARIABLES]
    return next((gpu for gpu in given if gpu not in NONE), None)


def choose(gpu, adapters, buses):
    """Returns the value of CENTAUR_ADAPTER for that GPU, or None if there is no choice.

    `adapters` are those listed by `centaur devices --json`; `buses` are PCI bus ids by index and UUID, empty without
    NVIDIA's tools.
    """
    # A GPU that two drivers support is listed twice.
    hardware = list(dict.fromkeys(a["pci_bus_id"] or f"#{a['index']}" for a in adapters if a["kind"] != "Cpu"))
    if gpu is None or len(hardware) < 2:
        return None
    bus = buses.get(gpu)
    if bus in hardware:
        return bus
    # By index only if nothing contradicts it: jobs with different GPUs then have different adapters.
    if (bus is None or all(a.startswith("#") for a in hardware)) and gpu.isdecimal() and int(gpu) < len(hardware):
        return hardware[int(gpu)]
    raise LookupError(f"GPU {gpu}{f' at {bus}' if bus else ''}: expected it among adapters, found {', '.join(hardware)}")


def nvidia_buses():
    """PCI bus ids by index and UUID, in wgpu's notation."""
    query = ["nvidia-smi", "--query-gpu=index,uuid,pci.bus_id", "--format=csv,noheader"]
    try:
        listed = subprocess.run(query, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    except OSError:
        return {}
    return parse_buses(listed.stdout) if listed.returncode == 0 else {}


def parse_buses(text):
    """Parses lines such as `0, GPU-5e1c…, 00000000:C1:00.0`."""
    buses = {}
    for line in text.splitlines():
        words = [word.strip() for word in line.split(",")]
        # nvidia-smi also prints sentences, if there is no GPU, or one of unknown location.
        if len(words) != 3 or not BUS.fullmatch(words[2]):
            continue
        index, uuid, bus = words
        domain, rest = bus.lower().split(":", 1)
        buses[index] = buses[uuid] = f"{int(domain, 16):04x}:{rest}"
    return buses


def adapter_of(gpu, program):
    """`choose` for this machine; `program` is the command of `centaur`, as a list of words."""
    if gpu is None:
        return None
    listed = subprocess.run([*program, "devices", "--json"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if listed.returncode:
        said = listed.stderr.strip().splitlines() or ["centaur devices failed"]
        raise LookupError(said[-1].removeprefix("error: "))
    return choose(gpu, json.loads(listed.stdout), nvidia_buses())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", nargs=argparse.REMAINDER, help="command to run centaur (default: centaur)")
    program = parser.parse_args().program or ["centaur"]
    try:
        adapter = adapter_of(assigned_gpu(os.environ), program)
    except (LookupError, OSError, ValueError) as e:
        raise SystemExit(f"error: {e}")
    if adapter:
        print(adapter)


if __name__ == "__main__":
    main()
