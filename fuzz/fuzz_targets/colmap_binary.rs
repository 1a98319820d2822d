#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    centaur_fuzz::capture(&["cameras.bin", "images.bin", "points3D.bin"], bytes);
});
