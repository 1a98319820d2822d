// SH coefficients of splats, as vectors of four floats if each splat's begin at a multiple of four: a GPU issues a
// quarter of the loads, and a software adapter loads a vector of four in the time of two single floats.

//#if FOURS
alias Floats = vec4f;
//#else
alias Floats = f32;
//#end

@group(0) @binding(2) var<storage, read> sh: array<Floats>;

// Coefficients of splat i, [SH_TERMS, 3]: those of the first `terms` terms; the others are 0 or as stored.
fn sh_coefficients(i: u32, terms: u32) -> array<f32, 3u * SH_TERMS> {
    let first = i * SH_LOADS;
    var found: array<f32, 3u * SH_TERMS>;
//#if FOURS
//#for l in 0..SH_LOADS
    if 4u * $lu < 3u * terms {
        let four$l = sh[first + $lu];
        found[4u * $lu] = four$l.x;
        found[4u * $lu + 1u] = four$l.y;
        found[4u * $lu + 2u] = four$l.z;
        found[4u * $lu + 3u] = four$l.w;
    }
//#end
//#else
//#for k in 0..SH_TERMS
    if $ku < terms {
        found[3u * $ku] = sh[first + 3u * $ku];
        found[3u * $ku + 1u] = sh[first + 3u * $ku + 1u];
        found[3u * $ku + 2u] = sh[first + 3u * $ku + 2u];
    }
//#end
//#end
    return found;
}
