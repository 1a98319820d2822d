//! A grid of square cells over the image, shared by `background` and `coverage` to find cells without points; and
//! helpers that both use.

use glam::{DVec2, DVec3, USizeVec2};

use crate::scene::Camera;

/// Side of a cell, as a fraction of the longer side of the image.
const CELL: f64 = 0.03;
/// Most pictures to look at, since each is decoded for it.
const PICTURES: usize = 128;
/// Difference per channel below which two colours count as equal: two steps of 255.
const ONE_COLOR: f32 = 2.0 / 255.0;

/// Step through `views` such that at most [`PICTURES`] are looked at.
pub(super) fn stride(views: usize) -> usize {
    views.div_ceil(PICTURES).max(1)
}

/// Whether a splat of this colour would look like the background without it; never if the background changes with every
/// iteration (`None`).
pub(super) fn is_needless(color: [f32; 3], background: Option<[f32; 3]>) -> bool {
    background.is_some_and(|empty| color.iter().zip(empty).all(|(c, e)| (c - e).abs() < ONE_COLOR))
}

/// At most `most` elements, evenly spaced over `all`.
pub(super) fn evenly<T>(all: &[T], most: usize) -> Vec<&T> {
    let n = all.len().min(most);
    (0..n).map(|i| &all[i * all.len() / n]).collect()
}

/// A grid of cells over a camera's image, row by row from the top.
pub(super) struct Cells {
    pub(super) camera: Camera,
    /// Side of a cell, pixels; at least one.
    pub(super) side: f64,
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl Cells {
    pub(super) fn new(camera: &Camera) -> Self {
        let k = camera.intrinsics();
        let side = (CELL * f64::from(k.longer_side())).max(1.0);
        let cells = |pixels: u32| (f64::from(pixels) / side).ceil() as usize;
        Self { camera: *camera, side, columns: cells(k.width), rows: cells(k.height) }
    }

    pub(super) fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// Index of the cell that holds an image position, pixels.
    pub(super) fn at(&self, uv: DVec2) -> usize {
        // A position just inside the border may be rounded onto it.
        let at = (uv / self.side).as_usizevec2().min(USizeVec2::new(self.columns - 1, self.rows - 1));
        at.y * self.columns + at.x
    }

    /// Index of the cell that a camera-space point or direction projects into, if it is in the picture.
    pub(super) fn of(&self, p: DVec3) -> Option<usize> {
        self.camera.in_picture(p).map(|uv| self.at(uv))
    }

    /// Pixel ranges of a cell, `[from, to)` in x and in y.
    pub(super) fn pixels(&self, cell: usize) -> [[u32; 2]; 2] {
        let k = self.camera.intrinsics();
        let range = |at: usize, size: u32| {
            let edge = |n: usize| ((n as f64 * self.side).round() as u32).min(size);
            [edge(at), edge(at + 1)]
        };
        [range(cell % self.columns, k.width), range(cell / self.columns, k.height)]
    }

    /// A cell and its up to eight neighbours.
    pub(super) fn around(&self, cell: usize) -> impl Iterator<Item = usize> + use<> {
        let near = |at: usize, count: usize| at.saturating_sub(1)..(at + 2).min(count);
        let (columns, width) = (near(cell % self.columns, self.columns), self.columns);
        near(cell / self.columns, self.rows)
            .flat_map(move |row| columns.clone().map(move |column| row * width + column))
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;
    use crate::scene::{Intrinsics, testing::ahead};

    #[test]
    fn cells_cover_the_picture_once() {
        for (width, height) in [(100, 50), (176, 118), (1, 1), (20, 333), (105, 63)] {
            let k = Intrinsics { width, height, fx: 90.0, fy: 90.0, cx: 10.0, cy: 5.0 };
            let cells = Cells::new(&Camera::new(k, DMat3::IDENTITY, DVec3::ZERO).unwrap());
            let mut times = vec![0; (width * height) as usize];
            for cell in 0..cells.len() {
                let [[left, right], [top, bottom]] = cells.pixels(cell);
                (top..bottom).for_each(|y| (left..right).for_each(|x| times[(y * width + x) as usize] += 1));
                let middle = DVec2::new(f64::from(left + right), f64::from(top + bottom)) / 2.0;
                assert!(left == right || top == bottom || cells.at(middle) == cell, "{cell} of {width}×{height}");
            }
            assert!(times.iter().all(|n| *n == 1), "{width}×{height}");
            assert_eq!(cells.of(cells.camera.ray(DVec2::new(0.5, 0.5))), Some(0));
            assert_eq!(cells.of(-DVec3::Z), None);
            let last = DVec2::new(f64::from(width).next_down(), f64::from(height).next_down());
            assert_eq!(cells.at(last), cells.len() - 1);
        }
    }

    #[test]
    fn some_are_taken_evenly() {
        assert_eq!(evenly(&[1, 2, 3, 4, 5, 6], 3), [&1, &3, &5]);
        assert_eq!(evenly(&[1, 2], 3), [&1, &2]);
        assert!(evenly(&[1, 2], 0).is_empty() && evenly::<u8>(&[], 3).is_empty());
        assert_eq!([0, 1, 128, 129, 400].map(stride), [1, 1, 1, 2, 4]);
    }

    #[test]
    fn cells_at_the_border_have_fewer_around_them() {
        let cells = Cells::new(&ahead([100, 50], 90.0, DVec3::ZERO));
        assert_eq!((cells.columns, cells.rows), (34, 17));
        assert_eq!(cells.around(0).collect::<Vec<_>>(), [0, 1, 34, 35]);
        assert_eq!(cells.around(34 + 1).count(), 9);
        assert_eq!(cells.around(cells.len() - 1).count(), 4);
    }
}
