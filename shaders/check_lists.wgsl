// Check whether the lists of a training step were long enough for its view. One thread; runs after the lists are made
// and before anything is learnt from them. Once a list was too short, no step learns until the host has made longer
// lists, so that all of these steps can be repeated, in their order.

//#import shared/view.wgsl
//#import shared/status.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read_write> status: Status;
//#if MESH
@group(0) @binding(3) var<storage, read> triangle_pairs_needed: array<u32>;    // [1]: largest total so far
@group(0) @binding(4) var<storage, read> triangle_pairs: array<u32>;           // [capacity]
//#end

@compute @workgroup_size(1)
fn main() {
    let pairs = counts[COUNT_PAIRS];
    var is_short = pairs > view.pair_capacity;
    status.pairs = max(status.pairs, pairs);
//#if MESH
    is_short = is_short || triangle_pairs_needed[0] > arrayLength(&triangle_pairs);
    status.triangle_pairs = triangle_pairs_needed[0];
//#end
    if is_short { status.is_short = 1u; }
    status.skipped += status.is_short;
}
