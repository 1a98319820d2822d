"""Differences between per-splat orders and the direct order, from folders of `centaur bench` with the variants below: a
Markdown table.

python3 scripts/order_modes_table.py out/order-modes
"""

import sys
from pathlib import Path

from equal_floats_table import results, written

DIRECT = "direct"
COMPARED = ("stable", "surface-consistent")
# Column, key in evaluation["…"], number of digits, and the sign of an improvement.
COLUMNS = [
    ("PSNR", lambda e: e["psnr"], 3, 1),
    ("SSIM", lambda e: e["ssim_inria"], 4, 1),
    ("FLIP", lambda e: e.get("flip"), 4, -1),
]


def differences(runs, variant, value):
    """Differences of pairs with equal seeds."""
    direct = {e["seed"]: e for e in runs[DIRECT]}
    pairs = [(value(e), value(direct[e["seed"]])) for e in runs[variant]]
    return [a - b for a, b in pairs if None not in (a, b)]


def summary(found, digits, better):
    """Mean ± its standard error, and the number of pairs in which the first is better."""
    n = len(found)
    if n == 0:
        return ["–", "–"]
    mean = sum(found) / n
    error = (sum((d - mean) ** 2 for d in found) / (n - 1) / n) ** 0.5 if n > 1 else None
    wins = sum(better * d > 0 for d in found)
    return [written(mean, digits, "+") + (f" ± {error:.{digits}f}" if error is not None else ""), f"{wins} of {n}"]


def row(name, variant, scenes):
    cells = []
    for _, value, digits, better in COLUMNS:
        cells += summary([d for runs in scenes for d in differences(runs, variant, value)], digits, better)
    return [name, variant] + cells


def table(folder):
    head = ["scene", "order"]
    for name, *_ in COLUMNS:
        head += [f"{name} less direct's", "better in"]
    lines, whole = [head, ["---"] * 2 + ["---:"] * (len(head) - 2)], []
    for bench in sorted(path for path in folder.iterdir() if path.is_dir()):
        for scene, runs in results(bench, (*COMPARED, DIRECT)).items():
            if len({frozenset(e["seed"] for e in of) for of in runs.values()}) > 1:
                print(f"{scene}: left out, not all of its runs are done", file=sys.stderr)
                continue
            whole.append(runs)
            lines += [row(scene, variant, [runs]) for variant in COMPARED]
    lines += [row("**all**", variant, whole) for variant in COMPARED]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    print("Held-out views, 8-bit; pairs of one seed each, ± the standard error of the mean of their differences.\n")
    print(table(Path(sys.argv[1])))
