// A step of Adam for one view's rows of $TARGET, for which `step` has the corrections.
//#import shared/adam.wgsl with FLOATS=vec4f

// Updates row i by its gradient g. The status gets $FLAG if the row is no longer finite.
fn learn(i: u32, g: vec4f, rate: f32) {
    let m = moments_with(g, Moments(first[i], second[i]));
    let value = $TARGET[i] - adam_step(m, vec4f(rate), step.correction_1, step.correction_2);
    first[i] = m.first;
    second[i] = m.second;
    $TARGET[i] = value;
    if !(are_finite(value) && are_finite(m.second)) {
        atomicOr(&status.not_finite, $FLAG);
    }
}
