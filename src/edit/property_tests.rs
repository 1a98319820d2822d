//! Properties of all similarities and of all selections of splats.

use glam::{DMat3, DQuat, DVec3, Quat, Vec3};
use proptest::prelude::*;

use super::*;
use crate::render::testing::random_scene;
use crate::scene::{OrderMode, Splats, gather, in_morton_order, sh};

fn splats(seed: u64, count: usize) -> Splats {
    random_scene(seed, count, 0, 3, 1, OrderMode::Stable).0.splats
}

/// Parameters of a similarity.
#[derive(Clone, Copy, Debug)]
struct Parts {
    scale: f64,
    orthogonal: DMat3,
    translation: DVec3,
}

impl Parts {
    fn similarity(&self) -> Similarity {
        Similarity::new(self.scale, self.orthogonal, self.translation).unwrap()
    }

    /// The inverse similarity.
    fn inverse(&self) -> Similarity {
        let (scale, orthogonal) = (self.scale.recip(), self.orthogonal.transpose());
        Similarity::new(scale, orthogonal, -scale * (orthogonal * self.translation)).unwrap()
    }
}

/// Any rotation, with or without reflection, and scales and translations in a range where f32 is precise enough.
fn parts() -> impl Strategy<Value = Parts> {
    let turn = prop::array::uniform4(-1.0..1.0_f64).prop_map(DQuat::from_array);
    let turn = turn.prop_filter("a rotation", |q| q.length() > 0.1).prop_map(|q| DMat3::from_quat(q.normalize()));
    let shift = prop::array::uniform3(-2.0..2.0_f64).prop_map(DVec3::from_array);
    (0.3..3.0_f64, turn, any::<bool>(), shift).prop_map(|(scale, turn, mirrors, translation)| {
        let mirror = DMat3::from_diagonal(DVec3::new(1.0, if mirrors { -1.0 } else { 1.0 }, 1.0));
        Parts { scale, orthogonal: turn * mirror, translation }
    })
}

fn covariance(splats: &Splats, i: usize) -> DMat3 {
    let axes = DMat3::from_quat(splats.rotations()[i].as_dquat().normalize());
    axes * DMat3::from_diagonal((2.0 * splats.log_scales()[i].as_dvec3()).exp()) * axes.transpose()
}

/// Colour of a splat in a direction.
fn color(splats: &Splats, i: usize, direction: DVec3) -> DVec3 {
    let terms = sh::basis(direction.to_array()).into_iter().zip(splats.sh_of(i));
    terms.map(|(basis, rgb)| basis * DVec3::from(rgb.map(f64::from))).sum()
}

/// Asserts that `after` is `before` transformed by p ↦ scale · orthogonal · p + translation, up to rounding to f32 once
/// or twice.
fn assert_moved(before: &Splats, after: &Splats, moved: &Parts) {
    let Parts { scale, orthogonal, translation } = *moved;
    assert_eq!((after.len(), after.opacity_logits()), (before.len(), before.opacity_logits()));
    for i in 0..before.len() {
        let mean = scale * (orthogonal * before.means()[i].as_dvec3()) + translation;
        let found = after.means()[i].as_dvec3();
        assert!(found.distance(mean) < 1e-5 * (1.0 + mean.length()), "{i}: {found}, not {mean}");
        let spread = scale * scale * (orthogonal * covariance(before, i) * orthogonal.transpose());
        let unit = spread.to_cols_array().iter().fold(0.0, |most: f64, v| most.max(v.abs())).recip();
        let found = covariance(after, i);
        assert!((unit * found).abs_diff_eq(unit * spread, 1e-5), "{i}: {found}, not {spread}");
        for direction in [DVec3::X, DVec3::new(0.36, -0.48, 0.8), DVec3::new(-0.6, 0.64, -0.48)] {
            let (was, is) = (color(before, i, direction), color(after, i, orthogonal * direction));
            assert!(was.abs_diff_eq(is, 1e-5), "{i} along {direction}: {is}, not {was}");
        }
    }
}

/// Asserts that `taken` are the splats of `from` at `indices`, with all of their parameters.
fn assert_taken(taken: &Splats, from: &Splats, indices: &[usize]) {
    let of = |splats: &Splats, i: usize| -> (Vec3, Quat, Vec3, f32, Vec<[f32; 3]>) {
        let (mean, rotation, log_scale) = (splats.means()[i], splats.rotations()[i], splats.log_scales()[i]);
        (mean, rotation, log_scale, splats.opacity_logits()[i], splats.sh_of(i).to_vec())
    };
    assert_eq!((taken.len(), taken.sh_degree()), (indices.len(), from.sh_degree()));
    for (to, &index) in indices.iter().enumerate() {
        assert_eq!(of(taken, to), of(from, index), "{to} of {indices:?}");
    }
}

proptest! {
    #[test]
    fn splats_go_where_similarities_say_one_after_the_other_and_back(a in parts(), b in parts(), seed in 0..1000_u64) {
        let before = splats(seed, 4);
        let once = a.similarity().splats(before.clone()).unwrap();
        assert_moved(&before, &once, &a);
        let both = Parts {
            scale: b.scale * a.scale,
            orthogonal: b.orthogonal * a.orthogonal,
            translation: b.scale * (b.orthogonal * a.translation) + b.translation,
        };
        assert_moved(&before, &b.similarity().splats(once.clone()).unwrap(), &both);
        assert_moved(&before, &a.similarity().then(&b.similarity()).splats(before.clone()).unwrap(), &both);
        let still = Parts { scale: 1.0, orthogonal: DMat3::IDENTITY, translation: DVec3::ZERO };
        assert_moved(&before, &a.inverse().splats(once).unwrap(), &still);
        assert_moved(&before, &a.similarity().then(&a.inverse()).splats(before.clone()).unwrap(), &still);
    }

    #[test]
    fn choices_and_orders_keep_what_belongs_together(
        seed in 0..1000_u64, count in 1..40_usize, picks in prop::collection::vec(any::<prop::sample::Index>(), 0..60),
    ) {
        let splats = splats(seed, count);
        let chosen: Vec<usize> = picks.iter().map(|pick| pick.index(count)).collect();
        assert_taken(&gather(splats.clone(), &chosen), &splats, &chosen);
        let order = in_morton_order(&splats);
        let sorted = gather(splats.clone(), &order);
        assert_taken(&sorted, &splats, &order);
        prop_assert_eq!(in_morton_order(&sorted), (0..count).collect::<Vec<_>>());
    }
}
