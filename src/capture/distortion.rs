//! Lens distortion: the camera models of COLMAP, forward in closed form and backward by Newton's
//! method, and the resampling of a photograph to a pinhole image.
//!
//! All functions work on the plane z = 1: `p = (x/z, y/z)` of a camera-space point.

use glam::{DMat2, DVec2};

use crate::scene::Intrinsics;

/// A real lens: a pixel is `(fx, fy)·distortion(p) + (cx, cy)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    /// Focal lengths, principal point and size, in pixels of the photograph.
    pub intrinsics: Intrinsics,
    /// What happens on the plane z = 1 before.
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

    /// Where the lens puts the undistorted point `p`. Not finite, or folded over, outside the lens's domain.
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
            // The Jacobian only steers; the residual decides.
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

    /// The largest radius ≤ `limit` up to which the radial part grows: beyond it, polynomials fold the outside of
    /// the picture back into it. Exact to `limit`/1024.
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

impl Lens {
    /// The same lens for a picture resized to `width`×`height`.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        Self { intrinsics: self.intrinsics.resized(width, height), ..*self }
    }

    /// Position in the pinhole image of what the photograph shows at `uv`, both in continuous pixels. The pinhole
    /// image has the photograph's own intrinsics.
    #[must_use]
    pub fn undistort(&self, uv: DVec2) -> Option<DVec2> {
        let k = &self.intrinsics;
        let (f, c) = (DVec2::new(k.fx, k.fy), DVec2::new(k.cx, k.cy));
        self.distortion.undistort((uv - c) / f).map(|p| p * f + c)
    }

    /// The pinhole image of a photograph `rgba` `[height·width·4]`, at the same size, focal length and principal
    /// point, so that the centre keeps its resolution; what falls outside that frame is cut off.
    ///
    /// Second result: whether some pixels have no photograph behind them. Those are 0, alpha included.
    pub(super) fn rectify(&self, rgba: &[u8]) -> (Vec<u8>, bool) {
        let k = &self.intrinsics;
        let [w, h] = k.size().to_array();
        let far = DVec2::new(k.cx.abs().max((w - k.cx).abs()) / k.fx, k.cy.abs().max((h - k.cy).abs()) / k.fy);
        let domain = self.distortion.domain(far.length()).powi(2);
        let (sx, sy) = (1.0 / k.fx, 1.0 / k.fy);
        let mut out = vec![0; rgba.len()];
        let mut outside = false;
        for (y, row) in out.chunks_exact_mut(4 * k.width as usize).enumerate() {
            for (x, pixel) in row.chunks_exact_mut(4).enumerate() {
                let p = DVec2::new((x as f64 + 0.5 - k.cx) * sx, (y as f64 + 0.5 - k.cy) * sy);
                let d = self.distortion.distort(p);
                let (u, v) = (d.x * k.fx + k.cx, d.y * k.fy + k.cy);
                if p.length_squared() <= domain && (0.0..=w).contains(&u) && (0.0..=h).contains(&v) {
                    pixel.copy_from_slice(&sample(rgba, k.width, k.height, u, v));
                } else {
                    outside = true;
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
                    // 1e-12 is asked of the distorted point; magnification is below 10 here.
                    assert!(back.distance(p) < 1e-9, "{lens:?}: {p} came back as {back}");
                }
            }
        }
    }

    #[test]
    fn domain_ends_where_the_polynomial_turns() {
        // r(1 − k r²) turns at 1/√(3k).
        let lens = Distortion::Brown { k: [-0.2, 0.0, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        let turn = 1.0 / (0.6f64).sqrt();
        assert!((lens.domain(3.0) - turn).abs() < 2.0 * 3.0 / 1024.0);
        assert!((lens.domain(1.0) - 1.0).abs() < 1e-12);
        // The closed form of the division model ends at 1/(2√k).
        assert!((Distortion::Division { k: 0.25 }.domain(4.0) - 1.0).abs() < 2.0 * 4.0 / 1024.0);
        assert!(Distortion::Brown { k: [f64::NAN; 6], p: [0.0; 2] }.domain(1.0).abs() < 1e-12);
    }

    #[test]
    fn rectify_straightens_a_picture() {
        let intrinsics = Intrinsics { width: 80, height: 60, fx: 60.0, fy: 62.0, cx: 41.0, cy: 29.0 };
        let lens = Lens { intrinsics, distortion: LENSES[1] };
        // A photograph whose red and green are the *undistorted* position of each of its pixels.
        let mut photo = vec![255; 80 * 60 * 4];
        for (i, pixel) in photo.chunks_exact_mut(4).enumerate() {
            let uv = DVec2::new((i % 80) as f64 + 0.5, (i / 80) as f64 + 0.5);
            let p = lens.undistort(uv).unwrap();
            pixel[0] = (2.0 * p.x + 30.0).round() as u8;
            pixel[1] = (2.0 * p.y + 30.0).round() as u8;
        }
        let (pinhole, outside) = lens.rectify(&photo);
        assert!(!outside, "barrel distortion shows more than the frame");
        for (i, pixel) in pinhole.chunks_exact(4).enumerate() {
            let expected = [2.0 * ((i % 80) as f64 + 0.5) + 30.0, 2.0 * ((i / 80) as f64 + 0.5) + 30.0];
            for c in 0..2 {
                // Half a level of rounding in the photograph, half in the result: 1 level = half a pixel.
                assert!((f64::from(pixel[c]) - expected[c]).abs() <= 1.01, "pixel {i}: {pixel:?} for {expected:?}");
            }
        }
        let pincushion =
            Lens { intrinsics, distortion: Distortion::Brown { k: [0.3, 0., 0., 0., 0., 0.], p: [0.; 2] } };
        let (pinhole, outside) = pincushion.rectify(&photo);
        assert!(outside && pinhole[..4] == [0; 4], "corners have no photograph");
    }
}
