use rayon::prelude::*;

use glam::DVec2;

use super::{Image, Parameters, View, pixel_center, power};
use crate::geometry::MeshBvh;
use crate::render::contract::{self, SurfaceDepth};
use crate::scene::{Camera, HybridScene};

/// Difference of the order of splats and layers by rays to the means from the rule's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MeanRays {
    /// Splats in front of the camera.
    pub splats: usize,
    /// Splats with a mean outside the picture, which are behind all layers by the rule.
    pub outside: usize,
    /// Splats whose place in the order differs for at least one pixel.
    pub different: usize,
    /// Splats among these with a mean outside the picture.
    pub different_outside: usize,
}

/// As [`super::render`], but the layers in front of a mean are found by a ray from the camera to it: exact where a
/// layer's depth image only has the centres of pixels, and defined outside the picture, too. For comparison only; the
/// composition rule uses depth images.
#[must_use]
pub fn render_by_mean_rays(scene: &HybridScene, camera: &Camera) -> (Image, MeanRays) {
    let parameters = Parameters::of(scene);
    let mut view = View::new(scene, camera, &parameters);
    let bvh = MeshBvh::of(&scene.meshes);
    let (composition, center) = (&scene.composition, camera.center());
    let (lambda, near) = (f64::from(composition.lambda), f64::from(composition.near));
    let layers = &view.layers;
    let decide = |(splat, thresholds): &mut (super::Projected, [f64; contract::MAX_LAYERS])| {
        // The ray's parameter is 1 at the mean, so it scales the mean's depth.
        let hits = bvh.all_hits(center, parameters.means[splat.index] - center);
        let mut depths = hits.iter().map(|hit| hit.t * splat.depth).filter(|depth| *depth > near);
        let by_ray: Vec<SurfaceDepth> =
            (0..composition.layers).map(|_| depths.next().map_or(SurfaceDepth::Empty, SurfaceDepth::Depth)).collect();
        let taps = std::mem::replace(thresholds, contract::thresholds(composition.mode, splat.depth, &by_ray, lambda));
        let size = DVec2::new(f64::from(camera.intrinsics().width), f64::from(camera.intrinsics().height));
        let is_outside = splat.center.cmplt(DVec2::ZERO).any() || splat.center.cmpge(size).any();
        let is_elsewhere = |p: usize| {
            let depths: Vec<f64> = layers[p].iter().map(|layer| layer.depth).collect();
            let covers =
                contract::splat_alpha(splat.opacity, power(splat, pixel_center(camera, p) - splat.center)).is_some();
            covers && contract::bucket(&depths, &taps) != contract::bucket(&depths, thresholds)
        };
        let low = (splat.center - splat.extent - 1.0).clamp(DVec2::ZERO, size);
        let high = (splat.center + splat.extent + 1.0).clamp(DVec2::ZERO, size);
        let mut pixels = (low.y as usize..high.y as usize)
            .flat_map(|y| (low.x as usize..high.x as usize).map(move |x| y * size.x as usize + x));
        let is_different = pixels.any(is_elsewhere);
        MeanRays {
            splats: 1,
            outside: usize::from(is_outside),
            different: usize::from(is_different),
            different_outside: usize::from(is_outside && is_different),
        }
    };
    let mut splats = std::mem::take(&mut view.splats);
    let counts = splats.par_iter_mut().map(decide).reduce(MeanRays::default, |a, b| MeanRays {
        splats: a.splats + b.splats,
        outside: a.outside + b.outside,
        different: a.different + b.different,
        different_outside: a.different_outside + b.different_outside,
    });
    view.splats = splats;
    (view.composite(composition.background), counts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::{reference, testing};
    use crate::scene::OrderMode;

    #[test]
    fn rays_and_taps_agree_but_at_edges_and_outside() {
        let (mut differences, mut total) = (0.0_f64, MeanRays::default());
        for seed in 0..6 {
            let (scene, camera) = testing::random_scene(seed, 400, 2, 2, 1, OrderMode::Stable);
            let (image, counts) = render_by_mean_rays(&scene, &camera);
            let taps = reference::render(&scene, &camera);
            let pairs = image.rgb.as_flattened().iter().zip(taps.rgb.as_flattened());
            differences += pairs.map(|(a, b)| (a - b).abs()).sum::<f64>() / (3 * image.rgb.len()) as f64;
            total.splats += counts.splats;
            total.outside += counts.outside;
            total.different += counts.different;
            total.different_outside += counts.different_outside;
        }
        eprintln!("{total:?}, mean difference of pixels {:.1e}", differences / 6.0);
        let inside = total.different - total.different_outside;
        assert!(total.splats > 1000 && total.outside > 0 && total.different_outside > 0, "{total:?}");
        assert!(inside > 0 && inside * 10 < total.splats, "{total:?}");
        assert!(differences > 0.0);
    }

    #[test]
    fn without_a_mesh_there_is_nothing_to_ask() {
        let (mut scene, camera) = testing::random_scene(1, 100, 0, 2, 1, OrderMode::Stable);
        scene.meshes.clear();
        let (image, counts) = render_by_mean_rays(&scene, &camera);
        assert_eq!((image, counts.different), (reference::render(&scene, &camera), 0));
        assert!(counts.splats > 0);
    }
}
