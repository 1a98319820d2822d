//! The two frames that captures and files have: OpenCV's (x right, y down, z forward), which is that of scenes and
//! cameras here, and OpenGL's (x right, y up, z backward), which is that of glTF and USD.

use glam::{DMat3, DMat4, DQuat, DVec3, DVec4};

use super::{Camera, sh};

/// Factors of x, y and z by which OpenCV's axes (x right, y down, z forward) become OpenGL's (x right, y up, z
/// backward), of a world as of a camera: half a turn about x. Its own inverse, and exact in floating point.
pub const OPENGL_FROM_OPENCV: DVec3 = DVec3::new(1.0, -1.0, -1.0);

/// The same as a matrix for column vectors, as nodes have it.
pub(crate) const HALF_TURN: DMat4 =
    DMat4::from_diagonal(DVec4::new(OPENGL_FROM_OPENCV.x, OPENGL_FROM_OPENCV.y, OPENGL_FROM_OPENCV.z, 1.0));

/// The same as a matrix of directions.
const HALF_TURN_OF_AXES: DMat3 = DMat3::from_diagonal(OPENGL_FROM_OPENCV);

/// Sign of each coefficient of [`sh::basis`] where axes change theirs by these factors of ±1: whether it is even or odd
/// in those that do.
pub(crate) fn sh_signs(factors: DVec3) -> [f32; 16] {
    // At a direction where no function of the basis is 0.
    let d = DVec3::new(0.36, 0.48, 0.8);
    let (own, mirrored) = (sh::basis(d.to_array()), sh::basis((d * factors).to_array()));
    std::array::from_fn(|i| (mirrored[i] * own[i]).signum() as f32)
}

/// World→camera rotation of a camera where its world gets the other frame; its translation stays.
pub(crate) fn in_turned_world(to_camera: DMat3) -> DMat3 {
    to_camera * HALF_TURN_OF_AXES
}

/// Node→world rotation of the node that a camera is at: it has OpenGL's axes. Its place is [`Camera::center`].
pub(crate) fn node_of_camera(camera: &Camera) -> DMat3 {
    camera.rotation().transpose() * HALF_TURN_OF_AXES
}

/// Inverse of [`node_of_camera`]: world→camera rotation and translation of the camera of a node with this node→world
/// rotation and place.
pub(crate) fn camera_of_node(rotation: DQuat, place: DVec3) -> (DMat3, DVec3) {
    let to_camera = (DMat3::from_quat(rotation) * HALF_TURN_OF_AXES).transpose();
    (to_camera, -(to_camera * place))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Intrinsics;

    #[test]
    fn harmonics_change_sign_with_the_axes() {
        let d = DVec3::new(0.3, -0.5, 0.8).normalize();
        for factors in [OPENGL_FROM_OPENCV, DVec3::ONE, DVec3::NEG_ONE, DVec3::new(-1.0, 1.0, 1.0)] {
            let (here, there) = (sh::basis(d.to_array()), sh::basis((factors * d).to_array()));
            for (k, sign) in sh_signs(factors).into_iter().enumerate() {
                assert!((here[k] * f64::from(sign) - there[k]).abs() < 1e-15, "{factors} {k}");
            }
        }
        let odd = [1., -1., -1., 1., -1., 1., 1., -1., 1., -1., 1., -1., -1., 1., -1., 1.];
        assert_eq!(sh_signs(OPENGL_FROM_OPENCV), odd);
    }

    #[test]
    fn cameras_come_back_from_their_nodes() {
        assert_eq!((HALF_TURN * HALF_TURN, HALF_TURN_OF_AXES * DVec3::Y), (DMat4::IDENTITY, DVec3::NEG_Y));
        let rotation = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 2.0) / 3.0, 0.7);
        let intrinsics = Intrinsics { width: 4, height: 3, fx: 2.0, fy: 2.0, cx: 2.0, cy: 1.5 };
        let camera = Camera::new(intrinsics, rotation, DVec3::new(0.5, -1.0, 2.0)).unwrap();
        let node = node_of_camera(&camera);
        // The node looks along its −z, and its y is up in the picture.
        let ahead = camera.to_camera(camera.center() + node * DVec3::NEG_Z);
        let above = camera.to_camera(camera.center() + node * DVec3::Y);
        assert!(ahead.abs_diff_eq(DVec3::Z, 1e-12) && above.abs_diff_eq(DVec3::NEG_Y, 1e-12), "{ahead} {above}");
        let (back, translation) = camera_of_node(DQuat::from_mat3(&node), camera.center());
        assert!(back.abs_diff_eq(camera.rotation(), 1e-12), "{back}");
        assert!(translation.abs_diff_eq(camera.translation(), 1e-12), "{translation}");
    }
}
