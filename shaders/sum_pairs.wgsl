// Adds up the per-tile sums of a splat in a fixed order of its tiles, so that the sum is the same in every run. On GPUs
// one thread per visible splat and sum: neighbouring threads read a row of sums together, and consecutive rows.
// On software adapters, which execute the lanes of every load in turn, one thread per splat with all of its sums,
// two per load if their number is even. Per (tile, splat) pair 4·SUMS bytes read.

//#import shared/group_index.wgsl
//#import shared/saturating_add.wgsl

//#if PAIRED
alias Value = vec2f;
//#else
alias Value = f32;
//#end

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read> splats: array<u32>;             // in view, by depth
@group(0) @binding(2) var<storage, read> offsets: array<u32>;            // number of the first pair of each
@group(0) @binding(3) var<storage, read> tile_count: array<u32>;         // [splat]
@group(0) @binding(4) var<storage, read> rows: array<Value>;             // [number within the window][VALUES]
@group(0) @binding(5) var<storage, read_write> sums: array<Value>;       // [splat][VALUES]

const THREADS_A_SPLAT: u32 = VALUES / TOGETHER;
//#if BY_EIGHT

// Sum of one value over eight rows.
fn eight(at: u32) -> f32 {
    return ((rows[at] + rows[at + VALUES]) + (rows[at + 2u * VALUES] + rows[at + 3u * VALUES]))
        + ((rows[at + 4u * VALUES] + rows[at + 5u * VALUES]) + (rows[at + 6u * VALUES] + rows[at + 7u * VALUES]));
}
//#end

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let k = group_index(group) * SPLATS + thread / THREADS_A_SPLAT;
    if thread >= SPLATS * THREADS_A_SPLAT || k >= counts[COUNT_VISIBLE] { return; }
    let splat = splats[k];
    let first = offsets[k];
    let end = min(saturating_add(first, tile_count[splat]), min(counts[COUNT_STORED_PAIRS], WINDOW_END));
    let value = thread % THREADS_A_SPLAT * TOGETHER;
    let place = splat * VALUES + value;
    //#for j in 0..TOGETHER
    var sum$j = Value();
    if first < WINDOW_START { sum$j = sums[place + $ju]; }
    //#end
    var row = max(first, WINDOW_START);
//#if BY_EIGHT
    // A splat that covers the whole picture has thousands of rows, and nothing to hide their latency behind: 32 are
    // loaded at once, summed in the same order as eight at a time.
    for (; row + 32u <= end; row += 32u) {
        let at = (row - WINDOW_START) * VALUES + value;
        let first_eight = eight(at);
        let second_eight = eight(at + 8u * VALUES);
        let third_eight = eight(at + 16u * VALUES);
        let last_eight = eight(at + 24u * VALUES);
        sum0 = (((sum0 + first_eight) + second_eight) + third_eight) + last_eight;
    }
    for (; row + 8u <= end; row += 8u) { sum0 += eight((row - WINDOW_START) * VALUES + value); }
//#end
    for (; row < end; row++) {
        let at = (row - WINDOW_START) * VALUES + value;
        //#for j in 0..TOGETHER
        sum$j += rows[at + $ju];
        //#end
    }
    if first >= WINDOW_END { return; }
    //#for j in 0..TOGETHER
    sums[place + $ju] = sum$j;
    //#end
}
