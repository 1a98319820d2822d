// Sums over the 256 threads of a workgroup, for $ROWS vectors each: sums[row * 256 + thread], set by every thread, end
// up in the rows' first entries.
var<workgroup> sums: array<vec4f, $ROWS * 256>;

// Adds the second half of each row's entries to the first, and so on.
fn add_up(thread: u32) {
    for (var half = 128u; half > 0u; half >>= 1u) {
        workgroupBarrier();
        if thread < half {
            for (var row = 0u; row < $ROWSu; row++) { sums[row * 256u + thread] += sums[row * 256u + thread + half]; }
        }
    }
    workgroupBarrier();
}
