"""Cameras, COLMAP models and triangulation; needs NumPy: .venv/bin/python -m unittest discover -s datasets-scripts -p '*_test.py'"""

import struct
import sys
import tempfile
import unittest
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from colmap_model import NO_POINT, Camera, centre_of, facing, quaternion, read_model, rotation_of, write_model
from triangulation import triangulate, widest_angle

# Different values, so that focal length and principal point cannot be confused.
CAMERA = Camera(256, 160, 210.0, (131.0, 77.0))


def looking(eye, target):
    back = np.subtract(eye, target).astype(float)
    return facing(np.asarray(eye, float), back / np.linalg.norm(back))


POSES = [looking((3 * np.cos(t), 3 * np.sin(t), 1.5), (0.1, -0.2, 1.0)) for t in (0.0, 0.3, 0.9, 2.0)]


class Cameras(unittest.TestCase):
    def test_what_is_looked_at_is_at_the_principal_point(self):
        for pose in POSES:
            np.testing.assert_allclose(CAMERA.project(pose, np.array((0.1, -0.2, 1.0))), CAMERA.principal, atol=1e-9)

    def test_axes(self):
        pose = looking((0, -5, 1), (0, 0, 1))
        np.testing.assert_allclose(centre_of(pose), (0, -5, 1), atol=1e-12)
        x, y = CAMERA.project(pose, np.array((0.5, 0, 1.25)))
        self.assertAlmostEqual(x, 131 + 210 * 0.5 / 5, msg="x is to the right")
        self.assertAlmostEqual(y, 77 - 210 * 0.25 / 5, msg="up is up")
        self.assertIsNone(CAMERA.project(pose, np.array((0, -6.0, 1))), "behind")
        self.assertIsNone(CAMERA.project(pose, np.array((0, 0, 5.0))), "outside")

    def test_a_ray_goes_through_its_pixel(self):
        for pose in POSES:
            for pixel in ((1.5, 2.5), (200.25, 80.0), (254.0, 158.5)):
                ray = CAMERA.ray(pose, pixel)
                self.assertAlmostEqual(np.linalg.norm(ray), 1)
                np.testing.assert_allclose(CAMERA.project(pose, centre_of(pose) + 7.3 * ray), pixel, atol=1e-9)


class Models(unittest.TestCase):
    def setUp(self):
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)

    def test_rotations(self):
        for rotation, _ in POSES:
            np.testing.assert_allclose(rotation_of(quaternion(rotation)), rotation, atol=1e-12)
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            self.assertGreater(np.linalg.det(rotation), 0)

    def test_observations_and_tracks(self):
        points = np.array([(0, 0, 1.0), (0.2, 0.1, 0.9), (5, 4, 3.0)])
        colours = np.array([(1, 2, 3), (4, 5, 6), (255, 0, 7)], np.uint8)
        observations = [[(10.5, 20.25, 0), (30.0, 40.0, None), (50.0, 60.0, 2)], [(1.0, 2.0, 2)], [], [(9.0, 8.0, 1), (7.0, 6.0, 2)]]
        write_model(self.folder, CAMERA, POSES, points, colours, observations, [0.25, 0.5, 1.0])
        poses, positions, rgb, seen, tracks = read_model(self.folder)
        for (r, t), (rotation, translation) in zip(poses, POSES):
            np.testing.assert_allclose(r, rotation, atol=1e-12)
            np.testing.assert_allclose(t, translation, atol=1e-12)
        np.testing.assert_array_equal(positions, points)
        np.testing.assert_array_equal(rgb, colours)
        self.assertEqual(seen, observations)
        self.assertEqual(tracks, [[(0, 0)], [(3, 0)], [(0, 2), (1, 0), (3, 1)]])

    def test_bytes_are_colmaps(self):
        """Parsed independently, from the description of the format."""
        write_model(
            self.folder, CAMERA, POSES[:1], np.array([(1.0, 2.0, 3.0)]), np.array([(7, 8, 9)]), [[(5.5, 6.5, None), (1.5, 2.5, 0)]], [0.75]
        )
        self.assertEqual(struct.unpack("<QiiQQ4d", (self.folder / "cameras.bin").read_bytes()), (1, 1, 1, 256, 160, 210, 210, 131, 77))
        images = (self.folder / "images.bin").read_bytes()
        self.assertEqual(struct.unpack_from("<Qi", images), (1, 1))
        self.assertEqual(images[8 + 4 + 56 : 8 + 4 + 56 + 4], struct.pack("<i", 1), "the camera")
        self.assertEqual(images[72:80], b"000.jpg\0")
        self.assertEqual(struct.unpack_from("<QddQddQ", images, 80), (2, 5.5, 6.5, NO_POINT, 1.5, 2.5, 1))
        self.assertEqual(len(images), 80 + 8 + 2 * 24)
        points = struct.unpack("<QQ3d3BdQii", (self.folder / "points3D.bin").read_bytes())
        self.assertEqual(points, (1, 1, 1, 2, 3, 7, 8, 9, 0.75, 1, 1, 1))


class Points(unittest.TestCase):
    def test_exact_pixels_give_the_point(self):
        point = np.array((0.3, 0.2, 1.1))
        pixels = [CAMERA.project(pose, point) for pose in POSES]
        position, error = triangulate(CAMERA, POSES, [np.array(p) for p in pixels], point + 0.05)
        np.testing.assert_allclose(position, point, atol=1e-9)
        self.assertLess(error, 1e-6)

    def test_noise_moves_far_points_along_the_ray(self):
        rng = np.random.default_rng(0)
        poses = [looking((x, 0, 1), (x * 0.9, 50, 1)) for x in (-1, 0, 1)]
        for point in (np.array((0.0, 4.0, 1.0)), np.array((0.0, 60.0, 1.0))):
            found = [
                triangulate(CAMERA, poses, [CAMERA.project(p, point) + 0.3 * rng.normal(size=2) for p in poses], point)[0]
                for _ in range(60)
            ]
            spread = np.std([f - point for f in found], axis=0)
            # Depth error: noise / (focal length × baseline) × distance squared.
            self.assertAlmostEqual(spread[1] / (0.3 / (210 * np.sqrt(2)) * point[1] ** 2), 1, delta=0.4)
            self.assertGreater(spread[1], spread[0])

    def test_rays_that_part_meet_nowhere(self):
        poses = [looking((x, 0, 1), (x, 50, 1)) for x in (-1, 0, 1)]
        pixels = [np.array((131.0 + 4 * x, 77.0)) for x in (-1, 0, 1)]
        self.assertEqual(triangulate(CAMERA, poses, pixels, np.array((0, 60.0, 1))), (None, None))

    def test_widest_angle(self):
        self.assertAlmostEqual(widest_angle([(1, 0, 0), (2, 2, 0), (0, 3, 0)], np.zeros(3)), np.pi / 2)


if __name__ == "__main__":
    unittest.main()
