#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    centaur_fuzz::scene_and_mesh("scene.glb", bytes);
});
