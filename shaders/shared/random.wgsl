// Four random words from four: PCG4D of Jarzynski and Olano, "Hash Functions for GPU Rendering" (2020).
fn random_words(key: vec4u) -> vec4u {
    var v = key * 1664525u + 1013904223u;
    for (var round = 0u; round < 2u; round++) {
        v.x += v.y * v.w;
        v.y += v.z * v.x;
        v.z += v.x * v.y;
        v.w += v.y * v.z;
        if round == 0u { v ^= v >> vec4u(16u); }
    }
    return v;
}

// Numbers in [0, 1) from such words, by 24 bits, so that the conversion is exact.
fn unit_numbers(words: vec4u) -> vec4f {
    return vec4f(words >> vec4u(8u)) * (1.0 / 16777216.0);
}
