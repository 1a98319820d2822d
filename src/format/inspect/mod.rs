//! Summary of a file's content, for people and scripts.

mod text;

use std::collections::BTreeMap;
use std::path::Path;

use glam::Vec3;
use serde::Serialize;

use super::content::Content;
use super::error::file_bytes;
use super::gltf::{self, Asset, Sizes, scene_of};
use super::length::stored_bytes;
use super::notes::grouped;
use super::validate::unknown_properties;
use super::{Format, FormatError, ReadOptions, detect, ply, read_file, usd};
use crate::scene::{self, Camera, Composition, HybridScene, Mesh, PixelFilter, Splats};

/// Content of a scene file. `Display` prints it as a tree; `Serialize` provides the same to scripts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Path as given.
    pub file: String,
    /// `glTF`, `PLY`, `SOG`, `SPZ`, `splat`, `ksplat` or `USD`.
    pub format: &'static str,
    /// Total length in bytes of the file and the files that belong to it, see [`super::stored_bytes`].
    pub bytes: u64,
    /// Bytes per part of the file.
    pub bytes_by_part: BTreeMap<&'static str, u64>,
    /// Number of optimised floats, see [`HybridScene::total_floats`].
    pub total_floats: usize,
    /// Splats, if any.
    pub splats: Option<SplatSummary>,
    /// The meshes.
    pub meshes: Vec<MeshSummary>,
    /// Number of cameras.
    pub cameras: usize,
    /// Image sizes and fields of view of the cameras; `None` without cameras.
    pub optics: Option<CameraSummary>,
    /// Composition; `None` where the format cannot state it.
    pub composition: Option<CompositionSummary>,
    /// Pixel filter, as stated or assumed, of files that state nothing else about blending.
    pub pixel_filter: Option<PixelFilter>,
    /// Node tree of a glTF.
    pub document: Option<gltf::Document>,
    /// Tables of a PLY.
    pub tables: Vec<ply::Table>,
    /// `extensionsUsed`.
    pub extensions_used: Vec<String>,
    /// `extensionsRequired`.
    pub extensions_required: Vec<String>,
    /// Content that Centaur cannot represent exactly.
    pub warnings: Vec<String>,
}

/// Statistics of splats.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SplatSummary {
    /// Number of splats.
    pub count: usize,
    /// SH degree, 0 to 3.
    pub sh_degree: u32,
    /// Corners of the bounding box of the means, in scene units; y down as in a capture, regardless of the file's
    /// frame.
    pub bounds: [[f32; 3]; 2],
}

/// Statistics of a mesh.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MeshSummary {
    /// Number of surface vertices, not counting duplicates at UV seams.
    pub vertices: usize,
    /// Number of triangles.
    pub triangles: usize,
    /// Corners of the bounding box of the vertices, in scene units; y down as in a capture, regardless of the file's
    /// frame.
    pub bounds: [[f32; 3]; 2],
    /// Width and height of the map of SH coefficient 0 and opacity.
    pub base_texels: [u32; 2],
    /// Width and height of the maps of the higher SH bands.
    pub band_texels: Option<[u32; 2]>,
    /// SH degree of the mesh's colour, 0 to 3.
    pub sh_degree: u32,
}

/// Statistics of cameras.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CameraSummary {
    /// Width and height of the smallest and of the largest image, by number of pixels.
    pub sizes: [[u32; 2]; 2],
    /// Narrowest and widest vertical field of view, in degrees.
    pub fov_y: [f64; 2],
}

/// Composition.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CompositionSummary {
    /// Whether the file states the composition; otherwise it is the one assumed.
    pub stated: bool,
    /// `stable`, `surfaceConsistent` or `direct`.
    pub mode: &'static str,
    /// λ in scene units; `None` is infinite.
    pub lambda: Option<f32>,
    /// Mesh layers per pixel.
    pub layers: u32,
    /// `srgb_rec709_display` or `lin_rec709_display`.
    pub color_space: &'static str,
    /// RGB colour of the background.
    pub background: [f32; 3],
    /// Depth of the near plane.
    pub near: f32,
    /// Variance in px² by which projections of splats are widened.
    pub filter_variance: f32,
    /// Whether widened projections keep their integral.
    pub filter_normalized: bool,
}

/// Summarises the content of a file.
///
/// # Errors
/// Those of [`super::read_scene`].
pub fn inspect(path: &Path) -> Result<Summary, FormatError> {
    let format = detect(path)?;
    match format {
        Format::Glb | Format::Gltf => {
            let asset = Asset::open(path)?;
            let document = gltf::describe(&asset).map_err(|fault| fault.in_file(path))?;
            // What cannot be rendered can still be looked at.
            let scene = scene_of(&asset).and_then(Content::in_capture_frame);
            let is_scene = scene.is_ok();
            let (scene, stated, cameras, mut warnings) = match scene {
                Ok(file) => (file.scene, file.states_composition, file.cameras, grouped(&file.notes)),
                Err(fault) => {
                    let none =
                        HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
                    (none, false, vec![], vec![format!("cannot be read as a scene: {fault}")])
                }
            };
            warnings.extend(unknown_properties(&asset.root));
            let Sizes { total, parts } = gltf::sizes(&asset, file_bytes(path)?);
            // Cameras that cannot be read are counted too.
            let count = if is_scene { cameras.len() } else { document.counts.get("cameras").copied().unwrap_or(0) };
            Ok(Summary {
                cameras: count,
                optics: optics(&cameras),
                composition: composition(&scene, stated),
                bytes_by_part: parts,
                document: Some(document),
                warnings,
                extensions_used: asset.extensions_used,
                extensions_required: asset.extensions_required,
                ..summary(path, format, total, &scene)
            })
        }
        Format::Usda | Format::Usdc | Format::Usdz => {
            let file = usd::read(path)?;
            let (own, bytes) = (file_bytes(path)?, stored_bytes(path)?);
            let part = if format == Format::Usdz { "package" } else { "layer" };
            let parts = [(part, own), ("beside", bytes - own)];
            Ok(Summary {
                cameras: file.cameras.len(),
                optics: optics(&file.cameras),
                composition: composition(&file.scene, file.states_composition),
                bytes_by_part: parts.into_iter().filter(|(_, bytes)| *bytes > 0).collect(),
                warnings: grouped(&file.notes),
                ..summary(path, format, bytes, &file.scene)
            })
        }
        Format::Ply | Format::CompressedPly => {
            let bytes = file_bytes(path)?;
            let (tables, is_of_splats) = ply::tables(path)?;
            let (scene, warnings) = if is_of_splats {
                let file = read_file(path, &ReadOptions::default())?;
                (file.scene, file.notes)
            } else {
                let none =
                    HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
                (none, vec!["no splats: neither the INRIA nor the packed layout".to_owned()])
            };
            let part = if is_of_splats { "splats" } else { "tables" };
            let bytes_by_part = BTreeMap::from([(part, bytes)]);
            Ok(Summary {
                warnings,
                tables,
                bytes_by_part,
                pixel_filter: is_of_splats.then_some(scene.composition.pixel_filter),
                ..summary(path, format, bytes, &scene)
            })
        }
        _ => {
            let file = read_file(path, &ReadOptions::default())?;
            let bytes = stored_bytes(path)?;
            Ok(Summary {
                warnings: file.notes,
                pixel_filter: Some(file.scene.composition.pixel_filter),
                ..summary(path, format, bytes, &file.scene)
            })
        }
    }
}

fn summary(path: &Path, format: Format, bytes: u64, scene: &HybridScene) -> Summary {
    Summary {
        file: path.display().to_string(),
        format: format.name(),
        bytes,
        bytes_by_part: BTreeMap::from([("splats", bytes)]),
        total_floats: scene.total_floats(),
        splats: (!scene.splats.is_empty()).then(|| splats(&scene.splats)),
        meshes: scene.meshes.iter().map(mesh).collect(),
        cameras: 0,
        optics: None,
        composition: None,
        pixel_filter: None,
        document: None,
        tables: vec![],
        extensions_used: vec![],
        extensions_required: vec![],
        warnings: vec![],
    }
}

fn bounds(points: &[Vec3]) -> [[f32; 3]; 2] {
    // Zero added: no corner is at −0.
    scene::bounds(points.iter().copied()).unwrap_or_default().map(|corner| (corner + Vec3::ZERO).to_array())
}

fn splats(splats: &Splats) -> SplatSummary {
    SplatSummary { count: splats.len(), sh_degree: splats.sh_degree(), bounds: bounds(splats.means()) }
}

fn mesh(mesh: &Mesh) -> MeshSummary {
    let atlas = mesh.atlas();
    MeshSummary {
        vertices: mesh.positions().len(),
        triangles: mesh.triangles().len(),
        bounds: bounds(mesh.positions()),
        base_texels: [atlas.base().width(), atlas.base().height()],
        band_texels: atlas.bands().map(|b| [b.width(), b.height()]),
        sh_degree: atlas.sh_degree(),
    }
}

fn optics(cameras: &[(String, Camera)]) -> Option<CameraSummary> {
    let all = || cameras.iter().map(|(_, camera)| camera.intrinsics());
    let sizes = || all().map(|k| [k.width, k.height]);
    let pixels = |size: &[u32; 2]| u64::from(size[0]) * u64::from(size[1]);
    let fov_y = || all().map(|k| k.fov_y().to_degrees());
    Some(CameraSummary {
        sizes: [sizes().min_by_key(pixels)?, sizes().max_by_key(pixels)?],
        fov_y: [fov_y().reduce(f64::min)?, fov_y().reduce(f64::max)?],
    })
}

/// Composition of a scene; `None` for a file that has nothing to blend and states none.
fn composition(scene: &HybridScene, stated: bool) -> Option<CompositionSummary> {
    let c = &scene.composition;
    (stated || !scene.splats.is_empty() || !scene.meshes.is_empty()).then(|| CompositionSummary {
        stated,
        mode: c.mode.name(),
        lambda: c.lambda.is_finite().then_some(c.lambda),
        layers: c.layers,
        color_space: c.color_space.name(),
        background: c.background,
        near: c.near,
        filter_variance: c.pixel_filter.variance,
        filter_normalized: c.pixel_filter.normalized,
    })
}
