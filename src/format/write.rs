//! Writing of scenes and cameras in the format of the file's name.

use std::path::Path;

use rayon::prelude::*;

use super::cameras::{self, CameraFile};
use super::error::Fault;
use super::splat_record::SplatRecord;
use super::{
    Attribute, Format, FormatError, Loss, SplatError, WriteReport, activation, blender, detect, gltf, has_extension,
    ksplat, mitsuba, ply, sog, splat, spz, usd,
};
use crate::atomic;
use crate::scene::{Camera, Composition, HybridScene, Splats};

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
    /// How the scene was made, see [`SceneFile::record`](super::SceneFile::record); glTF and USD hold it. In a `source`
    /// that stands its own record stays, and another is named as lost; where the scene is written anew, this one takes
    /// its place.
    pub record: Option<&'a serde_json::Value>,
    /// Copyright of a scene without `source`; glTF states it, elsewhere it is named as lost.
    pub copyright: Option<&'a str>,
    /// SPZ layout.
    pub spz: spz::Options,
}

/// Writes a scene in the format of the file's name, see [`Format::of_path`]; it is one of [`Format::WRITABLE`], or
/// compressed PLY.
///
/// The scene and its cameras are taken to be in the frame of captures, y down, as [`read_scene`](super::read_scene)
/// gives it and training makes it. glTF and USD are y up: they get it turned half about x, so that viewers show it
/// upright. Splats alone are written as they are.
///
/// # Errors
/// If the name is of no such format, the file cannot be written, the composition is not valid, or the format's limits
/// are exceeded.
pub fn write_scene(path: &Path, scene: &HybridScene, options: &WriteOptions<'_>) -> Result<WriteReport, FormatError> {
    scene.composition.validate().map_err(|e| Fault::from(e).in_file(path))?;
    // Accompanying files are placed beside the target of a symbolic link, unless that target has another extension.
    let place = atomic::place_of(path).map_err(|source| FormatError::Write { file: path.to_owned(), source })?;
    let named = Format::of_path(path).filter(|format| format.is_writable());
    let format = named.ok_or_else(|| of_no_format(path))?;
    let path = if Format::of_path(&place) == named { &place } else { path };
    let (splats, pixel_filter) = (&scene.splats, scene.composition.pixel_filter);
    let report = match format {
        Format::Glb | Format::Gltf => return write_gltf(path, scene, options),
        Format::Usda | Format::Usdz => return write_usd(path, scene, options),
        Format::Mitsuba => return write_mitsuba(path, scene, options),
        Format::BlendScript => return write_blend_script(path, scene, options),
        Format::Usdc => return Err(of_no_format(path)),
        Format::Ply => ply::write_with(path, splats, options.attributes, pixel_filter),
        Format::CompressedPly => ply::compressed::write(path, splats, pixel_filter),
        Format::Sog => sog::write(path, splats, pixel_filter),
        Format::Spz => {
            let antialiased = pixel_filter.normalized;
            spz::write(path, splats, &spz::Options { antialiased, ..options.spz })
        }
        Format::Splat => splat::write(path, splats),
        Format::Ksplat => ksplat::write(path, splats, ksplat::Level::default()),
    };
    report.map(|report| beside_splats(format, scene, options, report))
}

/// Error for a file whose name is of no format that is written.
fn of_no_format(path: &Path) -> FormatError {
    let wanted = Format::WRITABLE.map(|format| format!(".{}", format.extension()));
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    Fault::whole(format!("a name that ends in {}", wanted.join(", ")), format!("`.{extension}`")).in_file(path)
}

fn write_gltf(path: &Path, scene: &HybridScene, options: &WriteOptions<'_>) -> Result<WriteReport, FormatError> {
    let mut notes = vec![];
    let (bytes, loss) = match options.source {
        Some(source) => {
            let (bytes, stands) = gltf::write_over(path, scene, options.cameras, (source, options.record))?;
            let loss = if stands {
                notes.extend(source.lost_with_cameras(options.cameras));
                let record = options.record.is_some() && options.record != source.extras();
                Loss { document: source.unfound(), record, ..Loss::default() }
            } else {
                Loss { document: not_in_scene(source), ..of_linear_values(&scene.splats) }
            };
            (bytes, loss)
        }
        None => {
            let bytes = gltf::write_anew(path, scene, options.cameras, (options.record.cloned(), options.copyright))?;
            (bytes, of_linear_values(&scene.splats))
        }
    };
    let loss = Loss { attributes: names(options.attributes), ..loss };
    Ok(WriteReport { bytes, loss, notes, ..WriteReport::default() })
}

fn write_usd(path: &Path, scene: &HybridScene, options: &WriteOptions<'_>) -> Result<WriteReport, FormatError> {
    let (bytes, beside) = usd::write(path, scene, options.cameras, options.record)?;
    let (attributes, document) = (names(options.attributes), whole_document(options));
    let loss = Loss { attributes, document, ..of_linear_values(&scene.splats) };
    Ok(WriteReport { bytes, loss, beside, ..WriteReport::default() })
}

fn write_mitsuba(path: &Path, scene: &HybridScene, options: &WriteOptions<'_>) -> Result<WriteReport, FormatError> {
    let report = mitsuba::write(path, scene, options.cameras)?;
    Ok(exported(report, options, options.source))
}

fn write_blend_script(
    path: &Path,
    scene: &HybridScene,
    options: &WriteOptions<'_>,
) -> Result<WriteReport, FormatError> {
    let moving = options.source.and_then(|source| source.moving(scene));
    let broken = moving.and_then(|(moving, _)| moving.check().err());
    let moving = moving.filter(|_| broken.is_none());
    let mut report = blender::write(path, scene, options.cameras, moving)?;
    report.notes.extend(moving.and_then(|(moving, _)| moving.overruled()));
    report.notes.extend(broken.map(|fault| format!("nothing is animated, because an animation is malformed: {fault}")));
    Ok(exported(report, options, options.source.filter(|_| moving.is_none())))
}

/// Adds the loss of what concerns the file as a whole, and of the animations of `still`, a document whose scene keeps
/// still in a rendering program. Loss means there besides what images lack: exports are not read back as scenes.
fn exported(report: WriteReport, options: &WriteOptions<'_>, still: Option<&gltf::Source>) -> WriteReport {
    let document = [still.map_or_else(Vec::new, gltf::Source::motion), of_the_file(options)].concat();
    WriteReport { loss: Loss { document, ..report.loss }, ..report }
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

/// Adds the loss common to formats of splats alone. Without meshes, only the background, the near plane, the colour
/// space and the pixel filter of the composition matter; their loss counts if they differ from the defaults.
fn beside_splats(format: Format, scene: &HybridScene, options: &WriteOptions<'_>, report: WriteReport) -> WriteReport {
    let is = &scene.composition;
    let usual = Composition { pixel_filter: format.pixel_filter_kept(is.pixel_filter), ..Composition::default() };
    let stated = |c: &Composition| (c.background, c.near, c.color_space, c.pixel_filter);
    let loss = Loss {
        meshes: scene.meshes.len(),
        cameras: options.cameras.len(),
        composition: !scene.meshes.is_empty() || stated(is) != stated(&usual),
        attributes: if format.holds_attributes() { vec![] } else { names(options.attributes) },
        record: options.record.is_some(),
        document: whole_document(options),
        ..report.loss
    };
    WriteReport { loss, ..report }
}

/// Parts of a document that are not in its scene, and are lost with the document.
fn not_in_scene(source: &gltf::Source) -> Vec<String> {
    source.remainder().iter().map(ToString::to_string).collect()
}

/// Parts of the document, if there is one, that only a glTF could hold.
fn whole_document(options: &WriteOptions<'_>) -> Vec<String> {
    [options.source.map_or_else(Vec::new, not_in_scene), of_the_file(options)].concat()
}

/// What of the file as a whole only a glTF could hold.
fn of_the_file(options: &WriteOptions<'_>) -> Vec<String> {
    match options.source {
        Some(source) => source.of_the_file(),
        None => options.copyright.map(|_| gltf::COPYRIGHT.to_owned()).into_iter().collect(),
    }
}

fn names(attributes: &[Attribute]) -> Vec<String> {
    attributes.iter().map(|a| a.name().to_owned()).collect()
}

/// Extensions of files that [`write_cameras`] writes; a path that has none of them is a folder for a COLMAP model.
pub const WRITABLE_CAMERAS: &[&str] = &["json", "glb", "gltf", "usda"];

/// Writes cameras in the format of the path's extension, one of [`WRITABLE_CAMERAS`], or as a COLMAP model into a
/// folder, which is created. Returns the bytes written.
///
/// # Errors
/// If a file cannot be written, or a COLMAP model or `transforms*.json` would replace or hide an existing capture.
pub fn write_cameras(path: &Path, file: &CameraFile) -> Result<u64, FormatError> {
    match Format::of_path(path) {
        Some(Format::Glb | Format::Gltf) => gltf::write_cameras(path, file),
        Some(Format::Usda) => usd::write_cameras(path, &file.clone().in_frame(false)),
        _ if has_extension(path, &["json"]) => cameras::write_transforms(path, file),
        _ => cameras::write_model(path, &file.clone().in_frame(false).cameras),
    }
}

/// Same as [`write_cameras`], but together with the content of the `.glb` or `.gltf` at `scene`: its document is
/// written again unchanged, except that cameras added in this way before are replaced.
///
/// # Errors
/// If the extension of `path` is neither `.glb` nor `.gltf`, `scene` cannot be read or is not glTF, or the file cannot
/// be written.
pub fn write_cameras_with_scene(path: &Path, scene: &Path, file: &CameraFile) -> Result<u64, FormatError> {
    if !Format::of_path(path).is_some_and(Format::is_gltf) {
        return Err(Fault::whole("a name that ends in .glb or .gltf", path.display().to_string()).in_file(path));
    }
    match detect(scene)? {
        Format::Glb | Format::Gltf => gltf::write_with_cameras(path, scene, file),
        other => Err(Fault::whole("a .glb or .gltf, to which cameras can be added", other.name()).in_file(scene)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::test_scenes::{camera, random_scene};
    use crate::format::{ReadOptions, read_file};
    use crate::scene::PixelFilter;

    /// Endings of the names of files that are written and can be read again.
    fn endings() -> impl Iterator<Item = &'static str> {
        let readable = Format::WRITABLE.into_iter().filter(|format| format.is_readable());
        readable.map(Format::extension).chain(["compressed.ply"])
    }

    #[test]
    fn what_is_written_is_read_and_what_is_not_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let scene = random_scene(30, 2, 3, 4);
        let cameras = [("front".to_owned(), camera())];
        for extension in endings() {
            let path = folder.path().join(format!("scene.{}", extension.to_uppercase()));
            let options = WriteOptions { cameras: &cameras, ..WriteOptions::default() };
            let report = write_scene(&path, &scene, &options).unwrap();
            // A .usda is written with its pictures.
            let length = path.metadata().unwrap().len();
            assert!(report.bytes == length || extension == "usda" && report.bytes > length);
            let back = read_file(&path, &ReadOptions::default()).unwrap();
            assert!(!back.y_up && back.notes.is_empty(), "{:?}", back.notes);
            assert_eq!(back.scene.splats.len(), 30);
            assert_eq!(scene.meshes.len() - back.scene.meshes.len(), report.loss.meshes);
            assert_eq!(cameras.len() - back.cameras.len(), report.loss.cameras);
            assert_eq!(back.scene.composition != scene.composition, report.loss.composition);
            let holds_meshes = Format::of_path(&path).is_some_and(Format::holds_meshes);
            assert_eq!(holds_meshes, report.loss.meshes == 0, "{extension}");
            if holds_meshes {
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
        for extension in endings() {
            let path = folder.path().join(format!("a.{extension}"));
            let options = WriteOptions { record: Some(&record), ..WriteOptions::default() };
            let loss = write_scene(&path, &scene, &options).unwrap().loss;
            let back = read_file(&path, &ReadOptions::default()).unwrap().record;
            assert_eq!(loss.record, back.is_none(), "{extension}");
            assert_eq!(loss.to_string().contains("the record of the training"), back.is_none(), "{extension}: {loss}");
            assert!(back.is_none_or(|back| back == record), "{extension}");
            assert_eq!(Format::of_path(&path).is_some_and(Format::holds_meshes), !loss.record, "{extension}");
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
