// What tiles found of a splat, added up in the order of its tiles: the sum is the same in every run. A thread per splat in
// view and moment; neighbouring threads read a row of moments together, and rows in a row. Per (tile, splat) pair
// 4·MOMENTS bytes read.

//#import shared/group_index.wgsl
//#import shared/saturating_add.wgsl

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read> splats: array<u32>;             // in view, by depth
@group(0) @binding(2) var<storage, read> offsets: array<u32>;            // number of the first pair of each
@group(0) @binding(3) var<storage, read> tile_count: array<u32>;         // [splat]
@group(0) @binding(4) var<storage, read> rows: array<f32>;               // [number within the window][MOMENTS]
@group(0) @binding(5) var<storage, read_write> moments: array<f32>;      // [splat][MOMENTS]

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let k = group_index(group) * SPLATS + thread / MOMENTS;
    let moment = thread % MOMENTS;
    if thread >= SPLATS * MOMENTS || k >= counts[COUNT_VISIBLE] { return; }
    let splat = splats[k];
    let first = offsets[k];
    let end = min(saturating_add(first, tile_count[splat]), min(counts[COUNT_STORED_PAIRS], WINDOW_END));
    var sum = 0.0;
    if first < WINDOW_START { sum = moments[splat * MOMENTS + moment]; }
    for (var row = max(first, WINDOW_START); row < end; row++) { sum += rows[(row - WINDOW_START) * MOMENTS + moment]; }
    if first < WINDOW_END { moments[splat * MOMENTS + moment] = sum; }
}
