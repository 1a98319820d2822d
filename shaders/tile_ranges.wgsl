// First and one-past-last pair of every tile in the sorted list, and in training the splat of every pair. `ranges` must
// be zeroed before. Two invocations write the halves of what others read as one vec2u, hence single words: a write to a
// component of a vector may write all of it.
//#import shared/view.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<u32>;
//#if TRAIN
@group(0) @binding(4) var<storage, read_write> values: array<u32>;       // [pair]: its number as emitted → its splat
@group(0) @binding(5) var<storage, read> splat_of: array<u32>;           // [number as emitted]
@group(0) @binding(6) var<storage, read_write> numbered: array<vec2u>;   // [pair]: splat, number
//#end

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
//#if TRAIN
    let number = values[i];
    let splat = splat_of[number];
    values[i] = splat;
    numbered[i] = vec2u(splat, number);
    // The number of pairs, after the ranges of the tiles.
    if i == 0u { ranges[2u * tiles] = n; }
//#end
    if tile >= tiles { return; }
    if i == 0u || keys[i - 1u] != tile { ranges[2u * tile] = i; }
    if i + 1u == n || keys[i + 1u] != tile { ranges[2u * tile + 1u] = i + 1u; }
}
