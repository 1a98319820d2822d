use glam::DVec3;
use rayon::prelude::*;

use crate::scene::{Mesh, Splats, sigmoid};

/// A region of space, its boundary included.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Volume {
    /// Axis-aligned box between two corners; sides may be infinite.
    Box {
        /// Lower corner.
        low: DVec3,
        /// Upper corner.
        high: DVec3,
    },
    /// Ball.
    Sphere {
        /// Centre of the ball.
        center: DVec3,
        /// Radius of the ball, ≥ 0.
        radius: f64,
    },
}

impl Volume {
    /// Whether `p` lies in the volume.
    #[must_use]
    pub fn contains(&self, p: DVec3) -> bool {
        match self {
            Self::Box { low, high } => p.cmpge(*low).all() && p.cmple(*high).all(),
            Self::Sphere { center, radius } => p.distance_squared(*center) <= radius * radius,
        }
    }
}

/// Region of space to be kept.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Crop {
    /// Keeps the inside of the volume.
    Inside(Volume),
    /// Keeps the outside of the volume.
    Outside(Volume),
}

impl Crop {
    fn keeps(&self, p: DVec3) -> bool {
        match self {
            Self::Inside(volume) => volume.contains(p),
            Self::Outside(volume) => !volume.contains(p),
        }
    }
}

/// Indices of the splats whose means every crop in `crops` keeps.
#[must_use]
pub fn in_crops(splats: &Splats, crops: &[Crop]) -> Vec<usize> {
    indices(splats, |i| crops.iter().all(|c| c.keeps(splats.means()[i].as_dvec3())))
}

/// Reduces a mesh to the triangles whose centroids every crop in `crops` keeps, and their vertices; `None` if no
/// triangle is left.
#[must_use]
pub fn crop_mesh(mesh: &Mesh, crops: &[Crop]) -> Option<Mesh> {
    let keeps = |t: &[u32; 3]| {
        let centroid = t.iter().map(|&v| mesh.positions()[v as usize].as_dvec3()).sum::<DVec3>() / 3.0;
        crops.iter().all(|c| c.keeps(centroid))
    };
    mesh.with_triangles(&mesh.triangles().iter().map(keeps).collect::<Vec<_>>())
}

/// Indices of the splats whose opacity is at least `opacity`, 0 to 1.
#[must_use]
pub fn not_below_opacity(splats: &Splats, opacity: f64) -> Vec<usize> {
    indices(splats, |i| sigmoid(f64::from(splats.opacity_logits()[i])) >= opacity)
}

/// Indices, ascending, of the `count` splats that contribute most to images: opacity times the area of the ellipsoid's
/// largest cross-section. Ties go to the lower index.
#[must_use]
pub fn most_important(splats: &Splats, count: usize) -> Vec<usize> {
    let mut ranked: Vec<(f64, usize)> = (0..splats.len()).into_par_iter().map(|i| (importance(splats, i), i)).collect();
    if count < ranked.len() {
        ranked.select_nth_unstable_by(count, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        ranked.truncate(count);
    }
    let mut indices: Vec<usize> = ranked.into_iter().map(|(_, i)| i).collect();
    indices.par_sort_unstable();
    indices
}

/// Logarithm of opacity times the product of the two larger standard deviations, computed without overflow.
fn importance(splats: &Splats, i: usize) -> f64 {
    let s = splats.log_scales()[i].as_dvec3();
    // ln σ(x) = −ln(1 + e^−x), which is x itself where e^−x overflows.
    let x = f64::from(splats.opacity_logits()[i]);
    let log_opacity = if x < -700.0 { x } else { -(-x).exp().ln_1p() };
    log_opacity + s.element_sum() - s.min_element()
}

fn indices(splats: &Splats, keeps: impl Fn(usize) -> bool + Sync) -> Vec<usize> {
    (0..splats.len()).into_par_iter().filter(|&i| keeps(i)).collect()
}
