"""Compares hybrid with splats alone, from folders of `centaur bench` with the variants `hybrid` and `splats`: a
Markdown table.

python3 scripts/equal_floats_table.py out/equal-floats/400000 out/equal-floats/800000
"""

import json
import sys
from pathlib import Path

VARIANTS = ("hybrid", "splats")
# Columns without differences, and columns that splats alone do not have.
SIZES = ("triangles", "floats", "file, MB", "s/joint iteration")
OF_HYBRIDS = ("triangles",)
# Column, key in evaluation["…"] and number of digits.
COLUMNS = [
    ("PSNR", lambda e: e["psnr"], 2),
    ("SSIM", lambda e: e["ssim_inria"], 3),
    ("FLIP", lambda e: e.get("flip"), 4),
    ("LPIPS 0…1", lambda e: (e.get("lpips") or {}).get("unnormalized"), 3),
    ("splats", lambda e: e["splats"], 0),
    ("triangles", lambda e: e.get("triangles"), 0),
    ("floats", lambda e: e["total_floats"], 0),
    ("file, MB", lambda e: e["file_bytes"] / 1e6, 2),
    ("s/joint iteration", lambda e: e.get("seconds_per_iteration"), 3),
]


def results(folder, variants=VARIANTS):
    """{scene: {variant: [evaluation of every seed]}} for one folder of `centaur bench`, each evaluation with its
    seed."""
    scenes = {}
    for variant in variants:
        for file in sorted((folder / variant).glob("*.json")):
            result = json.loads(file.read_text())
            if "job" in result:
                job, evaluation = result["job"], {**result["evaluation"], "seed": result["job"]["seed"]}
                # Times of jobs that shared a machine are too long.
                if job.get("at_a_time") != 1:
                    evaluation.pop("seconds_per_iteration", None)
                scenes.setdefault(job["scene"], {v: [] for v in variants})[variant].append(evaluation)
    return scenes


def mean(values):
    values = [v for v in values if v is not None]
    return sum(values) / len(values) if values else None


def paired(runs, name):
    """Runs with seeds that all variants have, since seeds can differ as much as variants do; reports runs without a
    partner."""
    by_seed = {v: {e["seed"]: e for e in of} for v, of in runs.items()}
    common = set.intersection(*map(set, by_seed.values()))
    for v, of in by_seed.items():
        if alone := sorted(of.keys() - common):
            print(f"{name}: left out, {v} alone has seed {', '.join(map(str, alone))}", file=sys.stderr)
    return {v: [of[seed] for seed in sorted(common)] for v, of in by_seed.items()}


def means(runs, name, value):
    """Means per variant over paired runs; for columns with a difference, over pairs in which both have the value."""
    pairs = list(zip(*([value(e) for e in runs[v]] for v in VARIANTS)))
    if name not in SIZES:
        pairs = [pair for pair in pairs if None not in pair]
    return tuple(mean([pair[i] for pair in pairs]) for i in range(len(VARIANTS)))


def written(value, digits, sign=""):
    return "–" if value is None else f"{value:{sign},.{digits}f}"


def cells(pairs):
    """Cells for (value of hybrid, value of splats) per column, with differences where applicable; splats as a share."""
    row = []
    for (name, _, digits), (a, b) in zip(COLUMNS, pairs):
        row += [written(a, digits)] + ([] if name in OF_HYBRIDS else [written(b, digits)])
        if name == "splats":
            row.append("–" if None in (a, b) else f"{100 * (a / b - 1):+.0f} %")
        elif name not in SIZES:
            row.append(written(None if None in (a, b) else a - b, digits, "+"))
    return row


def table(folders):
    head = ["capture", "budget", "seeds"]
    for name, _, _ in COLUMNS:
        head += [f"{name}: hybrid"] + ([] if name in OF_HYBRIDS else ["splats alone"]) + ([] if name in SIZES else ["difference"])
    lines = [head, ["---"] * 3 + ["---:"] * (len(head) - 3)]
    budgets = {}
    for folder in folders:
        scenes = {scene: paired(runs, f"{folder.name}, {scene}") for scene, runs in results(folder).items()}
        budgets[folder.name] = {scene: runs for scene, runs in scenes.items() if all(runs.values())}
    for scene in sorted({s for scenes in budgets.values() for s in scenes}):
        for budget, scenes in budgets.items():
            if scene in scenes:
                runs = scenes[scene]
                pairs = [means(runs, name, value) for name, value, _ in COLUMNS]
                lines.append([scene, budget, str(len(runs[VARIANTS[0]]))] + cells(pairs))
    for budget, scenes in budgets.items():
        # FLIP and LPIPS only if every capture has them.
        of_scenes = [zip(*(means(runs, name, value) for runs in scenes.values())) for name, value, _ in COLUMNS]
        pairs = [tuple(None if None in all_of else mean(all_of) for all_of in column) for column in of_scenes]
        if scenes:
            lines.append([f"**mean of {len(scenes)}**", budget, ""] + cells(pairs))
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def caption(folders):
    """Explains the numbers, including the network of LPIPS."""
    evaluations = [e for folder in folders for runs in results(folder).values() for v in VARIANTS for e in runs[v]]
    nets = sorted({e["lpips"]["net"] for e in evaluations if e.get("lpips")})
    by = f" by {' and '.join(nets)}" if nets else ""
    return (
        f"Held-out views, 8-bit; SSIM as INRIA computes it, FLIP, and LPIPS{by} of pictures in 0…1, as INRIA's script has it "
        "(lower is better); differences: hybrid less splats alone, over the seeds that both have.\n"
    )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    budgets = sorted(map(Path, sys.argv[1:]), key=lambda folder: (len(folder.name), folder.name))
    print(caption(budgets))
    print(table(budgets))
