// Sum that saturates instead of wrapping around, so that an excessive length is still seen to be.
fn saturating_add(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}
