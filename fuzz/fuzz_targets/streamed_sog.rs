#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    centaur_fuzz::scene_of_files(&["lod-meta.json", "fine.sog", "coarse.sog"], bytes);
});
