// Gradients of the SH basis with respect to the direction's components.

fn sh_basis_gradient(d: vec3f) -> array<vec3f, 16> {
    let x = d.x; let y = d.y; let z = d.z;
    let c1 = 0.4886025119029199;
    return array<vec3f, 16>(
        vec3f(0.0),
        vec3f(0.0, -c1, 0.0),
        vec3f(0.0, 0.0, c1),
        vec3f(-c1, 0.0, 0.0),
        1.0925484305920792 * vec3f(y, x, 0.0),
        -1.0925484305920792 * vec3f(0.0, z, y),
        0.31539156525252005 * vec3f(-2.0 * x, -2.0 * y, 4.0 * z),
        -1.0925484305920792 * vec3f(z, 0.0, x),
        0.5462742152960396 * vec3f(2.0 * x, -2.0 * y, 0.0),
        -0.5900435899266435 * vec3f(6.0 * x * y, 3.0 * (x * x - y * y), 0.0),
        2.890611442640554 * vec3f(y * z, x * z, x * y),
        -0.4570457994644658 * vec3f(-2.0 * x * y, 4.0 * z * z - x * x - 3.0 * y * y, 8.0 * y * z),
        0.3731763325901154 * vec3f(-6.0 * x * z, -6.0 * y * z, 6.0 * z * z - 3.0 * x * x - 3.0 * y * y),
        -0.4570457994644658 * vec3f(4.0 * z * z - 3.0 * x * x - y * y, -2.0 * x * y, 8.0 * x * z),
        1.445305721320277 * vec3f(2.0 * x * z, -2.0 * y * z, x * x - y * y),
        -0.5900435899266435 * vec3f(3.0 * (x * x - y * y), -6.0 * x * y, 0.0),
    );
}
