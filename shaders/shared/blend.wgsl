// What all stages must agree on that evaluate a splat at a pixel, or bound where that is worth it.

const ALPHA_CUT: f32 = 1.0 / 255.0;     // contributions below are skipped (3DGS)
const ALPHA_CAP: f32 = 0.99;            // (3DGS)
const EMPTY_DEPTH: f32 = 3.4028234e38;  // of a pixel without a mesh layer: no threshold exceeds it
