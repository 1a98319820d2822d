// What a training step finds out about itself; render/gpu/status.rs reads it.
//#import shared/finite.wgsl

struct Status {
    is_short: u32,              // 1: a list was too short for this step or one before it, so that it must not change anything
    skipped: u32,               // steps of which that is so since the host last made lists longer
    pairs: u32,                 // longest list of (tile, splat) pairs so far
    triangle_pairs: u32,        // longest list of (bin, triangle) pairs so far
    not_finite: atomic<u32>,    // NOT_FINITE_…: what has become NaN or infinite
}

const NOT_FINITE_GEOMETRY: u32 = 1u;
const NOT_FINITE_SH: u32 = 2u;
const NOT_FINITE_BASE: u32 = 4u;
const NOT_FINITE_BANDS: u32 = 8u;
const NOT_FINITE_VERTICES: u32 = 16u;
const NOT_FINITE_EXPOSURES: u32 = 32u;
const NOT_FINITE_POSES: u32 = 64u;
