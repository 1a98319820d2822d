// Number of workgroups that cover the items in counts[COUNT_WORD], as arguments of indirect dispatches: rows of at most
// WIDEST. One thread per workgroup size.

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read_write> sizes: array<vec4u>;     // workgroups across, down, 1; items to each
@group(0) @binding(2) var<storage, read> most_items: array<u32>;        // [1]

@compute @workgroup_size(4)
fn main(@builtin(local_invocation_index) i: u32) {
    if i >= arrayLength(&sizes) { return; }
    // A count beyond the capacity (an overflow that the host will report) must not reach past the buffers.
    let items = min(counts[COUNT_WORD], most_items[0]);
    let block = sizes[i].w;
    let groups = (items + block - 1u) / block;
    // Folded as by Frame::dispatch: kernels index their groups row by row and ignore surplus ones.
    sizes[i] = vec4u(min(groups, WIDEST), max((groups + WIDEST - 1u) / WIDEST, 1u), 1u, block);
}
