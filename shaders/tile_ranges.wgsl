// First and one-past-last pair of every tile in the sorted list. `ranges` must be zeroed before. Two invocations write what others
// read as one vec2u, by words: a write to a component of a vector may write all of it.
//#import shared/view.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    let n = counts[COUNT_STORED_PAIRS];
    let tiles = view.tiles.x * view.tiles.y;
    if i >= n { return; }
    let tile = keys[i];
    if tile >= tiles { return; }
    if i == 0u || keys[i - 1u] != tile { ranges[2u * tile] = i; }
    if i + 1u == n || keys[i + 1u] != tile { ranges[2u * tile + 1u] = i + 1u; }
}
