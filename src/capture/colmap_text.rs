//! COLMAP text files `cameras.txt`, `images.txt`, `points3D.txt`: one record per line (images: two), `#` starts a
//! comment.

use std::collections::HashMap;
use std::path::Path;
use std::str::{FromStr, SplitWhitespace};

use glam::DVec3;

use super::colmap_records::{self, ImageRecord, PointRecords};
use super::distortion::Lens;
use super::{CaptureError, Point};

/// The words of one line.
struct Line<'a> {
    words: SplitWhitespace<'a>,
    number: usize,
    path: &'a Path,
}

impl<'a> Line<'a> {
    fn invalid(&self, expected: &str, found: &str) -> CaptureError {
        CaptureError::invalid(self.path, format!("line {}", self.number), expected, found)
    }

    fn word(&mut self, what: &str) -> Result<&'a str, CaptureError> {
        self.words.next().ok_or_else(|| self.invalid(what, "the end of the line"))
    }

    fn number<T: FromStr>(&mut self, what: &str) -> Result<T, CaptureError> {
        let word = self.word(what)?;
        word.parse().map_err(|_| self.invalid(what, word))
    }

    fn numbers<T: FromStr + Copy + Default, const N: usize>(&mut self, what: &str) -> Result<[T; N], CaptureError> {
        let mut values = [T::default(); N];
        for v in &mut values {
            *v = self.number(what)?;
        }
        Ok(values)
    }
}

/// The lines of a file that are not comments, blank ones included, since an image without observations has one.
fn lines<'a>(text: &'a str, path: &'a Path) -> impl Iterator<Item = (&'a str, Line<'a>)> {
    text.lines()
        .enumerate()
        .filter(|(_, text)| !text.trim_start().starts_with('#'))
        .map(move |(i, text)| (text.trim(), Line { words: text.split_whitespace(), number: i + 1, path }))
}

/// Cameras by number.
pub(super) fn cameras(text: &str, path: &Path) -> Result<HashMap<u32, Lens>, CaptureError> {
    let mut cameras = HashMap::new();
    for (_, mut line) in lines(text, path).filter(|(text, _)| !text.is_empty()) {
        let number = line.number;
        let id: u32 = line.number("a camera id")?;
        let model = line.word("a camera model")?;
        let [width, height] = line.numbers("a width and a height")?;
        let unsupported = || CaptureError::UnsupportedModel {
            path: path.into(),
            place: format!("line {number}"),
            model: model.into(),
        };
        let count = colmap_records::parameter_count(model).ok_or_else(unsupported)?;
        let values: Vec<f64> =
            (0..count).map(|_| line.number("a camera parameter")).collect::<Result<_, CaptureError>>()?;
        if let Some(v) = values.iter().find(|v| !v.is_finite()) {
            return Err(line.invalid("finite camera parameters", &v.to_string()));
        }
        if let Some(word) = line.words.next() {
            return Err(line.invalid(&format!("{count} parameters of {model}"), &format!("{word} after them")));
        }
        let lens = colmap_records::lens(model, &values, width, height).ok_or_else(unsupported)?;
        if let Some(focal) = colmap_records::unfit_focal_length(&lens) {
            return Err(line.invalid("positive focal lengths", &focal.to_string()));
        }
        if cameras.insert(id, lens).is_some() {
            return Err(line.invalid("a new camera id", &id.to_string()));
        }
    }
    Ok(cameras)
}

/// Images in the order of the file; the second line of each, its 2-D points, is skipped.
pub(super) fn images(text: &str, path: &Path) -> Result<Vec<ImageRecord>, CaptureError> {
    let mut images = Vec::new();
    let mut lines = lines(text, path);
    while let Some((text, mut line)) = lines.next() {
        if text.is_empty() {
            continue;
        }
        let id = line.number("an image id")?;
        let rotation = line.numbers("a quaternion")?;
        let translation = line.numbers("a translation")?;
        let camera = line.number("a camera id")?;
        // A name may contain spaces: it is everything after the ninth word.
        let name = (0..9).fold(text, |rest, _| rest.trim_start_matches(|c: char| !c.is_whitespace()).trim_start());
        if name.is_empty() {
            return Err(line.invalid("an image name", "the end of the line"));
        }
        images.push(ImageRecord {
            at: format!("line {}", line.number),
            id,
            name: name.to_owned(),
            camera,
            rotation,
            translation,
        });
        let Some((points, line)) = lines.next() else { break };
        // If empty lines had been removed, every second image would be skipped.
        let words: Vec<&str> = points.split_whitespace().collect();
        let is_point = |last: &&str| last.parse::<i64>().is_ok();
        if !words.len().is_multiple_of(3) || !words.last().is_none_or(is_point) {
            let found = format!("{} words that end with {}", words.len(), words[words.len() - 1]);
            return Err(line.invalid("the 2-D points of the image above, or an empty line", &found));
        }
    }
    Ok(images)
}

/// Points in the order of the file.
pub(super) fn points(text: &str, path: &Path) -> Result<PointRecords, CaptureError> {
    let mut records = PointRecords::default();
    for (_, mut line) in lines(text, path).filter(|(text, _)| !text.is_empty()) {
        line.number::<u64>("a point id")?;
        let position = DVec3::from(line.numbers("a position")?);
        if !position.is_finite() {
            return Err(line.invalid("finite numbers", &format!("{:?}", position.to_array())));
        }
        let rgb = line.numbers("a colour of 0 to 255")?;
        // The reprojection error is followed by pairs of image number and index of its 2-D point.
        line.words.next();
        let mut track = vec![];
        while line.words.clone().next().is_some() {
            track.push(line.number("an image id of a track")?);
            line.number::<u32>("a 2-D point of a track")?;
        }
        records.points.push(Point { position, rgb });
        records.tracks.push(track);
    }
    Ok(records)
}
