//! Memory of LPIPS with VGG while it compares two pictures, as documented.

#![allow(clippy::unwrap_used, reason = "a failed unwrap is a failed test")]

use centaur::metrics::{Lpips, LpipsRange};
use image::Rgb32FImage;
use peak_alloc::PeakAlloc;
use safetensors::{Dtype, tensor::TensorView};

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Zero weights, which take as long as any.
fn weights() -> Vec<u8> {
    let zeros = vec![0; 4 * 512 * 512 * 9];
    let mut views = vec![];
    let mut put = |name: String, shape: Vec<usize>| {
        let bytes = 4 * shape.iter().product::<usize>();
        views.push((name, TensorView::new(Dtype::F32, shape, &zeros[..bytes]).unwrap()));
    };
    let mut channels = 3;
    for (block, (count, outputs)) in [(2, 64), (2, 128), (3, 256), (3, 512), (3, 512)].into_iter().enumerate() {
        for i in 1..=count {
            put(format!("conv{}_{i}.weight", block + 1), vec![outputs, channels, 3, 3]);
            put(format!("conv{}_{i}.bias", block + 1), vec![outputs]);
            channels = outputs;
        }
        put(format!("lin{block}.weight"), vec![1, outputs, 1, 1]);
    }
    safetensors::serialize(views, None).unwrap()
}

#[test]
fn a_pixel_takes_768_bytes_and_the_file_only_its_weights() {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), weights()).unwrap();
    // A file may be longer than the part that is needed.
    file.as_file().set_len(4 << 30).unwrap();
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    let lpips = Lpips::open(file.path()).unwrap();
    let held = MEMORY.current_usage() - before;
    // The weights, plus those of one layer while they are reordered.
    let most = MEMORY.peak_usage() - before;
    assert!(held < 60_000_000 && most < 70_000_000, "{held} bytes, {most} at most");

    let picture = Rgb32FImage::from_pixel(256, 192, image::Rgb([0.5; 3]));
    // Patches of 4 MB per thread, packed for the matrix product: with many threads they would exceed the maps.
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    one_thread.install(|| lpips.distances(&picture, &picture, LpipsRange::Normalized)).unwrap();
    let most = MEMORY.peak_usage() - before;
    assert!(most <= 768 * 256 * 192 + (5 << 20), "{most} bytes, {} a pixel", most / (256 * 192));
}
