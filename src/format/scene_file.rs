//! A common reader and writer for all scene formats.

use std::path::Path;

use rayon::prelude::*;

use super::error::Fault;
use super::ply::Attribute;
use super::splat_record::SplatRecord;
use super::{
    FormatError, Kind, Loss, NotedSplats, SplatError, WriteReport, activation, blender, cameras, gltf, has_extension,
    kind, ksplat, mitsuba, placed, ply, sog, splat, spz, usd,
};
use crate::atomic;
use crate::scene::{Camera, Composition, HybridScene, PixelFilter, Splats, frame::HALF_TURN};

/// What a file says about a scene, which is in the frame of captures: x to the right, y down, z forward, as COLMAP, INRIA's `.ply` and
/// [`HybridScene`] have it, whatever the frame of the file.
#[derive(Clone, Debug)]
pub struct SceneFile {
    /// Splats, meshes and composition.
    pub scene: HybridScene,
    /// Whether the file states how splats and meshes are blended; otherwise the composition is the default, with as
    /// many layers as the meshes need.
    pub states_composition: bool,
    /// Named cameras, in the frame of the scene.
    pub cameras: Vec<(String, Camera)>,
    /// Notes on content that could not be represented exactly, one sentence each.
    pub notes: Vec<String>,
    /// Whether the world of the file is y up, as those of glTF and USD are: the scene and its cameras have been turned from it by
    /// [`OPENGL_FROM_OPENCV`](crate::scene::frame::OPENGL_FROM_OPENCV), and [`write_scene`] turns them again. False of
    /// files that Centaur wrote, which come back as they were, and of formats that state no frame, which are taken to
    /// be in that of captures.
    pub y_up: bool,
    /// Further per-splat attributes of the file.
    pub attributes: Vec<Attribute>,
    /// Number of splats left out; `None` for formats to which [`ReadOptions::drop_invalid`] does not apply.
    pub dropped: Option<usize>,
    /// Document of a glTF, which contains more than the scene.
    pub source: Option<gltf::Source>,
    /// Centaur's record of how the scene was made, the extras given to [`gltf::write_glb`].
    pub record: Option<serde_json::Value>,
}

impl SceneFile {
    fn noted(NotedSplats { splats, pixel_filter, notes }: NotedSplats) -> Self {
        let mut file = Self { notes, ..Self::of_splats(splats) };
        file.scene.composition.pixel_filter = pixel_filter;
        file
    }

    fn of_splats(splats: Splats) -> Self {
        let scene = HybridScene { splats, meshes: vec![], composition: Composition::default() };
        Self {
            scene,
            states_composition: false,
            cameras: vec![],
            notes: vec![],
            y_up: false,
            attributes: vec![],
            dropped: None,
            source: None,
            record: None,
        }
    }

    /// What a reader has taken from a file as that has it, in the frame of the capture.
    pub(super) fn in_capture_frame(self) -> Result<Self, Fault> {
        if !self.y_up {
            return Ok(self);
        }
        let scene = placed::half_turned(self.scene).map_err(|e| Fault::from(e).under("/"))?;
        let turned = |(name, camera): (String, Camera)| (name, cameras::turned(&camera));
        let cameras: Vec<_> = self.cameras.into_iter().map(turned).collect();
        let source = self.source.map(|mut source| {
            source.follow(HALF_TURN, &scene, &cameras);
            source
        });
        Ok(Self { scene, cameras, source, ..self })
    }
}

/// Options of reading.
#[derive(Clone, Copy, Debug, Default)]
pub struct ReadOptions<'a> {
    /// Whether splats with non-finite numbers, zero rotations or negative scales, as written by failed trainings, are
    /// left out instead of refusing the file. Applies to uncompressed `.ply` and to `.splat`; files of other formats
    /// that hold such splats are refused.
    pub drop_invalid: bool,
    /// Whether the document of a glTF is kept in [`SceneFile::source`], so that [`write_scene`] can write it again. Its
    /// buffers stay in the file, which is kept open: the file may be replaced meanwhile, but modifying it in place is
    /// an error on use.
    pub keep_document: bool,
    /// Time in seconds at which the animations of a glTF pose the scene and its cameras; `None`: rest pose.
    pub time: Option<f64>,
    /// Animations of a glTF to play, by name, or by index from 0 where no name matches; empty: all, played together.
    pub animations: &'a [String],
}

/// Options of writing, and content to be written besides the scene.
#[derive(Clone, Copy, Debug, Default)]
pub struct WriteOptions<'a> {
    /// Named cameras, in the frame of the scene.
    pub cameras: &'a [(String, Camera)],
    /// Further per-splat attributes.
    pub attributes: &'a [Attribute],
    /// Document from which the scene was read; written again if it still matches the scene, see
    /// [`gltf::Source::stands`].
    pub source: Option<&'a gltf::Source>,
    /// How the scene was made, see [`SceneFile::record`]; glTF and USD hold it. In a `source` that stands its own record stays, and another is
    /// named as lost; where the scene is written anew, this one takes its place.
    pub record: Option<&'a serde_json::Value>,
    /// SPZ layout.
    pub spz: spz::Options,
}

/// File extensions that [`write_scene`] writes and [`read_file`] reads. A name that ends in `.compressed.ply` selects
/// compressed PLY.
pub const WRITABLE: &[&str] = &["glb", "gltf", "usda", "usdz", "ply", "sog", "spz", "splat", "ksplat"];

/// Extensions of [`WRITABLE`] for formats that hold splats only. Of the composition these formats state at most the
/// pixel filter, and nothing in units of length; readers take defaults for the rest.
pub const SPLATS_ALONE: &[&str] = &["ply", "sog", "spz", "splat", "ksplat"];

/// File-name endings that [`write_scene`] writes for rendering programs, and that cannot be read: Mitsuba's and
/// Blender's.
pub const EXPORTABLE: &[&str] = &["xml", "blend.py"];

/// As [`super::read_scene`], with what the file says besides; cameras are in the frame of the scene.
///
/// # Errors
/// Those of [`super::read_scene`], and if a time or animations are given for a file other than glTF.
pub fn read_file(path: &Path, options: &ReadOptions<'_>) -> Result<SceneFile, FormatError> {
    let kind = kind(path)?;
    if (options.time.is_some() || !options.animations.is_empty()) && kind != Kind::Gltf {
        let expected = "a .glb or .gltf, whose animations can be evaluated at a time";
        return Err(Fault::whole(expected, kind.name()).in_file(path));
    }
    Ok(match kind {
        Kind::Gltf => gltf::read_with(path, options)?,
        Kind::Ksplat => SceneFile::of_splats(ksplat::read(path)?),
        Kind::Ply => {
            let ply::PlySplats { splats, attributes, pixel_filter, notes, dropped } = ply::read_with(path, options)?;
            SceneFile { attributes, dropped, ..SceneFile::noted(NotedSplats { splats, pixel_filter, notes }) }
        }
        Kind::Sog => SceneFile::noted(sog::read_noted(path)?),
        Kind::Splat => {
            let (splats, dropped) = splat::read_with(path, options.drop_invalid)?;
            SceneFile { dropped: Some(dropped), ..SceneFile::of_splats(splats) }
        }
        Kind::Spz => SceneFile::noted(spz::read_noted(path)?),
        Kind::Usd => usd::read(path)?,
    })
}

/// Writes a scene in the format of the file's extension, one of [`WRITABLE`] and [`EXPORTABLE`], ignoring case.
///
/// The scene and its cameras are taken to be in the frame of captures, y down, as [`super::read_scene`] gives it and training makes it. glTF and
/// USD are y up: they get it turned half about x, so that viewers show it upright. Splats alone are written as they are.
///
/// # Errors
/// If the extension is none of these, the file cannot be written, the composition is not valid, or the format's limits are exceeded.
pub fn write_scene(path: &Path, scene: &HybridScene, options: &WriteOptions<'_>) -> Result<WriteReport, FormatError> {
    scene.composition.validate().map_err(|e| Fault::from(e).in_file(path))?;
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let extension = name.rsplit_once('.').map_or("", |(_, extension)| extension);
    // Accompanying files are placed beside the target of a symbolic link, unless that target has another extension.
    let place = atomic::place_of(path).map_err(|source| FormatError::Write { file: path.to_owned(), source })?;
    let is_alike = has_extension(&place, &[extension]);
    let path = if is_alike { &place } else { path };
    let (splats, antialiased) = (&scene.splats, scene.composition.pixel_filter.normalized);
    let report = match extension {
        "glb" | "gltf" => {
            let (bytes, loss) = match options.source {
                Some(source) => {
                    let (bytes, stands) = gltf::write_over(path, scene, options.cameras, (source, options.record))?;
                    let loss = if stands {
                        let record = options.record.is_some() && options.record != source.extras();
                        Loss { document: source.unfound(), record, ..Loss::default() }
                    } else {
                        dropping(source, of_linear_values(splats))
                    };
                    (bytes, loss)
                }
                None => {
                    let bytes = gltf::write_glb(path, scene, options.cameras, options.record.cloned())?;
                    (bytes, of_linear_values(splats))
                }
            };
            let loss = Loss { attributes: names(options.attributes), ..loss };
            return Ok(WriteReport { bytes, loss, ..WriteReport::default() });
        }
        "usda" | "usdz" => {
            let (bytes, beside) = usd::write(path, scene, options.cameras, options.record)?;
            let loss = Loss { attributes: names(options.attributes), ..of_linear_values(splats) };
            let loss = options.source.map_or(loss.clone(), |source| dropping_all(source, loss));
            return Ok(WriteReport { bytes, loss, beside, ..WriteReport::default() });
        }
        "xml" | "py" if extension == "xml" || name.ends_with(blender::SUFFIX) => {
            let source = options.source;
            let (report, keeps_motion) = if extension == "xml" {
                (mitsuba::write(path, scene, options.cameras)?, false)
            } else {
                let moving = source.and_then(|source| source.moving(scene));
                let broken = moving.and_then(|(moving, _)| moving.check().err());
                let moving = moving.filter(|_| broken.is_none());
                let mut report = blender::write(path, scene, options.cameras, moving)?;
                report.notes.extend(moving.and_then(|(moving, _)| moving.overruled()));
                report.notes.extend(broken.map(|fault| {
                    let (location, expected, found) = fault.into_parts();
                    format!(
                        "all keeps still, as an animation is malformed: {location}expected {expected}, found {found}"
                    )
                }));
                (report, moving.is_some())
            };
            // Loss means here what images lack: exports are not read back as scenes.
            let motion = source.filter(|_| !keeps_motion).map_or_else(Vec::new, gltf::Source::motion);
            return Ok(WriteReport { loss: Loss { document: motion, ..report.loss }, ..report });
        }
        "ply" if name.ends_with(".compressed.ply") => {
            ply::compressed::write_with(path, splats, scene.composition.pixel_filter)?
        }
        "ply" => {
            let bytes = ply::write_with(path, splats, options.attributes, scene.composition.pixel_filter)?;
            let loss = beside_splats(scene, options, extension, Loss::default());
            return Ok(WriteReport { bytes, loss, ..WriteReport::default() });
        }
        "sog" => sog::write_with(path, splats, antialiased)?,
        "splat" => splat::write(path, splats)?,
        "ksplat" => ksplat::write(path, splats, ksplat::Level::default())?,
        "spz" => spz::write(path, splats, &spz::Options { antialiased, ..options.spz })?,
        _ => {
            let wanted: Vec<String> = WRITABLE.iter().chain(EXPORTABLE).map(|e| format!(".{e}")).collect();
            let fault = Fault::whole(format!("a name that ends in {}", wanted.join(", ")), format!("`.{extension}`"));
            return Err(fault.in_file(path));
        }
    };
    let loss = Loss { attributes: names(options.attributes), ..beside_splats(scene, options, extension, report.loss) };
    Ok(WriteReport { loss, ..report })
}

/// Loss from storing linear scales and opacities instead of logarithms and logits.
fn of_linear_values(splats: &Splats) -> Loss {
    let error = |i: usize| {
        let before = SplatRecord::of(splats, i);
        let mut after = before;
        after.log_scale = before.log_scale.to_array().map(|s| activation::log_scale(activation::scale(s)).0).into();
        after.opacity_logit = activation::logit(activation::opacity(before.opacity_logit)).0;
        let mut error = SplatError::default();
        error.include(&before, &after);
        error
    };
    let max_error = (0..splats.len()).into_par_iter().map(error).reduce(SplatError::default, SplatError::max);
    Loss { max_error, ..Loss::default() }
}

/// Adds the loss common to splat-only formats. Without meshes, only the background, the near plane, the colour space
/// and the pixel filter of the composition matter; their loss counts if they differ from the defaults.
fn beside_splats(scene: &HybridScene, options: &WriteOptions<'_>, extension: &str, loss: Loss) -> Loss {
    let is = &scene.composition;
    let pixel_filter = match extension {
        "sog" | "spz" if is.pixel_filter.normalized => PixelFilter::NORMALIZED_DILATION,
        "ply" if is.pixel_filter.normalized => is.pixel_filter,
        _ => PixelFilter::DILATION,
    };
    let usual = Composition { pixel_filter, ..Composition::default() };
    let stated = |c: &Composition| (c.background, c.near, c.color_space, c.pixel_filter);
    let plain = stated(is) == stated(&usual);
    let composition = !scene.meshes.is_empty() || !plain;
    let record = options.record.is_some();
    let loss = Loss { meshes: scene.meshes.len(), cameras: options.cameras.len(), composition, record, ..loss };
    options.source.map_or(loss.clone(), |source| dropping_all(source, loss))
}

/// Adds the parts of the document that are not in the scene, and are lost with the document.
fn dropping(source: &gltf::Source, loss: Loss) -> Loss {
    Loss { document: source.remainder().iter().map(ToString::to_string).collect(), ..loss }
}

/// Same as [`dropping`], and adds the parts that only another glTF could hold.
fn dropping_all(source: &gltf::Source, loss: Loss) -> Loss {
    let loss = dropping(source, loss);
    Loss { document: [loss.document, source.of_the_file()].concat(), ..loss }
}

fn names(attributes: &[Attribute]) -> Vec<String> {
    attributes.iter().map(|a| a.name().to_owned()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::test_scenes::{camera, random_scene};

    #[test]
    fn what_is_written_is_read_and_what_is_not_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let scene = random_scene(30, 2, 3, 4);
        let cameras = [("front".to_owned(), camera())];
        for extension in WRITABLE.iter().chain(&["compressed.ply"]) {
            let path = folder.path().join(format!("scene.{}", extension.to_uppercase()));
            let options = WriteOptions { cameras: &cameras, ..WriteOptions::default() };
            let report = write_scene(&path, &scene, &options).unwrap();
            // A .usda is written with its pictures.
            let length = path.metadata().unwrap().len();
            assert!(report.bytes == length || *extension == "usda" && report.bytes > length);
            let back = read_file(&path, &ReadOptions::default()).unwrap();
            assert!(!back.y_up && back.notes.is_empty(), "{:?}", back.notes);
            assert_eq!(back.scene.splats.len(), 30);
            assert_eq!(scene.meshes.len() - back.scene.meshes.len(), report.loss.meshes);
            assert_eq!(cameras.len() - back.cameras.len(), report.loss.cameras);
            assert_eq!(back.scene.composition != scene.composition, report.loss.composition);
            assert_eq!(has_extension(&path, SPLATS_ALONE), report.loss.meshes > 0, "{extension}");
            if !has_extension(&path, SPLATS_ALONE) {
                // The report is what a reader finds.
                assert_eq!(Loss::of_splats(&scene.splats, &back.scene.splats).max_error, report.loss.max_error);
            }
        }
    }

    #[test]
    fn the_record_of_the_training_is_kept_or_named() {
        let folder = tempfile::tempdir().unwrap();
        let scene = random_scene(3, 0, 1, 4);
        let record = serde_json::json!({ "capture": "garden" });
        for extension in WRITABLE.iter().chain(&["compressed.ply"]) {
            let path = folder.path().join(format!("a.{extension}"));
            let options = WriteOptions { record: Some(&record), ..WriteOptions::default() };
            let loss = write_scene(&path, &scene, &options).unwrap().loss;
            let back = read_file(&path, &ReadOptions::default()).unwrap().record;
            assert_eq!(loss.record, back.is_none(), "{extension}");
            assert_eq!(loss.to_string().contains("the record of the training"), back.is_none(), "{extension}: {loss}");
            assert!(back.is_none_or(|back| back == record), "{extension}");
            assert_eq!(has_extension(&path, SPLATS_ALONE), loss.record, "{extension}");
        }
    }

    #[test]
    fn a_record_is_of_the_scene_that_it_is_written_with() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let [old, new] = [1, 2].map(|iterations| serde_json::json!({ "iterations": iterations }));
        let options = WriteOptions { record: Some(&old), ..WriteOptions::default() };
        write_scene(&at("a.glb"), &random_scene(3, 1, 1, 4), &options).unwrap();
        let file = read_file(&at("a.glb"), &ReadOptions { keep_document: true, ..ReadOptions::default() }).unwrap();
        let written = |scene: &HybridScene, record: &serde_json::Value| {
            let source = file.source.as_ref();
            let options = WriteOptions { source, record: Some(record), ..WriteOptions::default() };
            let loss = write_scene(&at("b.glb"), scene, &options).unwrap().loss;
            let back = read_file(&at("b.glb"), &ReadOptions::default()).unwrap();
            (back.record, loss.record)
        };
        // A document that stands has its own.
        assert_eq!(written(&file.scene, &old), (Some(old.clone()), false));
        assert_eq!(written(&file.scene, &new), (Some(old.clone()), true));
        let mut changed = file.scene.clone();
        changed.meshes.clear();
        assert_eq!(written(&changed, &new), (Some(new.clone()), false));
    }

    #[test]
    fn rounding_is_no_loss_and_splats_alone_have_no_rule() {
        let folder = tempfile::tempdir().unwrap();
        let mut scene = random_scene(30, 0, 2, 4);
        scene.composition = Composition { lambda: 0.3, layers: 4, ..Composition::default() };
        let write = |name: &str, scene: &HybridScene| {
            write_scene(&folder.path().join(name), scene, &WriteOptions::default()).map(|r| r.loss)
        };
        let loss = write("a.glb", &scene).unwrap();
        assert!(loss.is_rounding() && !loss.is_none(), "{loss}");
        assert!(write("a.ply", &scene).unwrap().is_none());
        scene.composition.pixel_filter = PixelFilter::NORMALIZED_DILATION;
        for (name, is_lost) in [
            ("a.spz", false),
            ("a.sog", false),
            ("a.ply", false),
            ("a.compressed.ply", false),
            ("a.splat", true),
            ("a.glb", false),
        ] {
            assert_eq!(write(name, &scene).unwrap().composition, is_lost, "{name}");
            let back = read_file(&folder.path().join(name), &ReadOptions::default()).unwrap().scene.composition;
            assert_eq!(back.pixel_filter != scene.composition.pixel_filter, is_lost, "{name}");
        }
        scene.composition.pixel_filter = PixelFilter::MIP;
        assert!(write("a.spz", &scene).unwrap().composition, "its variance");
        scene.composition.pixel_filter = PixelFilter::default();
        scene.composition.background = [1.0; 3];
        assert!(!write("a.ply", &scene).unwrap().is_rounding());
        let error = write("a.txt", &scene).unwrap_err().to_string();
        assert!(
            error
                .ends_with("a.txt: expected a name that ends in .glb, .gltf, .usda, .usdz, .ply, .sog, .spz, .splat, .ksplat, .xml, .blend.py, found `.txt`"),
            "{error}"
        );
    }
}
