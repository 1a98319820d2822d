//! Property tests of the region of a photograph that pinhole images show, for any lens.

use glam::DVec2;
use proptest::prelude::*;

use super::{Distortion, Lens};
use crate::scene::Intrinsics;

proptest! {
    /// Every pixel shows part of the photograph; with a slightly smaller focal length one would not, unless the focal
    /// length is that of the photograph.
    #[test]
    fn pinholes_are_cut_to_their_photographs_and_no_further(
        k1 in -0.15..0.3_f64, k2 in -0.05..0.1_f64, p in prop::array::uniform2(-2e-3..2e-3_f64),
        fx in 18.0..30.0_f64, fy in 18.0..30.0_f64, cx in 10.0..14.0_f64, cy in 7.0..11.0_f64,
    ) {
        let own = Intrinsics { width: 24, height: 18, fx, fy, cx, cy };
        let lens = Lens { intrinsics: own, distortion: Distortion::Brown { k: [k1, k2, 0.0, 0.0, 0.0, 0.0], p } };
        let pinhole = lens.pinhole();
        let times = pinhole.fx / own.fx;
        prop_assert!((1.0..=2.0).contains(&times) && (pinhole.fy / own.fy - times).abs() < 1e-12);
        prop_assert_eq!(Intrinsics { fx, fy, ..pinhole }, own);
        let (focal, center) = (DVec2::new(fx, fy), DVec2::new(cx, cy));
        let shows_all = |times: f64| {
            let pixel = |y: u32| (0..own.width).map(move |x| DVec2::new(x.into(), y.into()) + 0.5);
            (0..own.height).flat_map(pixel).all(|pixel| {
                let place = lens.distortion.distort((pixel - center) / (times * focal)) * focal + center;
                place.cmpge(DVec2::ZERO).all() && place.cmple(own.size()).all()
            })
        };
        prop_assert!(shows_all(times));
        prop_assert!(times == 1.0 || !shows_all(times - 1e-6));
        let (picture, outside) = lens.rectify(&vec![255; 4 * own.pixels()]);
        prop_assert!(!outside && picture.iter().all(|level| *level == 255));
    }
}
