//! Splat codecs on files of other programs. `CENTAUR_DATA` names the folder (default `../shared/data`).

use crate::common::data;
use centaur::format::{Loss, ReadOptions, SplatFile, ksplat, ply, read_scene, spz};
use centaur::scene::{PixelFilter, Splats, bounds, sh};
use glam::Vec3;

#[test]
#[ignore = "needs shared data"]
fn three_gaussians_of_train() {
    let folder = "oracle_metalsplatter/SplatIO/TestData/test-splat.3-points-from-train";
    let exact = read_scene(&data(&format!("{folder}.ply"))).unwrap().splats;
    assert_eq!((exact.len(), exact.sh_degree()), (3, 3));
    let coarse = read_scene(&data(&format!("{folder}.splat"))).unwrap().splats;
    assert_eq!(coarse.means(), exact.means());
    let loss = Loss::of_splats(&exact, &coarse);
    assert_eq!(loss.sh_degree, Some([3, 0]));
    let e = loss.max_error;
    assert!(e.log_scale < 1e-5, "{e:?}");
    // Half a step of 8 bits, or a whole one if the other writer truncates.
    assert!(e.opacity < 1.01 / 255.0 && e.color < 1.01 / 255.0 && e.rotation < 1.5, "{e:?}");
}

/// Asserts the content of the fixtures of splat-transform: a square of four splats with size 0.1 and opacity 0.9 in the
/// plane y = 0, whose red and green increase with x and z.
fn assert_minimal(splats: &Splats, z: [f32; 2], rgb: [f32; 2]) {
    assert_eq!((splats.len(), splats.sh_degree()), (4, 0));
    for i in 0..4 {
        let (column, row) = (i % 2, i / 2);
        assert_eq!(splats.means()[i], Vec3::new(column as f32 - 1.0, 0.0, z[row]), "{i}");
        let scale = splats.log_scales()[i].exp();
        assert!((scale - 0.1).abs().max_element() < 0.0032, "half of a 16th of an e-fold: {scale}");
        assert!((1.0 / (1.0 + (-splats.opacity_logits()[i]).exp()) - 0.9).abs() <= 1.0 / 255.0);
        let shown = sh::rgb_from_dc(splats.sh_of(i)[0]);
        let expected = [rgb[column], rgb[row], 0.5];
        assert!((0..3).all(|c| (shown[c] - expected[c]).abs() < 0.0038), "{i}: {shown:?} {expected:?}");
    }
}

#[test]
#[ignore = "needs shared data"]
fn four_splats_of_splat_transform() {
    let splats = read_scene(&data("oracle_splat_transform/splat/minimal.splat")).unwrap().splats;
    assert_minimal(&splats, [-1.0, 0.0], [1.0 / 3.0, 2.0 / 3.0]);
    // Its writer put w last, where both formats have it first: half a turn about z, which is invisible for a sphere.
    assert!(splats.rotations().iter().all(|q| q.z > 0.9999));
    let splats = read_scene(&data("oracle_splat_transform/splat/minimal.ksplat")).unwrap().splats;
    assert_minimal(&splats, [-1.0, 0.0], [1.0 / 3.0, 2.0 / 3.0]);
    assert!(splats.rotations().iter().all(|q| q.z > 0.9999));
}

#[test]
#[ignore = "needs shared data"]
fn spz_of_three_programs() {
    for file in ["raw", "v2", "v3", "v4"] {
        let splats = read_scene(&data(&format!("oracle_splat_transform/splat/minimal-{file}.spz"))).unwrap().splats;
        assert!(splats.rotations().iter().all(|q| q.w > 0.9999), "{file}");
        let rgb = [1.0 / 3.0, 2.0 / 3.0];
        if matches!(file, "v3" | "v4") {
            assert_minimal(&splats, [-1.0, 0.0], rgb);
        } else {
            // These files have the axes of PLY and plain colours, where the format has y up and 0.15·c + 0.5.
            assert_minimal(&splats, [1.0, 0.0], rgb.map(|c| 0.5 + 0.282_095 * (c - 0.5) / 0.15));
        }
    }

    // The same splats as PLY, with y down there and y up here.
    let exact =
        read_scene(&data("oracle_metalsplatter/SplatIO/TestData/test-splat.3-points-from-train.ply")).unwrap().splats;
    let packed =
        read_scene(&data("oracle_metalsplatter/SplatIO/TestData/test-splat.3-points-from-train.spz")).unwrap().splats;
    let e = Loss::of_splats(&exact, &packed).max_error;
    assert!(e.mean <= 0.5f32.powi(13) + 1e-6 && e.log_scale <= 1.0 / 32.0 + 1e-5 && e.rotation < 0.28, "{e:?}");
    assert!(e.opacity <= 0.5 / 255.0 + 1e-6 && e.color <= 0.0037, "{e:?}");
    // Its writer rounds to 8 bits first and then to 4.
    assert!(e.sh <= 8.5 / 128.0 + 1e-6 && e.sh > 0.0, "{e:?}");

    let exact = read_scene(&data("oracle_javagl/jsplat-examples/data/unitCube-ascii.ply")).unwrap().splats;
    let packed = read_scene(&data("oracle_javagl/jspz-examples/data/unitCube.spz")).unwrap().splats;
    let e = Loss::of_splats(&exact, &packed).max_error;
    assert!(e.mean == 0.0 && e.rotation < 0.8 && e.log_scale <= 1.0 / 32.0 + 1e-5, "{e:?}");
    // The same cube, but with coefficients of ±1 instead of ±1.77 and a logit of 1 instead of 20.
    for i in 0..20 {
        assert!((packed.opacity_logits()[i] - 1.0).abs() < 0.011, "half of 1/255 of the opacity");
        for (a, b) in exact.sh_of(i)[0].iter().zip(packed.sh_of(i)[0]) {
            assert!((a / 1.772_453_9 - b).abs() <= 0.5 / 255.0 / 0.15 + 1e-6, "{a} {b}");
        }
    }

    let path = data("oracle_adobe_usd_plugins/spz/tests/SanitySplats.spz");
    let SplatFile { splats, notes, .. } = spz::read(&path, &ReadOptions::default()).unwrap();
    assert_eq!((splats.len(), splats.sh_degree(), notes.len()), (10, 3, 0));
    assert_eq!(splats.means()[4], Vec3::new(0.0, -0.800_048_8, -0.800_048_8));
}

fn above_the_least_scale_of_spz(splats: Splats) -> Splats {
    let mut arrays = splats.into_arrays();
    arrays.log_scales.iter_mut().for_each(|s| *s = s.max(Vec3::splat(-10.0)));
    arrays.check().unwrap()
}

#[test]
#[ignore = "needs shared data"]
fn biker_is_one_in_compressed_ply_and_spz() {
    let chunked = read_scene(&data("splats_playcanvas/biker.compressed.ply")).unwrap().splats;
    let packed = read_scene(&data("splats_playcanvas/biker.spz")).unwrap().splats;
    // Both files have the splats in the same order.
    let chunked = above_the_least_scale_of_spz(chunked);
    let loss = Loss::of_splats(&chunked, &packed);
    let e = loss.max_error;
    assert_eq!((packed.len(), loss.sh_degree), (152_746, None));
    // Half a step of either format: 2⁻¹³, and 1/2046 of a chunk's extent, the widest of which is 1.02.
    assert!(e.mean < 0.5f32.powi(13) + 1.02 / 2046.0, "{e:?}");
    // 1/32, and 1/2046 of a chunk's range.
    assert!(e.log_scale < 1.0 / 32.0 + 0.005, "{e:?}");
    assert!(e.opacity <= 1.0 / 255.0 && e.color < 0.0037 + 0.002 && e.rotation < 0.56, "{e:?}");

    // Written again in each version, SPZ from SPZ loses only the rounding of rotations.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("biker.spz");
    for version in [spz::Version::V2, spz::Version::V3, spz::Version::V4] {
        let report = spz::write(&path, &packed, &spz::Options { version, ..Default::default() }).unwrap();
        let e = report.loss.max_error;
        assert!(e.mean == 0.0 && e.log_scale == 0.0 && e.opacity < 1e-6 && e.color < 1e-6, "{e:?}");
        assert!(e.rotation < if version == spz::Version::V2 { 13.5 } else { 0.1 }, "{e:?}");
        assert!(report.bytes < 2_500_000, "{version:?} {report:?}");
        assert_eq!(read_scene(&path).unwrap().splats.means(), packed.means());
    }
}

#[test]
#[ignore = "needs shared data"]
fn biker_as_ksplat() {
    let biker = read_scene(&data("splats_playcanvas/biker.compressed.ply")).unwrap().splats;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("biker.ksplat");
    for (level, bytes) in
        [(ksplat::Level::Float, 44.0), (ksplat::Level::Half, 24.0), (ksplat::Level::HalfAndByte, 24.0)]
    {
        let report = ksplat::write(&path, &biker, level).unwrap();
        let e = report.loss.max_error;
        // Buckets need a few more bytes.
        assert!((report.bytes as f64) < 1.02 * bytes * biker.len() as f64 + 5120.0, "{report:?}");
        // Blocks are 3.18/16 wide; the smallest splats have a scale of 1e-5, where f16 has 170 steps.
        assert!(e.mean < 3.18 / 16.0 / 131_068.0 + 3e-7 && e.log_scale < 0.004 && e.rotation < 0.06, "{e:?}");
        assert!(e.opacity < 1e-6 && e.color <= 1.0 / 510.0 + 1e-6, "{e:?}");
        assert_eq!(read_scene(&path).unwrap().splats.len(), biker.len());
    }
}

#[test]
#[ignore = "needs shared data"]
fn compressed_plys_of_playcanvas() {
    let biker = read_scene(&data("splats_playcanvas/biker.compressed.ply")).unwrap().splats;
    assert_eq!((biker.len(), biker.sh_degree()), (152_746, 0));
    // The smallest and largest bounds in the chunks' table.
    let [low, high] = bounds(biker.means().iter().copied()).unwrap();
    assert!((low - Vec3::new(-0.621_256, -3.180_076, -0.532_257)).length() < 1e-5, "{low}");
    assert!((high - Vec3::new(0.414_404, -7.15e-7, 0.613_281)).length() < 1e-5, "{high}");
    let first = Vec3::new(-0.104_536_8, -2.387_898_1, -0.360_811);
    assert!((biker.means()[0] - first).length() < 1e-6, "{}", biker.means()[0]);

    let guitar = read_scene(&data("splats_playcanvas/guitar.compressed.ply")).unwrap().splats;
    assert_eq!((guitar.len(), guitar.sh_degree()), (90_854, 0));

    // Written again, they are as accurate as before, except for the bounds of different chunks.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("biker.compressed.ply");
    let report = ply::compressed::write(&path, &biker, PixelFilter::DILATION).unwrap();
    let e = report.loss.max_error;
    assert!(report.bytes < 2_500_000, "{report:?}");
    assert!(e.mean < 1e-3 && e.rotation < 0.28 && e.log_scale < 0.01 && e.opacity <= 1e-6 && e.color < 0.002, "{e:?}");
    assert_eq!(read_scene(&path).unwrap().splats.len(), biker.len());
}
