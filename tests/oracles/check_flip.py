"""FLIP by its own package: prints the reference values used in src/metrics/flip.rs.

  check_flip.py [FOLDER …]    fails where the package gives others; also takes the pictures of `centaur eval -o FOLDER` and compares with the figures there
"""

import sys

import eval_sheets
import flip_evaluator
import numpy as np


# By width and height: `golden_values` in that file.
GOLDEN = {(64, 48): 0.377455, (31, 17): 0.353533, (5, 3): 0.444331}


def pictures(width, height):
    """Smooth colours with lines, shifted by two pixels and brightened, 8 bits; `pictures` in the test makes the
    same."""
    y, x = np.mgrid[0:height, 0:width]

    def colors(x, y):
        return np.stack([5 * x % 256, 7 * y % 256, np.where((x + y) % 11 < 4, 230, 40)], -1)

    return colors(x, y).astype(np.uint8), np.minimum(colors(x + 2, y) + 12, 255).astype(np.uint8)


def flip(truth, render):
    parts = [picture.astype(np.float32) / 255 for picture in (truth, render)]
    return flip_evaluator.evaluate(*parts, "LDR", applyMagma=False)[1]


def compare(folder):
    """Compares sheets of `centaur eval -o` with the figures beside them."""
    differences = [abs(flip(truth, render) - view["flip"]) for view, truth, render in eval_sheets.views(folder)]
    # Sums of f32 over about 10,000 pixels, by two versions of the program: a difference of 8e-6 was seen.
    assert differences and all(difference < 2e-5 for difference in differences), f"{folder}: {differences}"
    print(f"{folder}: {len(differences)} views, largest difference {max(differences):.1e}")


if __name__ == "__main__":
    for (width, height), golden in GOLDEN.items():
        found = flip(*pictures(width, height))
        print(f"{width}×{height}: {found:.6f}")
        assert abs(found - golden) < 5e-6, f"{width}×{height}: expected {golden}, found {found}"
    for folder in sys.argv[1:]:
        compare(folder)
