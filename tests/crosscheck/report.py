"""Writes the results of crosscheck.py as one page and one JSON."""
import base64
import html
import json
import struct
import zlib

import numpy as np


def png(image):
    """Encodes an image [h, w, 3] in 0..1 as a PNG, as text for a page."""
    pixels = np.round(255 * np.clip(np.nan_to_num(image, nan=1), 0, 1)).astype(np.uint8)
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    chunk = lambda kind, body: struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    header = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], 8, 2, 0, 0, 0)
    file = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")
    return base64.b64encode(file).decode()


def decibels(figures):
    """PSNR of a picture, and of its remaining pixels if some have errors above 0.01."""
    if figures["above_1e-2"] and figures["rest"]:
        return f"{figures['psnr']:.1f} dB ({figures['rest']:.1f} without {figures['above_1e-2']} px)"
    return "exact" if figures["psnr"] is None else f"{figures['psnr']:.1f} dB"


def line(row):
    """A comparison as a line of text."""
    verdict = "pass" if row["passes"] else "MISS"
    start = f"{verdict}  {row['scene']}/{row['camera']}  {row['program']} ~ {row['model']}: "
    if "error" in row:
        return start + row["error"]
    text = f"{decibels(row)} (gate {row['gate']}), max {row['max']:.1e}, mean {row['mean']:.1e}, {row['above_1e-2']} px above 1e-2"
    text += f", alpha {decibels(row['alpha'])}"
    if "layers" in row:
        text += "".join(f", {name} {decibels(f)}" for name, f in row["layers"].items()) + f", sum {row['sum_error']:.0e}"
    return start + text + f", {row['seconds']['theirs']} s"


STYLE = """
body { font: 14px/1.4 system-ui, sans-serif; margin: 2em; color: #222; background: #fff }
table { border-collapse: collapse } td, th { padding: 3px 10px; text-align: right; vertical-align: top; border-bottom: 1px solid #ddd }
td:nth-child(-n+3), th:nth-child(-n+3) { text-align: left } .miss { background: #fdd } img { width: 200px; image-rendering: pixelated; display: block }
"""
HEAD = ["scene, camera", "program", "model", "PSNR", "gate", "max", "mean", "pixels above 1e-2", "alpha", "splats", "mesh", "sum", "seconds"]


def cells(row):
    place = [f"{row['scene']}, {row['camera']} ({row['splats']} splats)", row["program"], row["model"]]
    if "error" in row:
        return [*place, row["error"]]
    layers = row.get("layers", {})
    return [
        *place, decibels(row), f"{row['gate']} dB", f"{row['max']:.1e}", f"{row['mean']:.1e}", str(row["above_1e-2"]), decibels(row["alpha"]),
        *(decibels(layers[name]) if name in layers else "" for name in ("splats", "mesh")),
        f"{row['sum_error']:.0e}" if layers else "", str(row["seconds"]["theirs"]),
    ]  # fmt: skip


def write(folder, summary, rows):
    """Writes crosscheck.html and crosscheck.json."""
    folder.mkdir(parents=True, exist_ok=True)
    plain = [{k: v for k, v in row.items() if k != "pictures"} for row in rows]
    (folder / "crosscheck.json").write_text(json.dumps({"summary": summary, "comparisons": plain}, indent=1) + "\n")
    tr = lambda row: f"<tr{'' if row['passes'] else ' class=miss'}>" + "".join(f"<td>{html.escape(c)}</td>" for c in cells(row)) + "</tr>"
    pictures = lambda row: "".join(
        f"<td><img alt='{what}' src='data:image/png;base64,{p}'></td>" for what, p in zip(("Centaur", "other", "error"), row["pictures"])
    )
    seen = "".join(
        f"<tr><td>{html.escape(row['scene'])}, {row['camera']}<td>{html.escape(row['program'])}<td>{row['model']}{pictures(row)}</tr>"
        for row in rows if "pictures" in row
    )  # fmt: skip
    page = f"""<!doctype html><meta charset="utf-8"><title>Centaur: cross-check</title><style>{STYLE}</style>
<h1>Cross-check</h1><p>{html.escape(summary)}. PSNR with a peak of 1, in the space of blending, over the background.</p>
<table><tr>{''.join(f'<th>{h}' for h in HEAD)}</tr>{''.join(map(tr, rows))}</table>
<h2>Pictures</h2><table><tr><th>scene, camera<th>program<th>model<th>Centaur<th>other<th>10 × error</tr>{seen}</table>
"""
    (folder / "crosscheck.html").write_text(page)
