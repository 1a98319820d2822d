#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    centaur_fuzz::photograph(&["masks/a.png", "images/a.png"], bytes);
});
