// Adam's constants (METHODS 2.7).

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-15;             // outside the root
