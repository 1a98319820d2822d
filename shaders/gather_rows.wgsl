// Rearranges rows of splats: all changed rows are fetched before any is placed. Moments of Adam may be zeroed instead.
// WIDTH floats per row, moved as bits, so that subnormal numbers survive. HOLDS_MOMENTS: 1 if rows hold moments;
// OPACITY: the column of the opacity, or WIDTH if there is none.
//#import shared/group_index.wgsl

struct Change {
    row: u32,
    source: u32, // see `Source`
}

@group(0) @binding(0) var<uniform> size: vec4u; // changes, 0, 0, 0
@group(0) @binding(1) var<storage, read> changes: array<Change>;
@group(0) @binding(2) var<storage, read_write> rows: array<u32>;
@group(0) @binding(3) var<storage, read_write> fetched: array<u32>; // [change][WIDTH]

@compute @workgroup_size(256)
fn fetch(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let at = group_index(group) * 256u + thread;
    let k = at / WIDTH;
    if k >= size.x { return; }
    let column = at - k * WIDTH;
    let source = changes[k].source;
    if HOLDS_MOMENTS == 1u && ((source & FRESH) != 0u || (column == OPACITY && (source & FRESH_OPACITY) != 0u)) {
        fetched[at] = 0u;
        return;
    }
    fetched[at] = rows[(source & SPLAT) * WIDTH + column];
}

@compute @workgroup_size(256)
fn place(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let at = group_index(group) * 256u + thread;
    let k = at / WIDTH;
    if k >= size.x { return; }
    rows[changes[k].row * WIDTH + at - k * WIDTH] = fetched[at];
}
