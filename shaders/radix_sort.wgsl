// One pass of a stable radix sort of (key, value) pairs by four bits, least significant digit first. Three dispatches:
// digit histograms of blocks, their scan in digit-major order, scatter. For adapters with many lanes; see
// radix_sort_serial.wgsl for the other kind.
//
// A BLOCK is 256 threads × 8 consecutive pairs; there are DIGITS = 16. Each thread counts its own pairs per digit, so that the scan over
// (digit, thread) is stable without atomics. Counters are 16 bits wide (≤ 2048): digits d and d+8 share a word.
// Pairs are put in order in workgroup memory first, so that the writes of neighbouring threads are neighbours.

struct Pass {
    shift: u32,
    mask: u32,
}

@group(0) @binding(0) var<storage, read> counts: array<u32>;
@group(0) @binding(1) var<storage, read> keys_in: array<u32>;
@group(0) @binding(2) var<storage, read> values_in: array<u32>;
@group(0) @binding(3) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(4) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> histograms: array<u32>;  // [digit][block]
@group(0) @binding(6) var<uniform> digit_bits: Pass;

//#import shared/group_index.wgsl
//#import shared/workgroup_scan.wgsl

var<workgroup> counters: array<u32, BLOCK>;     // [digit mod 8][thread]; later one word per pair
var<workgroup> digit_base: array<u32, DIGITS>;

fn item_count() -> u32 {
    return min(counts[COUNT_WORD], arrayLength(&keys_in));
}

fn digit_of(key: u32) -> u32 {
    return (key >> digit_bits.shift) & digit_bits.mask;
}

fn counter(digit: u32, thread: u32) -> u32 {
    return (digit % 8u) * 256u + thread;
}

fn half(digit: u32) -> u32 {
    return (digit / 8u) * 16u;
}

// Clears this thread's counters and counts its pairs.
fn count_digits(thread: u32, start: u32, n: u32) {
    //#for k in 0..8
    counters[$ku * 256u + thread] = 0u;
    //#end
    //#for k in 0..8
    if start + $ku < n {
        let d = digit_of(keys_in[start + $ku]);
        counters[counter(d, thread)] += 1u << half(d);
    }
    //#end
    workgroupBarrier();
}

@compute @workgroup_size(256)
fn count(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = item_count();
    let block = group_index(group);
    count_digits(thread, block * BLOCK + thread * 8u, n);
    // 32 threads per pair of digits add eight words each.
    var sum = 0u;
    //#for k in 0..8
    sum += counters[thread * 8u + $ku];
    //#end
    row_values[thread] = sum;
    workgroupBarrier();
    let n_blocks = (n + BLOCK - 1u) / BLOCK;
    if thread < DIGITS && block < n_blocks {
        sum = 0u;
        for (var i = 0u; i < 32u; i++) { sum += row_values[(thread % 8u) * 32u + i]; }
        histograms[thread * n_blocks + block] = (sum >> half(thread)) & 0xffffu;
    }
}

@compute @workgroup_size(256)
fn scan(@builtin(local_invocation_index) thread: u32) {
    let n_entries = (item_count() + BLOCK - 1u) / BLOCK * DIGITS;
    var carry = 0u;
    for (var base = 0u; base < n_entries; base += 2048u) {
        let start = base + thread * 8u;
        var sum = 0u;
        //#for k in 0..8
        var v$k = 0u;
        if start + $ku < n_entries { v$k = histograms[start + $ku]; }
        sum += v$k;
        //#end
        var before = carry + workgroup_scan(thread, sum);
        //#for k in 0..8
        if start + $ku < n_entries { histograms[start + $ku] = before; }
        before += v$k;
        //#end
        carry += workgroup_total;
        workgroupBarrier();
    }
}

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = item_count();
    let block = group_index(group);
    let first = block * BLOCK;
    let start = first + thread * 8u;
    count_digits(thread, start, n);

    // Scan of the counters: first the low halves in order, then the high ones.
    var sum = 0u;
    //#for k in 0..8
    let c$k = counters[thread * 8u + $ku];
    sum += c$k;
    //#end
    let prefix = workgroup_scan(thread, sum);
    var before = prefix + (workgroup_total << 16u);
    //#for k in 0..8
    counters[thread * 8u + $ku] = before;
    before += c$k;
    //#end
    workgroupBarrier();
    if thread < DIGITS {
        let n_blocks = (n + BLOCK - 1u) / BLOCK;
        let in_block = (counters[counter(thread, 0u)] >> half(thread)) & 0xffffu;
        digit_base[thread] = histograms[thread * n_blocks + block] - in_block;
    }
    workgroupBarrier();

    // Rank inside the block.
    //#for k in 0..8
    var key$k = 0u;
    var rank$k = 0u;
    if start + $ku < n {
        key$k = keys_in[start + $ku];
        let d = digit_of(key$k);
        let word = counters[counter(d, thread)];
        rank$k = (word >> half(d)) & 0xffffu;
        counters[counter(d, thread)] = word + (1u << half(d));
    }
    //#end
    workgroupBarrier();
    //#for k in 0..8
    if start + $ku < n { counters[rank$k] = key$k; }
    //#end
    workgroupBarrier();
    // The k-th pair to write is number k·256 + thread of the ordered block.
    //#for k in 0..8
    var to$k = 0u;
    if first + $ku * 256u + thread < n {
        let key = counters[$ku * 256u + thread];
        to$k = digit_base[digit_of(key)] + $ku * 256u + thread;
        keys_out[to$k] = key;
    }
    //#end
    workgroupBarrier();
    //#for k in 0..8
    if start + $ku < n { counters[rank$k] = values_in[start + $ku]; }
    //#end
    workgroupBarrier();
    //#for k in 0..8
    if first + $ku * 256u + thread < n { values_out[to$k] = counters[$ku * 256u + thread]; }
    //#end
}
