// A step of Adam for $FLOATS. β₁, β₂, their complements to 1 (GAIN_…) and ε are set by the host, see
// render/gpu/adam.rs.

struct Moments {
    first: $FLOATS,
    second: $FLOATS,
}

// Moments after one more gradient.
fn moments_with(g: $FLOATS, before: Moments) -> Moments {
    return Moments(BETA_1 * before.first + GAIN_1 * g, BETA_2 * before.second + GAIN_2 * g * g);
}

// The same up to rounding, as 1 − β is computed from β in f32: used for maps and vertices, whose results for a seed
// would otherwise change.
fn mixed_moments(g: $FLOATS, before: Moments) -> Moments {
    return Moments(mix(g, before.first, BETA_1), mix(g * g, before.second, BETA_2));
}

// Amount to subtract from parameters, ε outside the root. Moments are divided by `correction_1` = 1 − β₁ᵗ and
// `correction_2` = 1 − β₂ᵗ.
fn adam_step(m: Moments, rate: $FLOATS, correction_1: f32, correction_2: f32) -> $FLOATS {
    return rate * (m.first / correction_1) / (sqrt(m.second / correction_2) + EPSILON);
}
