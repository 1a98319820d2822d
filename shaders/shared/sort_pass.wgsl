// What a pass of either radix sort is given: its digit, and the buffers.

struct Pass {
    shift: u32,
    mask: u32,
}

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read> keys_in: array<u32>;
@group(0) @binding(2) var<storage, read> values_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> histograms: array<u32>;  // each kernel orders it in its own way
@group(0) @binding(6) var<uniform> digit_bits: Pass;

//#import shared/group_index.wgsl
//#import shared/workgroup_scan.wgsl

fn item_count() -> u32 {
    return min(counts[COUNT_WORD], arrayLength(&keys_in));
}

fn digit_of(key: u32) -> u32 {
    return (key >> digit_bits.shift) & digit_bits.mask;
}
