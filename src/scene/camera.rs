use std::ops::RangeInclusive;

use glam::{DMat3, DQuat, DVec2, DVec3};

use super::SceneError;

/// Valid focal lengths, in sides of the image: angles of view from 179.8° down to a microradian. Others are mistakes.
const FOCAL_LENGTHS: RangeInclusive<f64> = 1e-3..=1e6;
/// Largest distance of the principal point from the image's first corner, in sides of the image, which may be cut out
/// of a larger one.
const FARTHEST_CENTER: f64 = 1e3;

/// Pinhole intrinsics in pixels. Pixel (i, j) covers `[i, i+1)×[j, j+1)`; its centre is at +0.5.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Image width.
    pub width: u32,
    /// Image height.
    pub height: u32,
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Principal point, pixels from the left edge.
    pub cx: f64,
    /// Principal point, pixels from the top edge.
    pub cy: f64,
}

impl Intrinsics {
    /// Largest side, pixels, of a picture requested by size, or assumed for a camera without one: what adapters with
    /// the limits of Direct3D 12 hold as one texture.
    pub const MAX_PICTURE_SIDE: u32 = 16384;

    /// Largest side, pixels, of an image that a file may ask for, as buffers are allocated for it: that of the largest
    /// photographs.
    pub const MAX_SIDE: u32 = 1 << 16;
    /// Largest number of pixels of such an image, 2²⁸: four times a 64-megapixel camera, 1 GiB decoded to bytes. Larger
    /// claims are mistakes or attacks.
    pub const MAX_PIXELS: u64 = 1 << 28;

    /// Whether an image size is neither empty nor beyond these limits.
    #[must_use]
    pub fn is_size(width: u32, height: u32) -> bool {
        let pixels = u64::from(width) * u64::from(height);
        width.max(height) <= Self::MAX_SIDE && (1..=Self::MAX_PIXELS).contains(&pixels)
    }

    /// Number of pixels of the image.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Width and height of the image, as continuous pixel coordinates.
    #[must_use]
    pub fn size(&self) -> DVec2 {
        DVec2::new(f64::from(self.width), f64::from(self.height))
    }

    /// Longer side of the image, pixels.
    #[must_use]
    pub fn longer_side(&self) -> u32 {
        self.width.max(self.height)
    }

    /// Of this vertical angle of view, in radians: square pixels, the principal point in the middle. Whether there can
    /// be such a lens is for [`Camera::new`] and [`Camera::look_at`] to say.
    #[must_use]
    pub fn from_fov_y(width: u32, height: u32, fov_y: f64) -> Self {
        let [w, h] = [width, height].map(f64::from);
        let focal = 0.5 * h / (0.5 * fov_y).tan();
        Self { width, height, fx: focal, fy: focal, cx: 0.5 * w, cy: 0.5 * h }
    }

    /// Horizontal angle of view in radians, as it is where the principal point is in the middle.
    #[must_use]
    pub fn fov_x(&self) -> f64 {
        2.0 * (0.5 * f64::from(self.width) / self.fx).atan()
    }

    /// Vertical angle of view in radians, as it is where the principal point is in the middle.
    #[must_use]
    pub fn fov_y(&self) -> f64 {
        2.0 * (0.5 * f64::from(self.height) / self.fy).atan()
    }

    /// The same camera at another image size. Uses the *actual* new size, so rounding is accounted for.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }
}

/// A posed pinhole camera: `p_camera = rotation · p_world + translation`, OpenCV axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    intrinsics: Intrinsics,
    rotation: DMat3,
    translation: DVec3,
}

impl Camera {
    /// Validates and takes intrinsics and the world→camera pose. The rotation is made orthonormal.
    ///
    /// # Errors
    /// If a number is not finite, the image is empty, a focal length is not between a thousandth and a million times
    /// the image's side, the principal point is farther away than a thousand sides, or the matrix is not close to a
    /// rotation (lengths and cosines of its axes within 1 % of 1 and 0, no mirroring).
    pub fn new(intrinsics: Intrinsics, rotation: DMat3, translation: DVec3) -> Result<Self, SceneError> {
        let k = &intrinsics;
        if k.width == 0 || k.height == 0 {
            return Err(SceneError::new("image size", "at least 1×1", format!("{}×{}", k.width, k.height)));
        }
        let [width, height] = [k.width, k.height].map(f64::from);
        if !(FOCAL_LENGTHS.contains(&(k.fx / width)) && FOCAL_LENGTHS.contains(&(k.fy / height))) {
            let (least, most) = FOCAL_LENGTHS.into_inner();
            let expected = format!("{least} to {most} times the sides of an image of {width}×{height}");
            return Err(SceneError::new("focal length", expected, format!("{}, {}", k.fx, k.fy)));
        }
        if !((k.cx / width).abs() <= FARTHEST_CENTER && (k.cy / height).abs() <= FARTHEST_CENTER) {
            let expected = format!("at most {FARTHEST_CENTER} times the sides of an image of {width}×{height}");
            return Err(SceneError::new("principal point", expected, format!("{}, {}", k.cx, k.cy)));
        }
        if !(rotation.is_finite() && translation.is_finite()) {
            return Err(SceneError::new(
                "pose",
                "finite numbers",
                format!("{:?}, {:?}", rotation.to_cols_array(), translation.to_array()),
            ));
        }
        let [x, y, z] = [rotation.x_axis, rotation.y_axis, rotation.z_axis];
        let lengths = [x, y, z].map(DVec3::length);
        let cosines = [x.dot(y), y.dot(z), z.dot(x)];
        if lengths.iter().any(|l| (l - 1.0).abs() > 0.01) || cosines.iter().any(|c| c.abs() > 0.01) {
            let found = format!("axes of lengths {lengths:.3?} with products {cosines:.3?}");
            return Err(SceneError::new("pose", "a rotation: axes of length 1 at right angles", found));
        }
        if rotation.determinant() < 0.0 {
            return Err(SceneError::new("pose", "a rotation", "a rotation and a reflection"));
        }
        Ok(Self { intrinsics, rotation: nearest_rotation(rotation), translation })
    }

    /// A camera at `center` that looks at `target`, with `up` upwards in its picture; all are in world space. Up is −y
    /// (`DVec3::NEG_Y`) in the frame of captures, in which [`read_scene`](crate::format::read_scene) has scenes.
    ///
    /// `up` may have any length, and need not be across the view. Where it is along the view, or zero, any roll of the
    /// picture is taken.
    ///
    /// # Errors
    /// As [`Self::new`], and if `target` is where `center` is, or `up` is not finite.
    ///
    /// ```
    /// use centaur::{glam::{DVec2, DVec3}, scene::{Camera, Intrinsics}};
    ///
    /// let lens = Intrinsics::from_fov_y(1280, 720, 50_f64.to_radians());
    /// // Four units before the origin and one above it.
    /// let camera = Camera::look_at(lens, DVec3::new(0.0, -1.0, -4.0), DVec3::ZERO, DVec3::NEG_Y)?;
    /// let pixel = camera.project(camera.to_camera(DVec3::ZERO));
    /// assert!(pixel.abs_diff_eq(DVec2::new(640.0, 360.0), 1e-9));
    /// # Ok::<(), centaur::scene::SceneError>(())
    /// ```
    pub fn look_at(intrinsics: Intrinsics, center: DVec3, target: DVec3, up: DVec3) -> Result<Self, SceneError> {
        let forward = target - center;
        if !(forward.length() > 0.0 && up.is_finite()) {
            let expected = "a target away from the camera, and an up that is finite";
            return Err(SceneError::new("view", expected, format!("{forward} from it, and {up}")));
        }
        // Squares of very long and very short ones are not representable.
        let largest = up.abs().max_element();
        let up = if largest > 0.0 { up / largest } else { up };
        let to_camera = view_axes(forward.normalize(), up).transpose();
        Self::new(intrinsics, to_camera, -(to_camera * center))
    }

    /// Intrinsics.
    #[must_use]
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// World→camera rotation.
    #[must_use]
    pub fn rotation(&self) -> DMat3 {
        self.rotation
    }

    /// World→camera translation.
    #[must_use]
    pub fn translation(&self) -> DVec3 {
        self.translation
    }

    /// Camera centre in world space.
    #[must_use]
    pub fn center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// World point to camera space; `.z` is its depth.
    #[must_use]
    pub fn to_camera(&self, world: DVec3) -> DVec3 {
        self.rotation * world + self.translation
    }

    /// Continuous pixel position of a camera-space point; meaningless for z ≤ 0.
    #[must_use]
    pub fn project(&self, p: DVec3) -> DVec2 {
        let k = &self.intrinsics;
        DVec2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy)
    }

    /// Continuous pixel position of a camera-space point, or direction, if it is in front of the camera and inside the
    /// picture. `None` for NaN.
    #[must_use]
    pub fn in_picture(&self, p: DVec3) -> Option<DVec2> {
        let size = self.intrinsics.size();
        let uv = (p.z > 0.0).then(|| self.project(p))?;
        (uv.cmpge(DVec2::ZERO).all() && uv.cmplt(size).all()).then_some(uv)
    }

    /// Camera-space ray with z = 1 through continuous pixel position `uv`.
    #[must_use]
    pub fn ray(&self, uv: DVec2) -> DVec3 {
        let k = &self.intrinsics;
        DVec3::new((uv.x - k.cx) / k.fx, (uv.y - k.cy) / k.fy, 1.0)
    }

    /// The camera in a world whose lengths are `factor` times as large.
    pub(crate) fn scaled(&self, factor: f64) -> Self {
        Self { translation: factor * self.translation, ..*self }
    }

    /// The camera with `margin` more pixels on every side of the picture.
    #[must_use]
    pub fn padded(&self, margin: u32) -> Self {
        let (k, m) = (self.intrinsics, f64::from(margin));
        let wider = |side: u32| side.saturating_add(margin.saturating_mul(2));
        let intrinsics = Intrinsics { width: wider(k.width), height: wider(k.height), cx: k.cx + m, cy: k.cy + m, ..k };
        Self { intrinsics, ..*self }
    }

    /// The camera with its image resized to `width`×`height`.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        Self { intrinsics: self.intrinsics.resized(width.max(1), height.max(1)), ..*self }
    }
}

/// Camera→world of a camera that looks along `forward`, of length 1, with `up` upwards in its picture: right, down and
/// forward.
pub(crate) fn view_axes(forward: DVec3, up: DVec3) -> DMat3 {
    let right = forward.cross(up);
    // Straight up or down there is no level; any will do.
    let is_level = right.length() > 1e-9 * up.length();
    let right = if is_level { right.normalize() } else { forward.any_orthonormal_vector() };
    DMat3::from_cols(right, forward.cross(right), forward)
}

/// The rotation that a matrix is but for rounding and scale: axes of about one length at about right angles, as
/// [`Camera::new`] takes them.
pub(crate) fn nearest_rotation(matrix: DMat3) -> DMat3 {
    let axes = [matrix.x_axis, matrix.y_axis, matrix.z_axis].map(DVec3::normalize_or_zero);
    DMat3::from_quat(DQuat::from_mat3(&DMat3::from_cols(axes[0], axes[1], axes[2])).normalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(rotation: DMat3) -> Result<Camera, SceneError> {
        let intrinsics = Intrinsics { width: 4, height: 3, fx: 2.0, fy: 2.0, cx: 2.0, cy: 1.5 };
        Camera::new(intrinsics, rotation, DVec3::ZERO)
    }

    #[test]
    fn what_is_in_the_picture() {
        let camera = pose(DMat3::IDENTITY).unwrap();
        assert_eq!(camera.in_picture(DVec3::new(0.5, -0.5, 1.0)), Some(DVec2::new(3.0, 0.5)));
        // The picture includes its upper left corner, but not its right and lower sides.
        assert_eq!(camera.in_picture(DVec3::new(-1.0, -0.75, 1.0)), Some(DVec2::ZERO));
        for outside in [[1.0, 0.0, 1.0], [0.0, 0.75, 1.0], [0.0, 0.0, -1.0], [0.0; 3], [f64::NAN, 0.0, 1.0]] {
            assert_eq!(camera.in_picture(DVec3::from(outside)), None, "{outside:?}");
        }
    }

    #[test]
    fn a_camera_looks_at_its_target_with_up_upwards() {
        let lens = Intrinsics::from_fov_y(200, 100, 0.5 * std::f64::consts::PI);
        let (center, target) = (DVec3::new(3.0, -1.0, 2.0), DVec3::new(-1.0, 2.0, 5.0));
        let any_length = [1e-320, 1e-200, 1e200, f64::MAX].map(|length| length * DVec3::NEG_Y);
        for up in [DVec3::NEG_Y, 7.0 * DVec3::Z, DVec3::new(0.1, -0.2, 0.3)].into_iter().chain(any_length) {
            let camera = Camera::look_at(lens, center, target, up).unwrap();
            assert!(camera.center().abs_diff_eq(center, 1e-12), "{up}");
            let seen = camera.to_camera(target);
            assert!(camera.project(seen).abs_diff_eq(DVec2::new(100.0, 50.0), 1e-9) && seen.z > 0.0, "{up}: {seen}");
            // The up direction is neither to the left nor to the right, and points upwards: y is down.
            let above = camera.rotation() * (up / up.abs().max_element());
            assert!(above.x.abs() < 1e-12 && above.y < 0.0, "{up}: {above}");
        }
        // Looking straight down, no direction in the picture is level.
        for up in [DVec3::ZERO, target - center, center - target] {
            let camera = Camera::look_at(lens, center, target, up).unwrap();
            assert!(camera.to_camera(target).truncate().length() < 1e-12, "{up}");
        }
        for (target, up) in [(center, DVec3::Y), (target, DVec3::NAN), (DVec3::INFINITY, DVec3::Y)] {
            assert!(Camera::look_at(lens, center, target, up).is_err(), "{target} {up}");
        }
        let error = Camera::look_at(lens, center, center, DVec3::Y).unwrap_err().to_string();
        assert!(error.starts_with("view: expected a target away from the camera"), "{error}");
    }

    #[test]
    fn angles_of_view_are_those_of_the_sides() {
        let right_angle = 0.5 * std::f64::consts::PI;
        let lens = Intrinsics::from_fov_y(300, 100, right_angle);
        assert!((lens.fx - 50.0).abs() < 1e-12 && lens.fx == lens.fy && (lens.cx, lens.cy) == (150.0, 50.0));
        assert!((lens.fov_y() - right_angle).abs() < 1e-12);
        // The edge is at three focal lengths.
        assert!(((0.5 * lens.fov_x()).tan() - 3.0).abs() < 1e-12);
        for impossible in [0.0, -1.0, std::f64::consts::PI, f64::NAN] {
            let lens = Intrinsics::from_fov_y(300, 100, impossible);
            assert!(Camera::new(lens, DMat3::IDENTITY, DVec3::ZERO).is_err(), "{impossible}");
        }
    }

    #[test]
    fn only_rotations_are_poses() {
        let turn = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 0.7);
        let found = pose(turn * DMat3::from_diagonal(DVec3::splat(1.003))).unwrap().rotation();
        // Errors in a file change the rotation by at most their size, and it stays a rotation.
        assert!(found.abs_diff_eq(turn, 0.01) && (found * found.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-12));
        // Both have determinant 1.
        let stretched = turn * DMat3::from_diagonal(DVec3::new(2.0, 0.5, 1.0));
        let sheared = turn * DMat3::from_cols(DVec3::X, DVec3::new(0.4, 1.0, 0.0), DVec3::Z);
        let mirrored = turn * DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
        for (rotation, found) in [
            (stretched, "axes of lengths [2.000, 0.500, 1.000] with products"),
            (sheared, "with products [0.400, "),
            (mirrored, "a rotation and a reflection"),
            (DMat3::ZERO, "axes of lengths [0.000, 0.000, 0.000]"),
        ] {
            let error = pose(rotation).unwrap_err().to_string();
            assert!(error.starts_with("pose: expected a rotation") && error.contains(found), "{error}");
        }
    }
}
