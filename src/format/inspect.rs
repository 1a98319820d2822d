//! What is in a file, for people and for scripts.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use glam::Vec3;
use serde::Serialize;

use super::gltf::{self, Asset, Sizes, scene_of};
use super::validate::unknown_properties;
use super::{FormatError, Kind, ReadOptions, kind, ply, read_file, usd};
use crate::scene::{ColorSpace, Composition, HybridScene, Mesh, Splats};

/// Content of a scene file. `Display` prints it as a tree; `Serialize` gives the same to scripts.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Path as given.
    pub file: String,
    /// `glTF`, `PLY`, `SOG`, `SPZ`, `splat`, `ksplat` or `USD`.
    pub format: &'static str,
    /// Length of the file; of a glTF, with that of the buffers and images beside it; of a SOG that is a folder, of its `meta.json`.
    pub bytes: u64,
    /// Where the bytes go: part → bytes.
    pub bytes_by_part: BTreeMap<&'static str, u64>,
    /// Optimised floats, see [`HybridScene::total_floats`].
    pub total_floats: usize,
    /// The splats, if any.
    pub splats: Option<SplatSummary>,
    /// The meshes.
    pub meshes: Vec<MeshSummary>,
    /// Number of cameras.
    pub cameras: usize,
    /// How it is blended; `None` where the format cannot say.
    pub composition: Option<CompositionSummary>,
    /// The tree of a glTF.
    pub document: Option<gltf::Document>,
    /// The tables of a PLY.
    pub tables: Vec<ply::Table>,
    /// `extensionsUsed`.
    pub extensions_used: Vec<String>,
    /// `extensionsRequired`.
    pub extensions_required: Vec<String>,
    /// What Centaur cannot take over exactly.
    pub warnings: Vec<String>,
}

/// Splats in numbers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SplatSummary {
    /// How many.
    pub count: usize,
    /// SH degree, 0 to 3.
    pub sh_degree: u32,
    /// Lowest and highest mean, in scene units.
    pub bounds: [[f32; 3]; 2],
}

/// A mesh in numbers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MeshSummary {
    /// Vertices of the surface, seams not counted.
    pub vertices: usize,
    /// Triangles.
    pub triangles: usize,
    /// Lowest and highest vertex, in scene units.
    pub bounds: [[f32; 3]; 2],
    /// Width and height of the map of SH coefficient 0 and opacity.
    pub base_texels: [u32; 2],
    /// Width and height of the maps of the higher bands.
    pub band_texels: Option<[u32; 2]>,
    /// SH degree of its colour, 0 to 3.
    pub sh_degree: u32,
}

/// The rule of blending.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CompositionSummary {
    /// `stable`, `surfaceConsistent` or `direct`.
    pub mode: &'static str,
    /// λ in scene units; `None` is infinite.
    pub lambda: Option<f32>,
    /// Mesh layers per pixel.
    pub layers: u32,
    /// `srgb_rec709_display` or `lin_rec709_display`.
    pub color_space: &'static str,
    /// RGB behind everything.
    pub background: [f32; 3],
    /// Nearest depth drawn.
    pub near: f32,
    /// Variance in px² that projections of splats are widened by.
    pub filter_variance: f32,
    /// Whether they keep their integral then.
    pub filter_normalized: bool,
}

/// Reads a file and sums it up.
///
/// # Errors
/// As [`super::read_scene`].
pub fn inspect(path: &Path) -> Result<Summary, FormatError> {
    let bytes = std::fs::metadata(path).map_err(|source| FormatError::Read { file: path.to_owned(), source })?.len();
    match kind(path)? {
        Kind::Gltf => {
            let asset = Asset::open(path)?;
            let document = gltf::describe(&asset).map_err(|fault| fault.in_file(path))?;
            // What cannot be rendered can still be looked at.
            let (scene, cameras, mut warnings) = match scene_of(&asset) {
                Ok(file) => (file.scene, file.cameras.len(), file.notes),
                Err(fault) => {
                    let (location, expected, found) = fault.into_parts();
                    let none =
                        HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
                    let warning = format!("cannot be read as a scene: {location}expected {expected}, found {found}");
                    (none, document.counts.get("cameras").copied().unwrap_or(0), vec![warning])
                }
            };
            warnings.extend(unknown_properties(&asset.root));
            let Sizes { total, parts } = gltf::sizes(&asset, bytes);
            Ok(Summary {
                cameras,
                composition: Some(composition(&scene.composition)),
                bytes_by_part: parts,
                document: Some(document),
                warnings,
                extensions_used: asset.extensions_used,
                extensions_required: asset.extensions_required,
                ..summary(path, total, &scene)
            })
        }
        Kind::Usd => {
            let file = usd::read(path)?;
            let is_package = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("usdz"));
            Ok(Summary {
                format: Kind::Usd.name(),
                cameras: file.cameras.len(),
                composition: Some(composition(&file.scene.composition)),
                bytes_by_part: BTreeMap::from([(if is_package { "package" } else { "layer" }, bytes)]),
                warnings: file.notes,
                ..summary(path, bytes, &file.scene)
            })
        }
        Kind::Ply => {
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
            Ok(Summary { format: Kind::Ply.name(), warnings, tables, bytes_by_part, ..summary(path, bytes, &scene) })
        }
        kind => {
            let file = read_file(path, &ReadOptions::default())?;
            Ok(Summary { format: kind.name(), warnings: file.notes, ..summary(path, bytes, &file.scene) })
        }
    }
}

fn summary(path: &Path, bytes: u64, scene: &HybridScene) -> Summary {
    Summary {
        file: path.display().to_string(),
        format: Kind::Gltf.name(),
        bytes,
        bytes_by_part: BTreeMap::from([("splats", bytes)]),
        total_floats: scene.total_floats(),
        splats: (!scene.splats.is_empty()).then(|| splats(&scene.splats)),
        meshes: scene.meshes.iter().map(mesh).collect(),
        cameras: 0,
        composition: None,
        document: None,
        tables: vec![],
        extensions_used: vec![],
        extensions_required: vec![],
        warnings: vec![],
    }
}

fn bounds(points: &[Vec3]) -> [[f32; 3]; 2] {
    let corner = |pick: fn(Vec3, Vec3) -> Vec3| points.iter().copied().reduce(pick).unwrap_or_default().to_array();
    [corner(Vec3::min), corner(Vec3::max)]
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

fn composition(c: &Composition) -> CompositionSummary {
    CompositionSummary {
        mode: c.mode.name(),
        lambda: c.lambda.is_finite().then_some(c.lambda),
        layers: c.layers,
        color_space: match c.color_space {
            ColorSpace::SrgbDisplay => "srgb_rec709_display",
            ColorSpace::LinearDisplay => "lin_rec709_display",
        },
        background: c.background,
        near: c.near,
        filter_variance: c.pixel_filter.variance,
        filter_normalized: c.pixel_filter.normalized,
    }
}

/// Nodes printed at most, and properties of a table; `--json` has all.
const MAX_NODES: usize = 100;
const MAX_PROPERTIES: usize = 12;

fn tree(f: &mut fmt::Formatter<'_>, document: &gltf::Document) -> fmt::Result {
    let counts: Vec<String> = document.counts.iter().map(|(kind, n)| format!("{n} {kind}")).collect();
    write!(f, "\n├ document: {}", counts.join(", "))?;
    if let Some(generator) = &document.generator {
        write!(f, ", by {generator}")?;
    }
    for node in document.nodes.iter().take(MAX_NODES) {
        write!(f, "\n│ {}• {}", "  ".repeat(node.depth.min(20)), node.name.as_deref().unwrap_or("(no name)"))?;
        for (what, index) in [("camera", node.camera), ("skin", node.skin), ("mesh", node.mesh)] {
            if let Some(index) = index {
                write!(f, ", {what} {index}")?;
            }
        }
        for p in &node.primitives {
            match (p.triangles, p.sh_degree) {
                (Some(triangles), _) => write!(f, ", {triangles} triangles of {} vertices", p.vertices)?,
                (_, Some(degree)) => {
                    write!(f, ", {} splats of degree {degree}{}", p.vertices, if p.is_spz { " (SPZ)" } else { "" })?;
                }
                _ => write!(f, ", {} {}", p.vertices, p.kind)?,
            }
            if p.morph_targets > 0 {
                write!(f, ", {} morph targets", p.morph_targets)?;
            }
        }
        if let Some(bounds) = node.bounds {
            write!(f, ", {}", span(bounds.map(|corner| corner.map(|c| c as f32))))?;
        }
    }
    if let Some(more) = document.nodes.len().checked_sub(MAX_NODES).filter(|&n| n > 0) {
        write!(f, "\n│ … and {more} more nodes")?;
    }
    for clip in &document.animations {
        let (name, [start, end]) = (clip.name.as_deref().unwrap_or("(no name)"), clip.range);
        write!(f, "\n├ animation: {name}, {:.3} s", end - start)?;
        if start != 0.0 {
            write!(f, " from {start:.3} s")?;
        }
        write!(f, ", {} channels", clip.channels)?;
    }
    if !document.remainder.is_empty() {
        write!(f, "\n├ beside the scene: {}", document.remainder.join(", "))?;
    }
    Ok(())
}

fn span([low, high]: [[f32; 3]; 2]) -> String {
    format!("[{:.3} {:.3} {:.3}] to [{:.3} {:.3} {:.3}]", low[0], low[1], low[2], high[0], high[1], high[2])
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}, {} bytes, {} floats", self.file, self.format, self.bytes, self.total_floats)?;
        if let Some(s) = &self.splats {
            write!(f, "\n├ splats: {}, SH degree {}, {}", s.count, s.sh_degree, span(s.bounds))?;
        }
        for m in &self.meshes {
            let [w, h] = m.base_texels;
            write!(f, "\n├ mesh: {} vertices, {} triangles, {}", m.vertices, m.triangles, span(m.bounds))?;
            write!(f, "\n│   maps: {w}×{h}, SH degree {}", m.sh_degree)?;
            if let Some([w, h]) = m.band_texels {
                write!(f, " at {w}×{h}")?;
            }
        }
        if let Some(c) = &self.composition {
            let lambda = c.lambda.map_or("infinite".to_owned(), |l| l.to_string());
            write!(f, "\n├ composition: {}, λ {lambda}, {} layer(s), {}", c.mode, c.layers, c.color_space)?;
            write!(f, ", near {}, background {:?}", c.near, c.background)?;
            let normalized = if c.filter_normalized { ", normalised (anti-aliased)" } else { "" };
            write!(f, ", pixel filter {} px²{normalized}", c.filter_variance)?;
        }
        if self.cameras > 0 {
            write!(f, "\n├ cameras: {}", self.cameras)?;
        }
        if let Some(document) = &self.document {
            tree(f, document)?;
        }
        for table in &self.tables {
            let (shown, more) = table.properties.split_at(table.properties.len().min(MAX_PROPERTIES));
            write!(f, "\n├ {}: {} rows of {}", table.name, table.rows, shown.join(", "))?;
            if !more.is_empty() {
                write!(f, " and {} more", more.len())?;
            }
            if let Some(bounds) = table.bounds {
                write!(f, ", {}", span(bounds))?;
            }
        }
        if !self.extensions_used.is_empty() {
            write!(f, "\n├ extensions: {}", self.extensions_used.join(", "))?;
        }
        if !self.extensions_required.is_empty() {
            write!(f, "\n├ required: {}", self.extensions_required.join(", "))?;
        }
        for warning in &self.warnings {
            write!(f, "\n├ warning: {warning}")?;
        }
        let parts: Vec<String> = self.bytes_by_part.iter().map(|(part, bytes)| format!("{part} {bytes}")).collect();
        write!(f, "\n└ bytes: {}", parts.join(", "))
    }
}
