// Sums in fixed point: integers come to the same whatever the order of their terms, which is another one in every run.
// Units are of what the view's largest term is FIXED_ONE of: 2,048 terms as large as that one fit, and what is 2⁻²¹ of it
// or less is lost.

const FIXED_ONE: f32 = 1048576.0;

// Units per 1, by the bits of the largest term.
fn fixed_scale(peak: u32) -> f32 {
    let largest = bitcast<f32>(peak);
    return select(FIXED_ONE / largest, 0.0, largest < 1e-30);
}

// 1 per unit; not finite where the largest term was not.
fn fixed_unit(peak: u32) -> f32 {
    return bitcast<f32>(peak) / FIXED_ONE;
}
