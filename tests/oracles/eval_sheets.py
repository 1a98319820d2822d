"""Reads the sheets that `centaur eval -o FOLDER` writes (photograph | render | error) with the figures beside them."""

import json
import pathlib

import numpy as np
from PIL import Image


def views(folder):
    """For every view: its figures in metrics.json, photograph and render, 8 bits."""
    folder = pathlib.Path(folder)
    for view in json.loads((folder / "metrics.json").read_text())["views"]:
        sheet = np.asarray(Image.open(folder / pathlib.Path(view["name"]).with_suffix(".png").name).convert("RGB"))
        width, height = view["size"]
        # Captions are above, margins between.
        top, step = sheet.shape[0] - height, (sheet.shape[1] - width) // 2
        truth, render = (sheet[top:, left : left + width] for left in (0, step))
        yield view, truth, render
