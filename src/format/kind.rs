//! Formats of scene files.

use std::path::Path;

use crate::scene::PixelFilter;

/// Format of a scene file. [`Self::of_path`] is that of a file to be written, [`detect`](super::detect()) finds that of
/// a file to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Binary glTF, `.glb`.
    Glb,
    /// glTF as text, `.gltf`.
    Gltf,
    /// USD layer as text, `.usda`.
    Usda,
    /// Binary USD layer, `.usdc`; read only.
    Usdc,
    /// USD layer packed with its files, `.usdz`.
    Usdz,
    /// PLY in INRIA's layout, `.ply`. A file that is read is this also in the other layout.
    Ply,
    /// Compressed PLY of `PlayCanvas`: written to names that end in `.compressed.ply`.
    CompressedPly,
    /// SOG: `.sog`; where it is read, also a folder by the name of its `meta.json` or `lod-meta.json`.
    Sog,
    /// SPZ, `.spz`.
    Spz,
    /// `.splat`.
    Splat,
    /// `.ksplat`.
    Ksplat,
    /// Scene for Mitsuba, `.xml`; written only.
    Mitsuba,
    /// Script for Blender, `.blend.py`; written only.
    BlendScript,
}

impl Format {
    /// All that [`write_scene`](super::write_scene) writes, in the order in which messages list them, except
    /// [`Self::CompressedPly`], whose names end as those of [`Self::Ply`].
    pub const WRITABLE: [Self; 11] = [
        Self::Glb,
        Self::Gltf,
        Self::Usda,
        Self::Usdz,
        Self::Ply,
        Self::Sog,
        Self::Spz,
        Self::Splat,
        Self::Ksplat,
        Self::Mitsuba,
        Self::BlendScript,
    ];

    /// Format of a file of this name, by its ending, ignoring case.
    #[must_use]
    pub fn of_path(path: &Path) -> Option<Self> {
        let name = path.file_name()?.to_string_lossy().to_lowercase();
        let (stem, extension) = name.rsplit_once('.').filter(|(stem, _)| !stem.is_empty())?;
        Some(match extension {
            "glb" => Self::Glb,
            "gltf" => Self::Gltf,
            "usda" => Self::Usda,
            "usdc" => Self::Usdc,
            "usdz" => Self::Usdz,
            "ply" if stem.ends_with(".compressed") => Self::CompressedPly,
            "ply" => Self::Ply,
            "sog" => Self::Sog,
            "spz" => Self::Spz,
            "splat" => Self::Splat,
            "ksplat" => Self::Ksplat,
            "xml" => Self::Mitsuba,
            "py" if stem.strip_suffix(".blend").is_some_and(|stem| !stem.is_empty()) => Self::BlendScript,
            _ => return None,
        })
    }

    /// Ending of the names of its files, without the first dot; `ply` for either layout.
    #[must_use]
    pub fn extension(self) -> &'static str {
        match self {
            Self::Glb => "glb",
            Self::Gltf => "gltf",
            Self::Usda => "usda",
            Self::Usdc => "usdc",
            Self::Usdz => "usdz",
            Self::Ply | Self::CompressedPly => "ply",
            Self::Sog => "sog",
            Self::Spz => "spz",
            Self::Splat => "splat",
            Self::Ksplat => "ksplat",
            Self::Mitsuba => "xml",
            Self::BlendScript => "blend.py",
        }
    }

    /// Display name, one for all files that one reader reads.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Glb | Self::Gltf => "glTF",
            Self::Usda | Self::Usdc | Self::Usdz => "USD",
            Self::Ply | Self::CompressedPly => "PLY",
            Self::Sog => "SOG",
            Self::Spz => "SPZ",
            Self::Splat => "splat",
            Self::Ksplat => "ksplat",
            Self::Mitsuba => "Mitsuba",
            Self::BlendScript => "Blender",
        }
    }

    /// Whether [`read_file`](super::read_file) reads it. What is not read is written for rendering programs.
    #[must_use]
    pub fn is_readable(self) -> bool {
        !matches!(self, Self::Mitsuba | Self::BlendScript)
    }

    /// Whether [`write_scene`](super::write_scene) writes it.
    #[must_use]
    pub fn is_writable(self) -> bool {
        self != Self::Usdc
    }

    /// Whether it is glTF, as text or binary.
    #[must_use]
    pub fn is_gltf(self) -> bool {
        matches!(self, Self::Glb | Self::Gltf)
    }

    /// Whether it holds meshes, cameras and the composition, not splats alone. Of the composition formats of splats
    /// alone state at most the pixel filter, and nothing in units of length; readers take defaults for the rest.
    #[must_use]
    pub fn holds_meshes(self) -> bool {
        match self {
            Self::Glb | Self::Gltf | Self::Usda | Self::Usdc | Self::Usdz | Self::Mitsuba | Self::BlendScript => true,
            Self::Ply | Self::CompressedPly | Self::Sog | Self::Spz | Self::Splat | Self::Ksplat => false,
        }
    }

    /// Whether [`write_cameras`](super::write_cameras) writes a path of cameras in it, with the times of its frames.
    #[must_use]
    pub fn holds_paths(self) -> bool {
        matches!(self, Self::Glb | Self::Gltf | Self::Usda)
    }

    /// Whether it holds further attributes of splats.
    pub(super) fn holds_attributes(self) -> bool {
        self == Self::Ply
    }

    /// Pixel filter that a reader takes for splats that were written with `filter` in this format, one of splats alone.
    pub(super) fn pixel_filter_kept(self, filter: PixelFilter) -> PixelFilter {
        match self {
            Self::Sog | Self::Spz if filter.normalized => PixelFilter::NORMALIZED_DILATION,
            Self::Ply | Self::CompressedPly if filter.normalized => filter,
            _ => PixelFilter::DILATION,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_are_told_by_the_ends_of_names() {
        let of = |name: &str| Format::of_path(Path::new(name));
        for format in Format::WRITABLE {
            for name in [format!("a.{}", format.extension()), format!("b/a.b.{}", format.extension().to_uppercase())] {
                assert_eq!(of(&name), Some(format), "{name}");
            }
            assert!(format.is_writable() && of(&format!(".{}", format.extension())).is_none(), "{format:?}");
        }
        assert_eq!(of("a.Compressed.PLY"), Some(Format::CompressedPly));
        assert_eq!(of("a.compressed-ply"), None);
        assert_eq!(of("a.usdc").map(Format::is_writable), Some(false));
        for name in ["a.py", "a.txt", "glb", "a.", "", "..", "/"] {
            assert_eq!(of(name), None, "{name}");
        }
    }
}
