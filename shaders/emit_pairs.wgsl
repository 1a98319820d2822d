// Writes a (tile, splat) pair for every tile that a visible splat touches, in depth order, so that a stable sort by
// tile alone leaves every tile's list in depth order. In training the sorted value is the pair's number, by which
// tile_ranges finds its splat, and the blend's backward pass the row for its sums, beside those of the splat's other
// tiles.
//#import shared/view.wgsl
//#import shared/tile_rows.wgsl
//#import shared/saturating_add.wgsl

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read_write> counts: array<u32>;
@group(0) @binding(2) var<storage, read> splats: array<u32>;
@group(0) @binding(3) var<storage, read> offsets: array<u32>;
//#if TRAIN
@group(0) @binding(4) var<storage, read_write> tile_count: array<u32>;
//#else
@group(0) @binding(4) var<storage, read> tile_count: array<u32>;
//#end
@group(0) @binding(5) var<storage, read> projected: array<vec4f>;
@group(0) @binding(6) var<storage, read_write> keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> values: array<u32>;
//#if TRAIN
@group(0) @binding(8) var<storage, read_write> splat_of: array<u32>;     // [pair as emitted]
//#end

fn emit(at: u32, tile: u32, splat: u32) {
    keys[at] = tile;
//#if TRAIN
    values[at] = at;
    splat_of[at] = splat;
//#else
    values[at] = splat;
//#end
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let k = group_index(group) * 256u + thread;
    if k == 0u {
        // More pairs than fit: the frame is incomplete. The host sees the total, grows the buffers and repeats it.
        counts[COUNT_STORED_PAIRS] = min(counts[COUNT_PAIRS], view.pair_capacity);
    }
    if k >= counts[COUNT_VISIBLE] { return; }
    let i = splats[k];
    let a = projected[3u * i];
    let e = ellipse(a.xy, projected[3u * i + 1u].xyz, a.w);
    var at = offsets[k];
    let end = min(saturating_add(at, tile_count[i]), view.pair_capacity);
    let rows = row_span(e, view.tiles);
    for (var row = rows.x; row < rows.y; row++) {
        let columns = column_span(e, row, view.tiles);
        for (var column = columns.x; column < columns.y; column++) {
            if at >= end { return; }
            emit(at, row * view.tiles.x + column, i);
            at++;
        }
    }
    // Two kernels may round differently: pairs that were counted but not found go to a tile that does not exist, and
    // contribute nothing.
//#if TRAIN
    if at < end { tile_count[i] = at - offsets[k]; }
//#end
    for (; at < end; at++) {
        emit(at, view.tiles.x * view.tiles.y, i);
    }
}
