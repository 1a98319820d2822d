"""Triangulation of points from the pixels that see them: NumPy only."""

import numpy as np

from colmap_model import centre_of


def triangulate(camera, poses, pixels, start, steps=8):
    """The position whose projections are nearest to the pixels (least squares from `start`) and its mean distance from
    them in pixels; (None, None) if it diverges, as it does with parallel rays."""
    position = np.array(start, float)
    reach = np.linalg.norm(position - centre_of(poses[0]))
    for _ in range(steps):
        rows, residuals = [], []
        for (rotation, translation), pixel in zip(poses, pixels):
            x, y, z = rotation @ position + translation
            if z <= 1e-6:
                return None, None
            by_camera = camera.focal / z * np.array([[1, 0, -x / z], [0, 1, -y / z]])
            rows.append(by_camera @ rotation)
            residuals.append(pixel - camera.focal * np.array([x, y]) / z - camera.principal)
        step = np.linalg.lstsq(np.concatenate(rows), np.concatenate(residuals), rcond=None)[0]
        position = position + step
        if np.linalg.norm(position - start) > 0.5 * reach:
            return None, None
    errors = []
    for (rotation, translation), pixel in zip(poses, pixels):
        x, y, z = rotation @ position + translation
        if z <= 1e-6:
            return None, None
        errors.append(np.hypot(*(camera.focal * np.array([x, y]) / z + camera.principal - pixel)))
    return position, float(np.mean(errors))


def widest_angle(eyes, point):
    """The largest angle in radians under which two of the eyes are seen from the point."""
    rays = np.subtract(eyes, point)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))
