// What all stages must agree on that evaluate a splat at a pixel, or bound where that is worth it.

const EMPTY_DEPTH: f32 = 3.4028234e38;  // of a pixel without a mesh layer: no threshold exceeds it
