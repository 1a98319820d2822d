//! Smooth camera path through views.

use std::ops::{Add, Mul, Sub};

use glam::{DMat3, DQuat, DVec3, DVec4};

use super::{PathError, Shot, intrinsics};
use crate::scene::Camera;

/// Choice of the views through which a spline passes.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spline {
    /// Number of views used as keys, picked at even spacing in their order; `None` or more than there are: all.
    pub keys: Option<usize>,
    /// Whether the path continues from the last key to the first.
    pub closed: bool,
}

/// Number of chords by which the length of a segment is measured.
const CHORDS: usize = 256;

/// Distance at which camera centres count as equal, relative to their largest distance from the origin.
const ROUNDING: f64 = 1e-12;

/// Keys are merged if the sum of their distance and angle, each relative to its mean, is less than this: the velocity
/// at both would be nearly zero and the path would have a corner there.
const ONE_KEY: f64 = 1e-3;

/// A segment counts as turning in place if its length is less than this fraction of the length equivalent of its angle.
const IN_PLACE: f64 = 0.01;

/// Catmull–Rom spline with centripetal knots (whose spacing is the square root of distance plus angle, each relative to
/// its mean) through the keys' positions, and likewise through their rotations as quaternions, which are then
/// normalised: both have continuous velocities. Frames are evenly spaced in arc length, or in angle where the camera
/// turns in place. An open path begins at the first key and ends at the last; a closed one can be looped.
///
/// # Errors
/// If there are fewer than two views, or all are equal.
pub fn spline(views: &[Camera], options: &Spline, shot: &Shot) -> Result<Vec<Camera>, PathError> {
    let k = intrinsics(views, shot)?;
    let keys = Keys::new(&pick(views, options), options.closed)?;
    let table = keys.lengths();
    let total = table[table.len() - 1];
    let spans = if options.closed { shot.frames } else { shot.frames.saturating_sub(1).max(1) };
    let frame = |i: usize| {
        let at = total * i as f64 / spans as f64;
        // `low`: last table entry at or before `at`; `part`: fraction of the way to the next entry.
        let low = table.partition_point(|&s| s <= at).saturating_sub(1).min(table.len() - 2);
        let part = ((at - table[low]) / (table[low + 1] - table[low]).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
        let (segment, u) = (low / CHORDS, (low % CHORDS) as f64 + part);
        let (center, rotation) = keys.at(segment, u / CHORDS as f64);
        let to_camera = DMat3::from_quat(rotation).transpose();
        Ok(Camera::new(k, to_camera, -(to_camera * center))?)
    };
    (0..shot.frames).map(frame).collect()
}

fn pick(views: &[Camera], options: &Spline) -> Vec<Camera> {
    let n = views.len();
    let count = options.keys.unwrap_or(n).min(n);
    let spans = if options.closed { count } else { count.saturating_sub(1) }.max(1);
    let last = if options.closed { n } else { n.saturating_sub(1) };
    (0..count).map(|i| views[(i * last + spans / 2) / spans]).collect()
}

/// Camera centre and camera→world rotation.
type Key = (DVec3, DQuat);

/// Keys in order, without repetitions.
struct Keys {
    positions: Vec<DVec3>,
    /// Camera→world rotations.
    rotations: Vec<DQuat>,
    /// Knot spacing of every segment.
    spacing: Vec<f64>,
    closed: bool,
}

impl Keys {
    fn new(views: &[Camera], closed: bool) -> Result<Self, PathError> {
        let mut keys: Vec<Key> = vec![];
        let pose = |view: &Camera| (view.center(), DQuat::from_mat3(&view.rotation().transpose()).normalize());
        let is_same = |a: &Key, b: &Key| a.0 == b.0 && angle(a.1, b.1) < 1e-9;
        // Centres are computed from poses: the same place may differ by rounding.
        let rounding = ROUNDING * views.iter().map(|view| view.center().length()).fold(0.0, f64::max);
        for mut key in views.iter().map(pose) {
            if let Some(last) = keys.last().filter(|last| last.0.distance(key.0) <= rounding) {
                key.0 = last.0;
            }
            if keys.last().is_none_or(|last| !is_same(last, &key)) {
                keys.push(key);
            }
        }
        let apart: [fn(&Key, &Key) -> f64; 2] = [|a, b| a.0.distance(b.0), |a, b| angle(a.1, b.1)];
        let means = apart.map(|of| keys.windows(2).map(|w| of(&w[0], &w[1])).sum::<f64>() / keys.len() as f64);
        let is_near = |a: &Key, b: &Key| {
            let relative = |(of, mean): (&fn(&Key, &Key) -> f64, f64)| if mean > 0.0 { of(a, b) / mean } else { 0.0 };
            apart.iter().zip(means).map(relative).sum::<f64>() < ONE_KEY
        };
        keys.dedup_by(|key, last| is_near(last, key));
        while closed && keys.len() > 1 && is_near(&keys[0], &keys[keys.len() - 1]) {
            keys.pop();
        }
        if keys.len() < 2 {
            return Err(PathError::TooFew { expected: 2, found: keys.len() });
        }
        let (positions, rotations): (Vec<DVec3>, Vec<DQuat>) = keys.into_iter().unzip();
        let n = positions.len();
        let segments = if closed { n } else { n - 1 };
        let steps = |of: &dyn Fn(usize, usize) -> f64| -> Vec<f64> {
            let all: Vec<f64> = (0..segments).map(|i| of(i, (i + 1) % n)).collect();
            let mean = all.iter().sum::<f64>() / segments as f64;
            all.into_iter().map(|step| if mean > 0.0 { step / mean } else { 0.0 }).collect()
        };
        let chords = steps(&|i, j| positions[i].distance(positions[j]));
        let angles = steps(&|i, j| angle(rotations[i], rotations[j]));
        // Centripetal in distance and angle: if only distance counted, a turn in place would take no time and distort
        // the neighbouring segments.
        let spacing = chords.into_iter().zip(angles).map(|(chord, angle)| (chord + angle).sqrt()).collect();
        Ok(Self { positions, rotations, spacing, closed })
    }

    /// Camera centre and camera→world rotation at parameter `u` in [0, 1] of a segment.
    fn at(&self, segment: usize, u: f64) -> (DVec3, DQuat) {
        let n = self.positions.len();
        let key = |offset: isize| -> Option<usize> {
            let i = segment as isize + offset;
            if self.closed {
                Some(i.rem_euclid(n as isize) as usize)
            } else {
                usize::try_from(i).ok().filter(|i| *i < n)
            }
        };
        let (here, next) = (segment, (segment + 1) % n);
        let count = self.spacing.len();
        let spacing = [(segment + count - 1) % count, segment, (segment + 1) % count].map(|i| self.spacing[i]);
        let p = |i: usize| self.positions[i];
        let position = if p(here) == p(next) {
            p(here)
        } else {
            hermite(key(-1).map(p), p(here), p(next), key(2).map(p), spacing, u)
        };
        // q and −q are the same rotation: neighbours are flipped into the same hemisphere.
        let near = |i: usize, to: DVec4| {
            let q = DVec4::from_array(self.rotations[i].to_array());
            if q.dot(to) < 0.0 { -q } else { q }
        };
        let a = DVec4::from_array(self.rotations[here].to_array());
        let b = near(next, a);
        let q = hermite(key(-1).map(|i| near(i, a)), a, b, key(2).map(|i| near(i, b)), spacing, u);
        // Overshoot between widely differing keys could pass near the origin.
        let q = if q.length() > 1e-3 { q } else { a.lerp(b, u) };
        (position, DQuat::from_array(q.to_array()).normalize())
    }

    /// Cumulative path length at every chord endpoint, from 0.
    fn lengths(&self) -> Vec<f64> {
        let parts: Vec<Vec<(f64, f64)>> = (0..self.spacing.len())
            .map(|segment| {
                let points: Vec<_> = (0..=CHORDS).map(|i| self.at(segment, i as f64 / CHORDS as f64)).collect();
                points.windows(2).map(|w| (w[0].0.distance(w[1].0), angle(w[0].1, w[1].1))).collect()
            })
            .collect();
        let sum = |parts: &mut dyn Iterator<Item = &(f64, f64)>| parts.fold((0.0, 0.0), |s, p| (s.0 + p.0, s.1 + p.1));
        let sums = sum(&mut parts.iter().flatten());
        // Length equivalent of a radian where the camera only turns: the ratio of length to angle over the whole path.
        let per_radian = if sums.0 > 0.0 && sums.1 > 0.0 { sums.0 / sums.1 } else { 1.0 };
        let mut table = vec![0.0];
        for segment in parts {
            let own = sum(&mut segment.iter());
            let turns = own.0 < IN_PLACE * own.1 * per_radian;
            for (length, angle) in segment {
                table.push(table[table.len() - 1] + if turns { angle * per_radian } else { length });
            }
        }
        table
    }
}

/// Angle between two rotations, 0 to π; accurate for small angles, unlike the inverse cosine.
fn angle(a: DQuat, b: DQuat) -> f64 {
    let d = a.conjugate() * b;
    2.0 * d.xyz().length().atan2(d.w.abs())
}

trait Vector: Copy + Add<Output = Self> + Sub<Output = Self> + Mul<f64, Output = Self> {}
impl<T: Copy + Add<Output = T> + Sub<Output = T> + Mul<f64, Output = T>> Vector for T {}

/// Cubic Hermite interpolation between `b` and `c`, whose outer neighbours are `a` and `d`; an end without a neighbour
/// has zero curvature. `spacing` is the knot spacing between the four.
fn hermite<V: Vector>(a: Option<V>, b: V, c: V, d: Option<V>, spacing: [f64; 3], u: f64) -> V {
    let [before, own, after] = spacing;
    let slope = (c - b) * own.recip();
    // Velocity at a key of the parabola through the key and its neighbours.
    let through = |first: V, h0: f64, second: V, h1: f64| (first * h1 + second * h0) * (h0 + h1).recip();
    let start = a.map(|a| through((b - a) * before.recip(), before, slope, own));
    let end = d.map(|d| through(slope, own, (d - c) * after.recip(), after));
    let free = |other: V| slope * 1.5 - other * 0.5;
    let (start, end) = match (start, end) {
        (Some(start), Some(end)) => (start, end),
        (Some(start), None) => (start, free(start)),
        (None, Some(end)) => (free(end), end),
        (None, None) => (slope, slope),
    };
    let (u2, u3) = (u * u, u * u * u);
    b * (2.0 * u3 - 3.0 * u2 + 1.0)
        + start * (own * (u3 - 2.0 * u2 + u))
        + c * (3.0 * u2 - 2.0 * u3)
        + end * (own * (u3 - u2))
}
