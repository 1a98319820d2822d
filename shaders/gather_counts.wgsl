// Tile counts of the visible splats in depth order, for the prefix sum that places their (tile, splat) pairs.
//#import shared/view.wgsl

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read> splats: array<u32>;
@group(0) @binding(2) var<storage, read> tile_count: array<u32>;
@group(0) @binding(3) var<storage, read_write> sorted_count: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let k = group_index(group) * 256u + thread;
    if k >= counts[COUNT_VISIBLE] { return; }
    sorted_count[k] = tile_count[splats[k]];
}
