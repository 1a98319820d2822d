//! Lens distortion: the camera models of COLMAP, forward in closed form and backward by Newton's
//! method, and the resampling of a photograph to a pinhole image.
//!
//! All functions work on the plane z = 1: `p = (x/z, y/z)` of a camera-space point.

use glam::{DMat2, DVec2};

use crate::scene::Intrinsics;

/// Lens with distortion: a pixel is `(fx, fy)·distortion(p) + (cx, cy)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Focal lengths, principal point and size, in pixels of the photograph.
    pub intrinsics: Intrinsics,
    /// Distortion on the plane z = 1.
    pub distortion: Distortion,
}

/// Families of lens distortion; each COLMAP model is one of them with some parameters 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// An ideal pinhole: the photograph is used as it is.
    None,
    /// `SIMPLE_RADIAL`, `RADIAL`, `OPENCV`, `FULL_OPENCV`: `p·(1+k₁r²+k₂r⁴+k₃r⁶)/(1+k₄r²+k₅r⁴+k₆r⁶)` + tangential.
    Brown {
        /// k₁ to k₆.
        k: [f64; 6],
        /// Tangential p₁, p₂.
        p: [f64; 2],
    },
    /// `SIMPLE_FISHEYE`, `FISHEYE`, `SIMPLE_RADIAL_FISHEYE`, `RADIAL_FISHEYE`, `OPENCV_FISHEYE`,
    /// `THIN_PRISM_FISHEYE`: with θ = atan r and q = p·θ/r: `q·(1+k₁θ²+…+k₄θ⁸)` + tangential and prism terms of q.
    Fisheye {
        /// k₁ to k₄.
        k: [f64; 4],
        /// Tangential p₁, p₂.
        p: [f64; 2],
        /// Prism: s₁θ², s₂θ².
        s: [f64; 2],
    },
    /// `RAD_TAN_THIN_PRISM_FISHEYE` (Project Aria): as `Fisheye`, but the tangential and prism terms are those of
    /// the already radially distorted point.
    RadTanFisheye {
        /// k₀ to k₅, of θ² to θ¹².
        k: [f64; 6],
        /// Tangential p₀, p₁.
        p: [f64; 2],
        /// Prism s₀ to s₃: s₀r²+s₁r⁴, s₂r²+s₃r⁴.
        s: [f64; 4],
    },
    /// `FOV`: radius `atan(2 r tan(ω/2))/ω`.
    Fov {
        /// ω in radians.
        omega: f64,
    },
    /// `SIMPLE_DIVISION`, `DIVISION`: the radius d for which `d/(1+k d²) = r`.
    Division {
        /// k.
        k: f64,
    },
    /// `EUCM`, the enhanced unified camera model: `p/(α√(β r²+1) + 1−α)`.
    Eucm {
        /// α.
        alpha: f64,
        /// β.
        beta: f64,
    },
}

/// `x·(c₀ + x·(c₁ + …))`, the polynomial without its constant term.
fn polynomial(coefficients: &[f64], x: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, c| (sum + c) * x)
}

/// Brown's tangential term of `q`.
fn tangential([p1, p2]: [f64; 2], q: DVec2) -> DVec2 {
    let (r2, xy) = (q.length_squared(), 2.0 * q.x * q.y);
    DVec2::new(p1 * xy + p2 * (r2 + 2.0 * q.x * q.x), p2 * xy + p1 * (r2 + 2.0 * q.y * q.y))
}

impl Distortion {
    /// Distance from the centre to which the radially symmetric part moves a point at distance `r`.
    fn radial(&self, r: f64) -> f64 {
        match self {
            Self::None => r,
            Self::Brown { k, .. } => r * (1.0 + polynomial(&k[..3], r * r)) / (1.0 + polynomial(&k[3..], r * r)),
            Self::Fisheye { k, .. } => r.atan() * (1.0 + polynomial(k, r.atan().powi(2))),
            Self::RadTanFisheye { k, .. } => r.atan() * (1.0 + polynomial(k, r.atan().powi(2))),
            // The limit for ω → 0; the next term, r·ω²/12, is below 1e-13 here.
            Self::Fov { omega } if omega.abs() < 1e-6 => r,
            Self::Fov { omega } => (2.0 * r * (omega / 2.0).tan()).atan() / omega,
            Self::Division { k } => 2.0 * r / (1.0 + (1.0 - 4.0 * k * r * r).sqrt()),
            Self::Eucm { alpha, beta } => r / (alpha * (beta * r * r + 1.0).sqrt() + 1.0 - alpha),
        }
    }

    /// Distorted position of the undistorted point `p`. Not finite, or folded over, outside the lens's domain.
    #[must_use]
    pub fn distort(&self, p: DVec2) -> DVec2 {
        let r = p.length();
        if r < 1e-12 {
            return p;
        }
        let q = p * (self.radial(r) / r);
        match *self {
            Self::Brown { p: t, .. } => q + tangential(t, p),
            Self::Fisheye { p: t, s, .. } => {
                let theta = p * (r.atan() / r);
                q + tangential(t, theta) + DVec2::from(s) * theta.length_squared()
            }
            Self::RadTanFisheye { p: t, s, .. } => {
                let r2 = q.length_squared();
                let prism = DVec2::new(r2 * (s[0] + s[1] * r2), r2 * (s[2] + s[3] * r2));
                q + tangential([t[1], t[0]], q) + prism
            }
            _ => q,
        }
    }

    /// The point that [`Self::distort`] maps to `d`, by damped Newton steps. `None` if they do not get within 1e-12.
    #[must_use]
    pub fn undistort(&self, d: DVec2) -> Option<DVec2> {
        let residual = |p: DVec2| self.distort(p) - d;
        let mut p = match self {
            // Radius θ on the picture is tan θ on the plane; 1.5 rad keeps the start finite.
            Self::Fisheye { .. } | Self::RadTanFisheye { .. } if d.length() > 0.0 => {
                d.normalize() * d.length().min(1.5).tan()
            }
            _ => d,
        };
        let mut error = residual(p);
        for _ in 0..100 {
            if error.length() < 1e-15 * (1.0 + d.length()) {
                break;
            }
            // The Jacobian is approximate; convergence is judged by the residual.
            let h = 1e-7 * (1.0 + p.length());
            let column = |axis: DVec2| (self.distort(p + h * axis) - self.distort(p - h * axis)) / (2.0 * h);
            let mut step = DMat2::from_cols(column(DVec2::X), column(DVec2::Y)).inverse() * error;
            let better = (0..30).find_map(|_| {
                let (next, at) = (p - step, residual(p - step));
                step *= 0.5;
                (at.length() < error.length()).then_some((next, at))
            });
            match better {
                Some(found) => (p, error) = found,
                None => break,
            }
        }
        (error.length() < 1e-12 * (1.0 + d.length())).then_some(p)
    }

    /// Largest radius ≤ `limit` up to which the radial part increases: beyond it, polynomials fold the outside of the
    /// picture back into it. Exact to `limit`/1024.
    fn domain(&self, limit: f64) -> f64 {
        let mut last = 0.0;
        for i in 1..=1024 {
            let r = limit * f64::from(i) / 1024.0;
            let d = self.radial(r);
            // Written so that NaN ends it as well.
            if d > last {
                last = d;
            } else {
                return limit * f64::from(i - 1) / 1024.0;
            }
        }
        limit
    }
}

/// RGBA at continuous position (x, y) of a `width`×`height` picture: bilinear, colours weighted by alpha so that
/// what is transparent or masked does not bleed. Positions are clamped to the picture.
fn sample(rgba: &[u8], width: u32, height: u32, x: f64, y: f64) -> [u8; 4] {
    let axis = |t: f64, n: u32| {
        let t = (t - 0.5).clamp(0.0, f64::from(n - 1));
        let i = t as usize;
        (i, (i + 1).min(n as usize - 1), (t - i as f64) as f32)
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (axis(x, width), axis(y, height));
    let rows = [y0, y1].map(|y| &rgba[4 * y * width as usize..][..4 * width as usize]);
    let texel =
        |row: &[u8], x: usize| -> [f32; 4] { row[4 * x..].first_chunk::<4>().map_or([0.0; 4], |c| c.map(f32::from)) };
    let corners = [
        (texel(rows[0], x0), (1.0 - fx) * (1.0 - fy)),
        (texel(rows[0], x1), fx * (1.0 - fy)),
        (texel(rows[1], x0), (1.0 - fx) * fy),
        (texel(rows[1], x1), fx * fy),
    ];
    let (mut sum, mut alpha) = ([0.0f32; 3], 0.0);
    for ([r, g, b, a], weight) in corners {
        let a = weight * a;
        alpha += a;
        sum = [sum[0] + a * r, sum[1] + a * g, sum[2] + a * b];
    }
    if alpha <= 0.0 {
        return [0; 4];
    }
    // Adding one half rounds positive numbers, and needs no library call where the target has no rounding.
    let scale = 1.0 / alpha;
    let [r, g, b] = sum.map(|s| (s * scale + 0.5) as u8);
    [r, g, b, (alpha + 0.5) as u8]
}

/// Largest factor between the focal lengths of the pinhole image and of the photograph, see [`Lens::pinhole`].
const CLOSEST: f64 = 2.0;
/// Precision of that factor, and margin added to it: far less than a pixel, and more than rounding.
const CLOSE: f64 = 1e-9;

/// Column and row of every pixel along the border of a non-empty picture; corners first, which lenses displace most.
fn border(width: u32, height: u32) -> impl Iterator<Item = (u32, u32)> {
    let (right, bottom) = (width - 1, height - 1);
    let corners = [0, right].into_iter().flat_map(move |x| [(x, 0), (x, bottom)]);
    let rows = (0..width).flat_map(move |x| [(x, 0), (x, bottom)]);
    let columns = (0..height).flat_map(move |y| [(0, y), (right, y)]);
    corners.chain(rows).chain(columns)
}

impl Lens {
    /// The same lens for a picture resized to `width`×`height`.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        Self { intrinsics: self.intrinsics.resized(width, height), ..*self }
    }

    /// Pinhole camera of the undistorted image, at the photograph's size.
    ///
    /// It has the photograph's own intrinsics, so that the centre keeps its resolution and what falls outside that
    /// frame is cut off. If that would show places outside of the photograph, as with pincushion distortion, both focal
    /// lengths are multiplied by the least factor, to a billionth, with which no pixel's centre does: no pixel is
    /// blank, as by COLMAP's undistorter. With barrel distortion the factor is exactly 1, unless the lens folds its
    /// picture back within the frame.
    ///
    /// A lens for which even a factor of two is too little, which would leave less than a quarter of the view, keeps
    /// its own focal lengths: pixels outside the photograph are then blank, and do not count
    /// ([`Photo::masked`](super::Photo::masked)).
    #[must_use]
    pub fn pinhole(&self) -> Intrinsics {
        let k = self.intrinsics;
        // No picture has an invalid size; it is refused elsewhere.
        if self.distortion == Distortion::None || !Intrinsics::is_size(k.width, k.height) {
            return k;
        }
        let times = self.closer();
        Intrinsics { fx: times * k.fx, fy: times * k.fy, ..k }
    }

    /// Factor on the focal lengths, at least 1.
    fn closer(&self) -> f64 {
        let k = &self.intrinsics;
        let domain = self.domain();
        let is_shown = |(x, y): (u32, u32), times: f64| {
            let p = DVec2::new(f64::from(x) + 0.5 - k.cx, f64::from(y) + 0.5 - k.cy);
            self.shows(p / (times * DVec2::new(k.fx, k.fy)), domain).is_some()
        };
        // The interior of the picture is covered if its border is, as lenses do not fold within their domain.
        let mut times = 1.0;
        for pixel in border(k.width, k.height) {
            if is_shown(pixel, times) {
                continue;
            }
            if !is_shown(pixel, CLOSEST) {
                return 1.0;
            }
            let (mut less, mut more) = (times, CLOSEST);
            while more - less > CLOSE {
                let middle = 0.5 * (less + more);
                if is_shown(pixel, middle) {
                    more = middle;
                } else {
                    less = middle;
                }
            }
            times = more + CLOSE;
        }
        // A larger factor shows less on all sides, unless the principal point is outside.
        let is_covered = times == 1.0 || border(k.width, k.height).all(|pixel| is_shown(pixel, times));
        if is_covered { times } else { 1.0 }
    }

    /// Squared radius, on the plane z = 1, of the lens's domain within the photograph's frame.
    fn domain(&self) -> f64 {
        let k = &self.intrinsics;
        let [w, h] = k.size().to_array();
        let far = DVec2::new(k.cx.abs().max((w - k.cx).abs()) / k.fx, k.cy.abs().max((h - k.cy).abs()) / k.fy);
        self.distortion.domain(far.length()).powi(2)
    }

    /// Position in the photograph, continuous pixels, of the undistorted point `p`, if it is inside; `domain` is
    /// [`Self::domain`].
    fn shows(&self, p: DVec2, domain: f64) -> Option<DVec2> {
        let k = &self.intrinsics;
        let d = self.distortion.distort(p);
        let uv = DVec2::new(d.x * k.fx + k.cx, d.y * k.fy + k.cy);
        let is_inside = uv.cmpge(DVec2::ZERO).all() && uv.cmple(k.size()).all();
        (p.length_squared() <= domain && is_inside).then_some(uv)
    }

    /// Position in the image of `pinhole`, which is [`Self::pinhole`] possibly at another size, of the photograph's
    /// position `uv`, both in continuous pixels.
    #[must_use]
    pub fn undistort(&self, uv: DVec2, pinhole: &Intrinsics) -> Option<DVec2> {
        let k = &self.intrinsics;
        let p = self.distortion.undistort((uv - DVec2::new(k.cx, k.cy)) / DVec2::new(k.fx, k.fy))?;
        Some(p * DVec2::new(pinhole.fx, pinhole.fy) + DVec2::new(pinhole.cx, pinhole.cy))
    }

    /// Undistorts a photograph `rgba` `[height·width·4]` to the image of [`Self::pinhole`].
    ///
    /// Second result: whether some pixels lie outside the photograph. These are 0, alpha included.
    pub(super) fn rectify(&self, rgba: &[u8]) -> (Vec<u8>, bool) {
        let k = self.pinhole();
        let domain = self.domain();
        let (sx, sy) = (1.0 / k.fx, 1.0 / k.fy);
        let mut out = vec![0; rgba.len()];
        let mut outside = false;
        for (y, row) in out.chunks_exact_mut(4 * k.width as usize).enumerate() {
            for (x, pixel) in row.chunks_exact_mut(4).enumerate() {
                let p = DVec2::new((x as f64 + 0.5 - k.cx) * sx, (y as f64 + 0.5 - k.cy) * sy);
                match self.shows(p, domain) {
                    Some(at) => pixel.copy_from_slice(&sample(rgba, k.width, k.height, at.x, at.y)),
                    None => outside = true,
                }
            }
        }
        (out, outside)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENSES: [Distortion; 10] = [
        Distortion::None,
        Distortion::Brown { k: [-0.16, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] },
        Distortion::Brown { k: [0.05, -0.02, 0.01, 0.02, 0.01, 0.005], p: [0.002, -0.001] },
        Distortion::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] },
        Distortion::Fisheye { k: [0.05, -0.02, 0.01, -0.003], p: [0.002, -0.001], s: [0.001, -0.002] },
        Distortion::RadTanFisheye {
            k: [0.05, -0.02, 0.01, 0.003, 0.001, 0.0005],
            p: [0.002, -0.001],
            s: [0.003, 0.001, -0.002, 0.0004],
        },
        Distortion::Fov { omega: 0.9 },
        Distortion::Fov { omega: 1e-7 },
        Distortion::Division { k: -0.1 },
        Distortion::Eucm { alpha: 0.6, beta: 1.1 },
    ];

    #[test]
    fn undistort_inverts_distort() {
        for lens in LENSES {
            for i in -10..=10 {
                for j in -10..=10 {
                    let p = DVec2::new(f64::from(i), f64::from(j)) * 0.08;
                    let back = lens.undistort(lens.distort(p)).unwrap_or_else(|| panic!("{lens:?} at {p}"));
                    // The tolerance of 1e-12 applies to the distorted point; the magnification is below 10 here.
                    assert!(back.distance(p) < 1e-9, "{lens:?}: {p} came back as {back}");
                }
            }
        }
    }

    #[test]
    fn domain_ends_where_the_polynomial_turns() {
        // r(1 − k r²) stops growing at 1/√(3k).
        let lens = Distortion::Brown { k: [-0.2, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        let turn = 1.0 / (0.6f64).sqrt();
        assert!((lens.domain(3.0) - turn).abs() < 2.0 * 3.0 / 1024.0);
        assert!((lens.domain(1.0) - 1.0).abs() < 1e-12);
        // The closed form of the division model is defined up to 1/(2√k).
        assert!((Distortion::Division { k: 0.25 }.domain(4.0) - 1.0).abs() < 2.0 * 4.0 / 1024.0);
        assert!(Distortion::Brown { k: [f64::NAN; 6], p: [0.0; 2] }.domain(1.0).abs() < 1e-12);
    }

    #[test]
    fn rectify_straightens_a_picture() {
        let intrinsics = Intrinsics { width: 80, height: 60, fx: 60.0, fy: 62.0, cx: 41.0, cy: 29.0 };
        let lens = Lens { intrinsics, distortion: LENSES[1] };
        // A photograph in which red and green encode the *undistorted* position of each pixel.
        let mut photo = vec![255; 80 * 60 * 4];
        let pinhole = lens.pinhole();
        assert_eq!(pinhole, intrinsics);
        for (i, pixel) in photo.chunks_exact_mut(4).enumerate() {
            let uv = DVec2::new((i % 80) as f64 + 0.5, (i / 80) as f64 + 0.5);
            let p = lens.undistort(uv, &pinhole).unwrap();
            pixel[0] = (2.0 * p.x + 30.0).round() as u8;
            pixel[1] = (2.0 * p.y + 30.0).round() as u8;
        }
        let (pinhole, outside) = lens.rectify(&photo);
        assert!(!outside, "barrel distortion shows more than the frame");
        for (i, pixel) in pinhole.chunks_exact(4).enumerate() {
            let expected = [2.0 * ((i % 80) as f64 + 0.5) + 30.0, 2.0 * ((i / 80) as f64 + 0.5) + 30.0];
            for c in 0..2 {
                // Half a level of rounding in the photograph and half in the result: 1 level = half a pixel.
                assert!((f64::from(pixel[c]) - expected[c]).abs() <= 1.01, "pixel {i}: {pixel:?} for {expected:?}");
            }
        }
    }

    /// Lens of an 80×60 photograph with this k₁ and the principal point in column `cx`.
    fn radial(k1: f64, cx: f64) -> Lens {
        let intrinsics = Intrinsics { width: 80, height: 60, fx: 60.0, fy: 62.0, cx, cy: 29.0 };
        Lens { intrinsics, distortion: Distortion::Brown { k: [k1, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] } }
    }

    /// The border of the pinhole image lies in the photograph, but would not with a slightly smaller focal length, and
    /// its pixels show what their rays meet.
    #[test]
    fn pincushion_pictures_are_cut_to_what_their_photographs_show() {
        for k1 in [0.04, 0.3] {
            let lens = radial(k1, 41.0);
            let (own, pinhole) = (lens.intrinsics, lens.pinhole());
            let times = pinhole.fx / own.fx;
            assert!(times > 1.01 && times < 1.3, "{k1}: {times}");
            assert_eq!(Intrinsics { fx: own.fx, fy: own.fy, ..pinhole }, own);
            assert!((pinhole.fy / own.fy - times).abs() < 1e-12);
            let (f, c) = (DVec2::new(own.fx, own.fy), DVec2::new(own.cx, own.cy));
            let is_shown = |times: f64| {
                let ray = |x: u32, y: u32| (DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5) - c) / (times * f);
                border(80, 60).all(|(x, y)| lens.shows(ray(x, y), lens.domain()).is_some())
            };
            assert!(is_shown(times) && !is_shown(times - 1e-6));
            // Red and green encode where the ray of each photograph pixel meets the plane z = 1, at 150 levels per
            // unit.
            let mut photo = vec![255; 80 * 60 * 4];
            for (i, pixel) in photo.chunks_exact_mut(4).enumerate() {
                let uv = DVec2::new((i % 80) as f64 + 0.5, (i / 80) as f64 + 0.5);
                let p = lens.distortion.undistort((uv - c) / f).unwrap();
                pixel[0] = (150.0 * p.x + 128.0).round() as u8;
                pixel[1] = (150.0 * p.y + 128.0).round() as u8;
            }
            let (picture, outside) = lens.rectify(&photo);
            assert!(!outside && picture.chunks_exact(4).all(|pixel| pixel[3] == 255));
            for (i, pixel) in picture.chunks_exact(4).enumerate() {
                let ray = [
                    ((i % 80) as f64 + 0.5 - pinhole.cx) / pinhole.fx,
                    ((i / 80) as f64 + 0.5 - pinhole.cy) / pinhole.fy,
                ];
                for (level, p) in pixel.iter().zip(ray) {
                    // One level of rounding; beyond the centres of the outermost pixels half a pixel, at 2.5 levels per
                    // pixel.
                    let off = (f64::from(*level) - (150.0 * p + 128.0)).abs();
                    assert!(off <= 2.3, "{k1}, pixel {i}: {pixel:?} for {ray:?}");
                }
            }
        }
    }

    #[test]
    fn other_lenses_keep_their_focal_length() {
        // Photographs by these lenses show more than the frame on all sides.
        for distortion in [0, 1, 3, 6, 7, 8, 9].map(|i| LENSES[i]) {
            let lens = Lens { distortion, ..radial(0.0, 41.0) };
            assert_eq!(lens.pinhole(), lens.intrinsics, "{distortion:?}");
        }
        // Distortion by half a pixel changes nothing: pixel centres remain inside.
        assert_eq!(radial(0.01, 41.0).pinhole(), radial(0.01, 41.0).intrinsics);
        // Lenses for which twice the focal length is not enough, or for which no focal length helps because the
        // distortion is not monotonic.
        for lens in [radial(8.0, 41.0), radial(0.04, -20.0), radial(f64::NAN, 41.0)] {
            assert_eq!(lens.pinhole(), lens.intrinsics, "{lens:?}");
            let (picture, outside) = lens.rectify(&[255; 80 * 60 * 4]);
            assert!(outside && picture.chunks_exact(4).any(|pixel| pixel == [0; 4]), "{lens:?}");
        }
        let empty = Intrinsics { width: 0, ..radial(0.3, 41.0).intrinsics };
        assert_eq!(Lens { intrinsics: empty, ..radial(0.3, 41.0) }.pinhole(), empty);
    }
}
