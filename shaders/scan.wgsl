// Exclusive prefix sum of the first counts[COUNT_WORD] words of `input`; the total goes to counts[TOTAL_WORD]. Sums
// saturate. Three dispatches: sums of blocks, their scan by one workgroup, scan inside blocks. No workgroup waits for
// another (WGSL promises no forward progress), at the price of reading the input twice.

@group(0) @binding(0) var<storage, read_write> counts: array<u32>;
@group(0) @binding(1) var<storage, read> input: array<u32>;
@group(0) @binding(2) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(3) var<storage, read_write> output: array<u32>;

//#import shared/group_index.wgsl
//#import shared/workgroup_scan.wgsl

const BLOCK: u32 = 256u * PER_THREAD;

var<workgroup> shared_count: u32;

fn item_count() -> u32 {
    return min(counts[COUNT_WORD], arrayLength(&input));
}

@compute @workgroup_size(256)
fn sum_blocks(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = item_count();
    let block = group_index(group);
    var sum = 0u;
    for (var k = 0u; k < PER_THREAD; k++) {
        let i = block * BLOCK + k * 256u + thread;
        if i < n { sum = saturating_add(sum, input[i]); }
    }
    workgroup_scan(thread, sum);
    if thread == 0u && block * BLOCK < n { block_sums[block] = workgroup_total; }
}

@compute @workgroup_size(256)
fn scan_sums(@builtin(local_invocation_index) thread: u32) {
    // Loaded uniformly: there are barriers in the loop, and not every compiler sees that all threads read the same
    // value.
    if thread == 0u { shared_count = item_count(); }
    let n_blocks = (workgroupUniformLoad(&shared_count) + BLOCK - 1u) / BLOCK;
    var carry = 0u;
    for (var base = 0u; base < n_blocks; base += 256u) {
        let i = base + thread;
        var sum = 0u;
        if i < n_blocks { sum = block_sums[i]; }
        let before = workgroup_scan(thread, sum);
        if i < n_blocks { block_sums[i] = saturating_add(carry, before); }
        carry = saturating_add(carry, workgroup_total);
        workgroupBarrier();
    }
    if thread == 0u { counts[TOTAL_WORD] = carry; }
}

@compute @workgroup_size(256)
fn scan_blocks(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = item_count();
    let block = group_index(group);
    let start = block * BLOCK + thread * PER_THREAD;
    let end = min(start + PER_THREAD, n);
    var sum = 0u;
    for (var i = start; i < end; i++) { sum = saturating_add(sum, input[i]); }
    var before = saturating_add(block_sums[block], workgroup_scan(thread, sum));
    for (var i = start; i < end; i++) {
        let value = input[i];           // again: from the cache
        output[i] = before;
        before = saturating_add(before, value);
    }
}
