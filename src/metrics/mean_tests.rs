//! Means of scores whose values are all different.

use super::*;
use crate::scene::{Composition, HybridScene, Splats};

/// Scores that depend linearly on an offset, so that the mean of scores has the mean offset.
fn scores(offset: f64) -> Scores {
    let lpips = LpipsScore { net: LpipsNet::Alex, normalized: 0.5 + offset, unnormalized: 0.25 + 2.0 * offset };
    Scores {
        psnr: 20.0 + offset,
        psnr_float: 24.0 + 3.0 * offset,
        ssim_inria: 0.875 - offset,
        ssim_valid: Some(0.75 - 2.0 * offset),
        ssim_reflect: Some(0.625 - 3.0 * offset),
        flip: 0.125 + 4.0 * offset,
        lpips: Some(lpips),
    }
}

fn mean(all: &[Scores]) -> Option<Scores> {
    let scene = HybridScene { splats: Splats::empty(0), meshes: vec![], composition: Composition::default() };
    let view = |scores: &Scores| ViewScore { name: String::new(), size: [1, 1], scores: *scores, masked: false };
    Evaluation::new(&scene, all.iter().map(view).collect(), Measured::default()).mean
}

#[test]
fn every_number_has_its_own_mean() {
    // All of these values are exact in binary.
    assert_eq!(mean(&[scores(0.0), scores(0.0625)]), Some(scores(0.03125)));
    assert_eq!(mean(&[scores(0.125), scores(-0.0625), scores(-0.0625)]), Some(scores(0.0)));
    assert_eq!(mean(&[scores(0.0625)]), Some(scores(0.0625)));
    assert_eq!(mean(&[]), None);
}

#[test]
fn of_what_one_lacks_there_is_no_mean() {
    let whole = scores(0.0);
    let lacking =
        [Scores { ssim_valid: None, ..whole }, Scores { ssim_reflect: None, ..whole }, Scores { lpips: None, ..whole }];
    for lacking in lacking {
        // In any order.
        for all in [[whole, lacking], [lacking, whole], [lacking; 2]] {
            assert_eq!(mean(&all), Some(lacking));
        }
    }
}
