//! Binary COLMAP files `cameras.bin`, `images.bin`, `points3D.bin`: little endian, counts first.

use std::collections::HashMap;
use std::path::Path;

use glam::DVec3;

use super::colmap_records::{self, ImageRecord, PointRecords};
use super::distortion::Lens;
use super::{CaptureError, Point};

/// Reader of numbers from the front of a file, which tracks its position.
struct Cursor<'a> {
    bytes: &'a [u8],
    offset: usize,
    path: &'a Path,
}

impl<'a> Cursor<'a> {
    fn new(bytes: &'a [u8], path: &'a Path) -> Self {
        Self { bytes, offset: 0, path }
    }

    fn left(&self) -> usize {
        self.bytes.len() - self.offset
    }

    fn truncated(&self, expected: impl Into<String>) -> CaptureError {
        CaptureError::Truncated { path: self.path.into(), offset: self.bytes.len(), expected: expected.into() }
    }

    fn take<const N: usize>(&mut self, what: &str) -> Result<[u8; N], CaptureError> {
        match self.bytes[self.offset..].first_chunk::<N>() {
            Some(chunk) => {
                self.offset += N;
                Ok(*chunk)
            }
            None => Err(self.truncated(format!("{N} bytes of {what} at byte {}", self.offset))),
        }
    }

    fn u32(&mut self, what: &str) -> Result<u32, CaptureError> {
        self.take(what).map(u32::from_le_bytes)
    }

    fn u64(&mut self, what: &str) -> Result<u64, CaptureError> {
        self.take(what).map(u64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self, what: &str) -> Result<[f64; N], CaptureError> {
        let mut values = [0.0; N];
        for v in &mut values {
            *v = self.take(what).map(f64::from_le_bytes)?;
        }
        Ok(values)
    }

    /// Reads a count of records of at least `size` bytes, and fails if the file cannot hold them, so that nothing is
    /// allocated on the word of the file alone.
    fn count(&mut self, size: usize, what: &str) -> Result<usize, CaptureError> {
        let count = self.u64(what)?;
        match usize::try_from(count).ok().filter(|&n| n <= self.left() / size) {
            Some(n) => Ok(n),
            None => Err(self.truncated(format!("{count} {what} of {size} bytes or more from byte {}", self.offset))),
        }
    }

    fn skip(&mut self, count: usize, size: usize) {
        self.offset += count * size;
    }

    /// Checks that nothing follows the last record.
    fn end(&self, records: &str) -> Result<(), CaptureError> {
        match self.left() {
            0 => Ok(()),
            left => Err(self.invalid(self.offset, "end", &format!("no more than {records}"), format!("{left} bytes"))),
        }
    }

    fn invalid(&self, at: usize, what: &str, expected: &str, found: impl Into<String>) -> CaptureError {
        CaptureError::invalid(self.path, format!("{what} at byte {at}"), expected, found)
    }
}

/// Cameras by number.
pub(super) fn cameras(bytes: &[u8], path: &Path) -> Result<HashMap<u32, Lens>, CaptureError> {
    let mut file = Cursor::new(bytes, path);
    let count = file.count(4 + 4 + 8 + 8, "cameras")?;
    let mut cameras = HashMap::with_capacity(count);
    for _ in 0..count {
        let at = file.offset;
        let id = file.u32("camera id")?;
        let model = file.take("camera model").map(i32::from_le_bytes)?;
        let [width, height] = [file.u64("width")?, file.u64("height")?];
        let (Ok(width), Ok(height)) = (u32::try_from(width), u32::try_from(height)) else {
            return Err(file.invalid(at, "camera", "a width and height below 2^32", format!("{width}×{height}")));
        };
        let unsupported = |model: String| CaptureError::UnsupportedModel {
            path: path.into(),
            place: format!("camera at byte {at}"),
            model,
        };
        let (name, parameters) = colmap_records::model_of_id(model).ok_or_else(|| unsupported(model.to_string()))?;
        let values = (0..parameters)
            .map(|_| file.f64s::<1>("camera parameters").map(|[v]| v))
            .collect::<Result<Vec<f64>, _>>()?;
        if let Some(v) = values.iter().find(|v| !v.is_finite()) {
            return Err(file.invalid(at, "camera", "finite parameters", v.to_string()));
        }
        let lens = colmap_records::lens(name, &values, width, height).ok_or_else(|| unsupported(name.into()))?;
        if let Some(focal) = colmap_records::unfit_focal_length(&lens) {
            return Err(file.invalid(at, "camera", "positive focal lengths", focal.to_string()));
        }
        if cameras.insert(id, lens).is_some() {
            return Err(file.invalid(at, "camera", "a new number", id.to_string()));
        }
    }
    file.end(&format!("{count} cameras"))?;
    Ok(cameras)
}

/// Images in the order of the file; their 2-D points are skipped.
pub(super) fn images(bytes: &[u8], path: &Path) -> Result<Vec<ImageRecord>, CaptureError> {
    let mut file = Cursor::new(bytes, path);
    let count = file.count(4 + 7 * 8 + 4 + 1 + 8, "images")?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        let at = format!("byte {}", file.offset);
        let id = file.u32("image id")?;
        let rotation = file.f64s("rotation")?;
        let translation = file.f64s("translation")?;
        let camera = file.u32("camera id")?;
        let start = file.offset;
        let Some(length) = bytes[start..].iter().position(|&b| b == 0) else {
            return Err(file.truncated(format!("the end of the image name that starts at byte {start}")));
        };
        let name = std::str::from_utf8(&bytes[start..start + length])
            .map_err(|_| file.invalid(start, "image name", "UTF-8", "other bytes"))?
            .to_owned();
        file.skip(length + 1, 1);
        let observations = file.count(24, "2-D points")?;
        file.skip(observations, 24);
        images.push(ImageRecord { at, id, name, camera, rotation, translation });
    }
    file.end(&format!("{count} images"))?;
    Ok(images)
}

/// Points in the order of the file.
pub(super) fn points(bytes: &[u8], path: &Path) -> Result<PointRecords, CaptureError> {
    let mut file = Cursor::new(bytes, path);
    let count = file.count(8 + 3 * 8 + 3 + 8 + 8, "points")?;
    let mut records = PointRecords { points: Vec::with_capacity(count), tracks: Vec::with_capacity(count) };
    for _ in 0..count {
        let at = file.offset;
        file.u64("point id")?;
        let position = DVec3::from(file.f64s("position")?);
        if !position.is_finite() {
            return Err(file.invalid(at, "point", "finite numbers", format!("{:?}", position.to_array())));
        }
        let rgb = file.take("colour")?;
        file.f64s::<1>("reprojection error")?;
        let elements = file.count(8, "track elements")?;
        let mut track = Vec::with_capacity(elements);
        for _ in 0..elements {
            track.push(file.u32("image id of a track")?);
            file.u32("2-D point of a track")?;
        }
        records.points.push(Point { position, rgb });
        records.tracks.push(track);
    }
    file.end(&format!("{count} points"))?;
    Ok(records)
}
