#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    centaur_fuzz::capture(&["cameras.txt", "images.txt", "points3D.txt"], bytes);
});
