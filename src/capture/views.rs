//! Views: names, images, masks, sizes and poses from a capture's files are checked here once for all formats.

use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::distortion::Lens;
use super::{CaptureError, ImageSource, LoadOptions, View, image_file, masks};
use crate::scene::{Camera, frame};

/// A posed picture as stated by a capture's files.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    pub(super) name: String,
    /// File that lists the frame.
    pub(super) list: Arc<Path>,
    /// Position in that file: `line 7`, `byte 120`, `/frames/3`.
    pub(super) at: String,
    pub(super) image: PathBuf,
    /// Mask named by the files.
    pub(super) mask: Option<PathBuf>,
    /// Lens at the size that the files declare.
    pub(super) lens: Lens,
    /// Whether the files declare a size; else that of the image applies, if there is one.
    pub(super) has_size: bool,
    /// World→camera rotation.
    pub(super) rotation: DMat3,
    /// World→camera translation.
    pub(super) translation: DVec3,
    /// Part in the capture's own split, if it has one.
    pub(super) held_out: Option<bool>,
    /// See [`ImageSource::time`].
    pub(super) time: Option<f64>,
    /// See [`View::sees`].
    pub(super) sees: Vec<u32>,
}

impl Frame {
    /// The frame in the world after half a turn about x.
    pub(super) fn turned(self) -> Self {
        Self { rotation: frame::in_turned_world(self.rotation), ..self }
    }

    /// Position in the list, with the image's name.
    pub(super) fn place(&self) -> String {
        format!("{}, image {}", self.at, self.name)
    }
}

/// `name` as a path, if it stays inside the folder it is joined to. `list` is the file that contains the name, at `at`.
pub(super) fn inside<'a>(list: &Path, at: &str, name: &'a str) -> Result<&'a Path, CaptureError> {
    let path = Path::new(name);
    let inner = path.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    if inner && path.file_name().is_some() {
        return Ok(path);
    }
    Err(CaptureError::invalid(list, at, "a path inside the capture", format!("{name:?}")))
}

/// Checks frames and turns them into views sorted by name. `list` is named in the error if there are too few frames.
pub(super) fn assemble(
    mut frames: Vec<Frame>,
    list: &Path,
    root: &Path,
    options: &LoadOptions,
) -> Result<Vec<View>, CaptureError> {
    if frames.len() < 2 {
        return Err(CaptureError::invalid(list, "views", "at least 2 posed images", frames.len().to_string()));
    }
    frames.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(pair) = frames.windows(2).find(|pair| pair[0].name == pair[1].name) {
        return Err(CaptureError::invalid(
            &pair[1].list,
            &pair[1].at,
            "unique names",
            format!("{} twice", pair[0].name),
        ));
    }
    // No name of a folder says less than that of the list.
    let place = if root == Path::new(".") { list } else { root };
    all_exist(
        place,
        "images",
        frames.iter().map(|f| (f.image.strip_prefix(root).unwrap_or(&f.image), f.image.is_file())),
    )?;
    if options.masks {
        let folder = root.join("masks");
        if folder.is_dir() {
            for frame in &mut frames {
                if frame.mask.is_none() {
                    frame.mask = find_mask(&folder, &frame.name);
                }
            }
        }
        // Masks named by files, which need not be in that folder.
        let masks = || frames.iter().filter_map(|f| f.mask.as_deref());
        all_exist(root, "masks", masks().map(|mask| (mask.strip_prefix(root).unwrap_or(mask), mask.is_file())))?;
        if masks().next().is_some() || folder.is_dir() {
            let place = if folder.is_dir() { &folder } else { root };
            all_exist(place, "masks", frames.iter().map(|f| (Path::new(&f.name), f.mask.is_some())))?;
        }
        masks::check_masks(&masks().collect::<Vec<_>>())?;
    }
    frames.into_par_iter().map(|frame| view(frame, options)).collect()
}

/// Checks that all files exist.
fn all_exist<'a>(
    folder: &Path,
    what: &'static str,
    found: impl Iterator<Item = (&'a Path, bool)>,
) -> Result<(), CaptureError> {
    let (mut total, mut missing) = (0, vec![]);
    for (name, exists) in found {
        total += 1;
        if !exists {
            missing.push(name);
        }
    }
    match missing.first() {
        None => Ok(()),
        Some(first) => {
            let (folder, first) = (folder.into(), first.display().to_string());
            Err(CaptureError::Missing { folder, what, count: missing.len(), total, first })
        }
    }
}

/// Mask of an image by COLMAP's rule (`<name>.png`), or with its suffix replaced by `.png` if it has one (`frame.001`
/// has none), or with the same name.
pub(super) fn find_mask(folder: &Path, name: &str) -> Option<PathBuf> {
    let name = name.strip_prefix("images/").unwrap_or(name);
    let path = folder.join(name);
    let other = image::ImageFormat::from_path(&path).is_ok().then(|| path.with_extension("png"));
    [Some(folder.join(format!("{name}.png"))), other, Some(path)].into_iter().flatten().find(|path| path.is_file())
}

/// Reads the image's header and determines size, orientation and camera.
pub(super) fn view(frame: Frame, options: &LoadOptions) -> Result<View, CaptureError> {
    let place = frame.place();
    let Frame { name, list, at: _, image, mask, lens, has_size: _, rotation, translation, held_out, time, sees } =
        frame;
    let declared = (lens.intrinsics.width, lens.intrinsics.height);
    let header = image_file::header(&image)?;
    // COLMAP, nerfstudio and instant-ngp read pictures as stored, so poses refer to those, whatever EXIF says; for
    // pictures that were rotated before by a program that left the note, only the upright one fits.
    let ways = [header.stored(), header.upright()];
    let (orientation, (width, height)) = image_file::fitting(ways, declared).ok_or_else(|| {
        let (_, (w, h)) = header.stored();
        let expected = format!("the aspect ratio of its camera, {}×{}", declared.0, declared.1);
        CaptureError::invalid(&image, "image size", expected, format!("{w}×{h}"))
    })?;
    let lens = lens.resized(width, height);
    let camera =
        Camera::new(lens.pinhole(), rotation, translation).map_err(|e| CaptureError::scene(&list, &place, e))?;
    let size = options.downscale.size(width, height);
    let mask = mask.filter(|_| options.masks);
    let stores_alpha = header.has_alpha;
    let source = ImageSource { image, mask, orientation, lens, size, held_out, time, stores_alpha };
    Ok(View { name, camera: camera.resized(size.0, size.1), source, sees })
}
