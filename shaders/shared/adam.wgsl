// Adam's constants (INRIA 3DGS, scene/gaussian_model.py).

const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-15;             // outside the root
