// Status of training steps; render/gpu/status.rs reads it.
//#import shared/finite.wgsl

struct Status {
    is_short: u32,              // 1: a list was too short for this step or one before it, so that it must not change
                                // anything
    skipped: u32,               // steps of which that is so since the host last made lists longer
    pairs: u32,                 // longest list of (tile, splat) pairs so far
    triangle_pairs: u32,        // longest list of (bin, triangle) pairs so far
    not_finite: atomic<u32>,    // NOT_FINITE_…, of status.rs: what has become NaN or infinite
}
