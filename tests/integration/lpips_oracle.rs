//! LPIPS compared with the authors' package with random and with the published weights, at every depth: `make
//! oracle-lpips` writes the fixture and sets `CENTAUR_LPIPS_FIXTURE` to its folder.

use std::path::Path;

use centaur::metrics::{Lpips, LpipsRange};
use image::{Rgb, Rgb32FImage};
use serde_json::Value;

fn picture(width: u32, height: u32, bytes: &Value) -> Rgb32FImage {
    let bytes: Vec<f32> = bytes.as_array().unwrap().iter().map(|b| b.as_f64().unwrap() as f32 / 255.0).collect();
    Rgb32FImage::from_fn(width, height, |x, y| {
        let at = 3 * (y * width + x) as usize;
        Rgb([bytes[at], bytes[at + 1], bytes[at + 2]])
    })
}

#[test]
#[ignore = "needs `make oracle-lpips`"]
fn every_depth_is_that_of_the_package() {
    let folder = std::env::var("CENTAUR_LPIPS_FIXTURE").expect("CENTAUR_LPIPS_FIXTURE: the folder of the fixture");
    for net in ["random-vgg", "random-alex", "published-vgg", "published-alex"] {
        let lpips = Lpips::open(&Path::new(&folder).join(format!("{net}.safetensors"))).unwrap();
        let text = std::fs::read(Path::new(&folder).join(format!("{net}.json"))).unwrap();
        let cases: Vec<Value> = serde_json::from_slice(&text).unwrap();
        assert!(!cases.is_empty());
        for case in cases {
            let [width, height] = ["width", "height"].map(|side| case[side].as_u64().unwrap() as u32);
            let [a, b] = [0, 1].map(|i| picture(width, height, &case["pictures"][i]));
            for (range, name) in [(LpipsRange::Normalized, "normalized"), (LpipsRange::Unnormalized, "unnormalized")] {
                let found = lpips.distances(&a, &b, range).unwrap();
                let expected: Vec<f64> = case[name].as_array().unwrap().iter().map(|d| d.as_f64().unwrap()).collect();
                let relative: Vec<f64> = found.iter().zip(&expected).map(|(f, e)| (f / e - 1.0).abs()).collect();
                println!("{net} {width}×{height} {name}: {found:?}, relative differences {relative:?}");
                assert_eq!((found.len(), expected.len()), (5, 5));
                assert!(relative.iter().all(|r| *r < 1e-5), "{net} {name}: {found:?} {expected:?}");
            }
        }
    }
}

/// The value in Brush's tests for two of their pictures, by a port of the package.
#[test]
#[ignore = "needs `make oracle-lpips` with shared data"]
fn a_distance_that_others_published() {
    let folder = std::env::var("CENTAUR_DATA").expect("CENTAUR_DATA: the folder of shared data");
    let [a, b] = ["apple", "pear"].map(|name| {
        let file = Path::new(&folder).join("oracle_lpips/brush").join(name).with_extension("png");
        image::open(file).unwrap().to_rgb32f()
    });
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("out/lpips-vgg.safetensors");
    let lpips = Lpips::open(&weights).unwrap();
    let [normalized, unnormalized] =
        [LpipsRange::Normalized, LpipsRange::Unnormalized].map(|range| lpips.distances(&a, &b, range).unwrap());
    let [normalized, unnormalized] = [normalized, unnormalized].map(|depths| depths.iter().sum::<f64>());
    println!("apple and pear: {normalized} of colours in −1…1, {unnormalized} in 0…1");
    assert!((normalized - 0.6571019887924194).abs() < 1e-5);
}
