// A sum that does not come round to small numbers again: what is too long must be seen to be.
fn saturating_add(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}
