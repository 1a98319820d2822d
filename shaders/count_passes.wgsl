// Counts a compute pass as its last dispatch, so that passes which the driver aborts are missing; see
// render/gpu/device/pass_count.rs. One thread.

struct PassCount {
    reached: u32,                       // passes that have run to their end
    start: u32,                         // passes submitted before the present submission,
    end: u32,                           // and with it
}

@group(0) @binding(0) var<storage, read_write> count: PassCount;

@compute @workgroup_size(1)
fn main() {
    // Once a pass is missing, or the writes before a submission and with them `start` and `end`, no other is counted.
    // Differences, as numbers wrap around.
    if count.reached - count.start < count.end - count.start { count.reached += 1u; }
}
