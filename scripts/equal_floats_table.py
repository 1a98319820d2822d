"""Hybrid beside splats alone, from folders of `centaur bench` with the variants `hybrid` and `splats`: a table in Markdown.

python3 scripts/equal_floats_table.py out/equal-floats/400000 out/equal-floats/800000
"""

import json
import sys
from pathlib import Path

VARIANTS = ("hybrid", "splats")
# Columns without differences.
SIZES = ("floats", "file, MB", "s/iteration")
# Column, number of evaluation["…"] and its digits.
COLUMNS = [
    ("PSNR", lambda e: e["psnr"], 2),
    ("SSIM", lambda e: e["ssim_inria"], 3),
    ("FLIP", lambda e: e.get("flip"), 4),
    ("LPIPS 0…1", lambda e: (e.get("lpips") or {}).get("unnormalized"), 3),
    ("splats", lambda e: e["splats"], 0),
    ("floats", lambda e: e["total_floats"], 0),
    ("file, MB", lambda e: e["file_bytes"] / 1e6, 2),
    ("s/iteration", lambda e: e.get("seconds_per_iteration"), 3),
]


def results(folder, variants=VARIANTS):
    """{scene: {variant: [evaluation of every seed]}} of one folder of `centaur bench`, each with its seed."""
    scenes = {}
    for variant in variants:
        for file in sorted((folder / variant).glob("*.json")):
            result = json.loads(file.read_text())
            if "job" in result:
                job, evaluation = result["job"], {**result["evaluation"], "seed": result["job"]["seed"]}
                # Jobs that shared a machine took longer by it.
                if job.get("at_a_time") != 1:
                    evaluation.pop("seconds_per_iteration", None)
                scenes.setdefault(job["scene"], {v: [] for v in variants})[variant].append(evaluation)
    return scenes


def mean(values):
    values = [v for v in values if v is not None]
    return sum(values) / len(values) if values else None


def written(value, digits, sign=""):
    return "–" if value is None else f"{value:{sign},.{digits}f}"


def cells(pairs):
    """Of (value of hybrid, value of splats) per column, with their differences; splats as a share."""
    row = []
    for (name, _, digits), (a, b) in zip(COLUMNS, pairs):
        row += [written(a, digits), written(b, digits)]
        if name == "splats":
            row.append("–" if None in (a, b) else f"{100 * (a / b - 1):+.0f} %")
        elif name not in SIZES:
            row.append(written(None if None in (a, b) else a - b, digits, "+"))
    return row


def table(folders):
    head = ["capture", "budget", "seeds"]
    for name, _, _ in COLUMNS:
        head += [f"{name}: hybrid", "splats alone"] + ([] if name in SIZES else ["difference"])
    lines = [head, ["---"] * 3 + ["---:"] * (len(head) - 3)]
    budgets = {folder.name: results(folder) for folder in folders}
    for scene in sorted({s for scenes in budgets.values() for s in scenes}):
        for budget, scenes in budgets.items():
            if scene in scenes:
                runs = scenes[scene]
                pairs = [tuple(mean([value(e) for e in runs[v]]) for v in VARIANTS) for _, value, _ in COLUMNS]
                counts = [len(runs[v]) for v in VARIANTS]
                seeds = str(counts[0]) if counts[0] == counts[1] else "/".join(map(str, counts))
                lines.append([scene, budget, seeds] + cells(pairs))
    for budget, scenes in budgets.items():
        whole = [runs for runs in scenes.values() if all(runs.values())]
        # Of FLIP and LPIPS, only if every capture has it.
        per_scene = lambda value, v: [mean([value(e) for e in runs[v]]) for runs in whole]
        pairs = [tuple(None if None in (all_of := per_scene(value, v)) else mean(all_of) for v in VARIANTS) for _, value, _ in COLUMNS]
        if whole:
            lines.append([f"**mean of {len(whole)}**", budget, ""] + cells(pairs))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def caption(folders):
    """What the numbers are, with whose features LPIPS compares."""
    evaluations = [e for folder in folders for runs in results(folder).values() for v in VARIANTS for e in runs[v]]
    nets = sorted({e["lpips"]["net"] for e in evaluations if e.get("lpips")})
    by = f" by {' and '.join(nets)}" if nets else ""
    return (
        f"Held-out views, 8-bit; SSIM as INRIA computes it, FLIP, and LPIPS{by} of pictures in 0…1, as INRIA's script has it "
        "(lower is better); differences: hybrid less splats alone.\n"
    )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    budgets = sorted(map(Path, sys.argv[1:]), key=lambda folder: (len(folder.name), folder.name))
    print(caption(budgets))
    print(table(budgets))
