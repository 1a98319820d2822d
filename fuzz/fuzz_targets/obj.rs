#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    centaur_fuzz::mesh("mesh.obj", bytes);
});
