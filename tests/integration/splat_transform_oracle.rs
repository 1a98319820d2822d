//! Our files as read by `PlayCanvas`' splat-transform, and the other way round. `CENTAUR_SPLAT_TRANSFORM` names the
//! program (npm: @playcanvas/splat-transform).

use std::path::{Path, PathBuf};
use std::process::Command;

use centaur::format::{Loss, SplatError, ksplat, ply, read_scene, splat, spz};
use centaur::scene::{PixelFilter, Splats, sh};
use glam::{DMat3, DVec3, Quat, Vec3};
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;

const COUNT: usize = 3000;
const DEGREE: u32 = 2;

/// Splats that every format can hold: coefficients within ±0.9, scales from e^−9 to e.
fn splats() -> Splats {
    let mut rng = Pcg64Mcg::seed_from_u64(7);
    let mut r = |low: f32, high: f32| rng.random_range(low..high);
    let mut vec3 = |low, high| Vec3::new(r(low, high), r(low, high), r(low, high));
    let means = (0..COUNT).map(|_| vec3(-3.0, 3.0)).collect();
    let log_scales = (0..COUNT).map(|_| vec3(-9.0, 1.0)).collect();
    let sh = (0..COUNT * sh::coefficients(DEGREE)).map(|_| vec3(-0.9, 0.9).to_array()).collect();
    let rotations = (0..COUNT).map(|_| Quat::from_vec4(vec3(-1.0, 1.0).extend(0.5))).collect();
    let logits = (0..COUNT).map(|_| vec3(-6.0, 6.0).x).collect();
    Splats::new(means, rotations, log_scales, logits, DEGREE, sh).unwrap()
}

fn convert(from: &Path, to: &Path) {
    let program = std::env::var_os("CENTAUR_SPLAT_TRANSFORM").expect("CENTAUR_SPLAT_TRANSFORM names the program");
    let output = Command::new(program).arg("-w").args([from, to]).output().unwrap();
    assert!(output.status.success(), "{}: {}", from.display(), String::from_utf8_lossy(&output.stderr));
}

/// Splats after half a turn about x. splat-transform does not rotate SPZ: it reads and writes the file's own axes.
fn turned(splats: &Splats) -> Splats {
    let mut arrays = splats.clone().into_arrays();
    let turn = sh::Rotation::new(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
    arrays.means.iter_mut().for_each(|m| *m *= Vec3::new(1.0, -1.0, -1.0));
    arrays.rotations.iter_mut().for_each(|q| *q = Quat::from_xyzw(1.0, 0.0, 0.0, 0.0) * *q);
    arrays.sh.chunks_exact_mut(sh::coefficients(arrays.sh_degree)).for_each(|c| turn.apply(&mut c[1..]));
    arrays.check().unwrap()
}

/// Asserts that two readers of one file agree up to rounding. Theirs keeps opacities 10⁻⁶ away from 0 and 1.
fn assert_same(what: &str, theirs: &Splats, ours: &Splats, rotation: f32) {
    let loss = Loss::of_splats(theirs, ours);
    let e = loss.max_error;
    assert_eq!(loss.sh_degree, None, "{what}");
    assert!(e.mean < 1e-6 && e.log_scale < 3e-6 && e.opacity < 2e-6 && e.color < 1e-6 && e.sh < 1e-6, "{what}: {e:?}");
    assert!(e.rotation < rotation, "{what}: {e:?}");
}

#[test]
#[ignore = "needs splat-transform: make test-oracles"]
fn both_read_the_same_from_what_is_written_here() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let read_by_them = |file: &Path| -> Splats {
        let to: PathBuf = file.with_extension("theirs.ply");
        convert(file, &to);
        read_scene(&to).unwrap().splats
    };
    let splats = splats();

    let file = at("a.splat");
    splat::write(&file, &splats).unwrap();
    // They convert a byte of a rotation by b/127.5 − 1, but the format's own viewer by b/128 − 1.
    assert_same("splat", &read_by_them(&file), &read_scene(&file).unwrap().splats, 1.0);

    let file = at("a.compressed.ply");
    ply::compressed::write(&file, &splats, PixelFilter::DILATION).unwrap();
    assert_same("compressed PLY", &read_by_them(&file), &read_scene(&file).unwrap().splats, 1e-3);

    for level in [ksplat::Level::Float, ksplat::Level::Half, ksplat::Level::HalfAndByte] {
        let file = at("a.ksplat");
        ksplat::write(&file, &splats, level).unwrap();
        assert_same(&format!("{level:?}"), &read_by_them(&file), &read_scene(&file).unwrap().splats, 1e-3);
    }
    for version in [spz::Version::V2, spz::Version::V3, spz::Version::V4] {
        let file = at("a.spz");
        spz::write(&file, &splats, &spz::Options { version, sh_bits: [8, 8], ..Default::default() }).unwrap();
        assert_same(&format!("{version:?}"), &turned(&read_by_them(&file)), &read_scene(&file).unwrap().splats, 1e-3);
    }
}

#[test]
#[ignore = "needs splat-transform: make test-oracles"]
fn what_they_write_is_read_within_the_quantisation() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let splats = splats();
    ply::write(&at("exact.ply"), &splats).unwrap();
    for name in ["a.splat", "a.compressed.ply", "a.spz"] {
        convert(&at("exact.ply"), &at(name));
    }
    let bound = |what: &str, found: &Splats, limit: SplatError| {
        let e = Loss::of_splats(&splats, found).max_error;
        assert_eq!(e.max(limit), limit, "{what}: {e:?}");
    };
    // They truncate, so errors are a whole step instead of half a step.
    let limit = SplatError { mean: 0.0, rotation: 2.0, log_scale: 1e-6, opacity: 0.004, color: 0.004, sh: 0.0 };
    bound("splat", &read_scene(&at("a.splat")).unwrap().splats, limit);
    let limit =
        SplatError { mean: 1.3e-4, rotation: 0.28, log_scale: 0.0313, opacity: 0.002, color: 0.0037, sh: 0.0665 };
    bound("SPZ", &turned(&read_scene(&at("a.spz")).unwrap().splats), limit);
    // The order differs, so sums are compared.
    let sum = |s: &Splats| s.means().iter().map(|m| m.as_dvec3()).sum::<DVec3>();
    let chunked = read_scene(&at("a.compressed.ply")).unwrap().splats;
    assert_eq!((chunked.len(), chunked.sh_degree()), (COUNT, DEGREE));
    assert!((sum(&chunked) - sum(&splats)).length() < 1e-3 * COUNT as f64, "{} {}", sum(&chunked), sum(&splats));
}
