use std::str::FromStr;

use glam::{DMat3, DVec3};

/// Axis convention of a coordinate frame: the directions in which x, y and z point for a viewer who sees the scene
/// upright.
///
/// Parsed from three letters, such as `RDF` for x right, y down, z forward; or from the name of a convention: `y-down`
/// or `colmap` (`RDF`: this crate, INRIA's `.ply`), `y-up` or `gltf` (`RUB`: also three.js), `z-up` or `blender`
/// (`RFU`), `unity` (`RUF`), `unreal` (`FRU`). `unity` and `unreal` are left-handed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axes(DMat3);

impl Axes {
    /// Matrix from coordinates in this frame to coordinates in `to`; its determinant is −1 if the two differ in
    /// handedness.
    #[must_use]
    pub fn to(self, to: Self) -> DMat3 {
        to.0.transpose() * self.0
    }
}

const NAMES: [(&str, &str); 8] = [
    ("y-down", "rdf"),
    ("colmap", "rdf"),
    ("y-up", "rub"),
    ("gltf", "rub"),
    ("z-up", "rfu"),
    ("blender", "rfu"),
    ("unity", "ruf"),
    ("unreal", "fru"),
];

impl FromStr for Axes {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.to_lowercase();
        let letters = NAMES.iter().find(|(name, _)| *name == text).map_or(text.as_str(), |(_, letters)| letters);
        let directions: Option<Vec<DVec3>> = letters.chars().map(direction).collect();
        let expected = || {
            let names: Vec<&str> = NAMES.iter().map(|(name, _)| *name).collect();
            format!(
                "expected {} or three letters such as RDF, one each of R/L, U/D, F/B; found `{text}`",
                names.join(", ")
            )
        };
        let Some([x, y, z]) = directions.as_deref() else { return Err(expected()) };
        let axes = DMat3::from_cols(*x, *y, *z);
        if axes.determinant() == 0.0 { Err(expected()) } else { Ok(Self(axes)) }
    }
}

/// Unit vector of a direction letter, in the frame right, up, back.
fn direction(letter: char) -> Option<DVec3> {
    Some(match letter {
        'r' => DVec3::X,
        'l' => DVec3::NEG_X,
        'u' => DVec3::Y,
        'd' => DVec3::NEG_Y,
        'b' => DVec3::Z,
        'f' => DVec3::NEG_Z,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(from: &str, to: &str) -> DMat3 {
        Axes::from_str(from).unwrap().to(to.parse().unwrap())
    }

    #[test]
    fn conventions_meet() {
        let up_in = |frame: &str| change("y-up", frame) * DVec3::Y;
        assert_eq!(up_in("colmap"), DVec3::NEG_Y);
        assert_eq!(up_in("blender"), DVec3::Z);
        assert_eq!(up_in("unreal"), DVec3::Z);
        assert_eq!(change("colmap", "gltf"), DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
        assert_eq!(change("z-up", "y-up") * DVec3::new(1.0, 2.0, 3.0), DVec3::new(1.0, 3.0, -2.0));
        assert_eq!(change("RFU", "z-up"), DMat3::IDENTITY);
        for (frame, handedness) in [("colmap", 1.0), ("z-up", 1.0), ("unity", -1.0), ("unreal", -1.0)] {
            assert_eq!(change("gltf", frame).determinant(), handedness, "{frame}");
            assert_eq!(change("gltf", frame) * change(frame, "gltf"), DMat3::IDENTITY);
        }
    }

    #[test]
    fn what_is_no_frame_is_refused() {
        for text in ["", "rd", "rdfu", "rld", "xyz", "x-up", "ruu"] {
            assert!(Axes::from_str(text).is_err(), "{text}");
        }
    }
}
