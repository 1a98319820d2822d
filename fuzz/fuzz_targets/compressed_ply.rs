#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    centaur_fuzz::splats("scene.compressed.ply", bytes);
});
