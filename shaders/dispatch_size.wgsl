// Workgroups that cover the number of items in counts[COUNT_WORD], as arguments of an indirect dispatch: rows of
// at most WIDEST.

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read_write> size: array<u32>;     // workgroups across, down, 1; most items

@compute @workgroup_size(1)
fn main() {
    // A count beyond the capacity (an overflow that the host will report) must not reach past the buffers.
    let items = min(counts[COUNT_WORD], size[3]);
    let groups = (items + BLOCK - 1u) / BLOCK;
    // As Frame::dispatch folds: kernels index their groups row by row and leave out those that are too many.
    size[0] = min(groups, WIDEST);
    size[1] = max((groups + WIDEST - 1u) / WIDEST, 1u);
    size[2] = 1u;
}
