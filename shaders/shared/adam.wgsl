// A step of Adam for $FLOATS. β₁, β₂, what is left to 1 of each (GAIN_…) and ε are the host's, see render/gpu/adam.rs.

struct Moments {
    first: $FLOATS,
    second: $FLOATS,
}

// With one gradient more.
fn moments_with(g: $FLOATS, before: Moments) -> Moments {
    return Moments(BETA_1 * before.first + GAIN_1 * g, BETA_2 * before.second + GAIN_2 * g * g);
}

// The same but for rounding, as 1 − β is taken of β in f32: what maps and vertices are moved by, whose seeds would else be other scenes.
fn mixed_moments(g: $FLOATS, before: Moments) -> Moments {
    return Moments(mix(g, before.first, BETA_1), mix(g * g, before.second, BETA_2));
}

// By how much the parameters fall, ε outside the root. Moments are divided by `correction_1` = 1 − β₁ᵗ and `correction_2` = 1 − β₂ᵗ.
fn adam_step(m: Moments, rate: $FLOATS, correction_1: f32, correction_2: f32) -> $FLOATS {
    return rate * (m.first / correction_1) / (sqrt(m.second / correction_2) + EPSILON);
}
