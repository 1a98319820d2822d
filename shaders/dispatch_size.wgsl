// Workgroups that cover the number of items in counts[COUNT_WORD], as arguments of an indirect dispatch.

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read_write> size: array<u32>;

@compute @workgroup_size(1)
fn main() {
    // A count beyond the capacity (an overflow that the host will report) must not reach past the buffers.
    let items = min(counts[COUNT_WORD], CAPACITY);
    size[0] = (items + BLOCK - 1u) / BLOCK;
    size[1] = 1u;
    size[2] = 1u;
}
