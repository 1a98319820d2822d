// One pass of a stable radix sort of (key, value) pairs by up to eight bits, least significant digit first. Three
// dispatches: digit counts of blocks, destination of each block's first pair of a digit, scatter. For adapters with
// many lanes; see radix_sort_serial.wgsl for the others.
//
// A BLOCK is 256 threads × 8 consecutive pairs; there are DIGITS = 256. A block is sorted in workgroup memory first, so
// that neighbouring threads write to neighbouring places: by one half of the digit, then by the other. Each thread
// counts the digits of its own pairs, so that the scan over (half, thread) is stable without atomics. Only a word of
// digit and place in the block is moved there; pairs are fetched once they are in order, from the cache. A pass reads
// 12 bytes per pair, that cache apart, and writes 8.

//#import shared/sort_pass.wgsl

const PLACE_BITS: u32 = 11u;
const_assert BLOCK == 1u << PLACE_BITS;
const_assert DIGITS == 256u;            // a thread to each

var<workgroup> digit_counts: array<atomic<u32>, DIGITS>;
var<workgroup> words: array<u32, BLOCK + BLOCK / 32u>;  // by `spread`: counters [half of a digit mod 8][thread], or one
                                                        // word per pair
var<workgroup> digit_base: array<u32, DIGITS>;
var<workgroup> shared_count: u32;

fn block_count(n: u32) -> u32 {
    return (n + BLOCK - 1u) / BLOCK;
}

// Place in `histograms`, which are [digit] of all blocks together, then [digit][block].
fn of_block(digit: u32, block: u32, n_blocks: u32) -> u32 {
    return DIGITS + digit * n_blocks + block;
}

// Padded index, by which 32 threads that read eight consecutive words each hit different banks.
fn spread(place: u32) -> u32 {
    return place + place / 32u;
}

@compute @workgroup_size(256)
fn count(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = item_count();
    let block = group_index(group);
    atomicStore(&digit_counts[thread], 0u);
    workgroupBarrier();
    // Runs of pairs with the same digit are added at once: where all have it, 256 additions to one counter wait for
    // each other in place of 2,048.
    let start = block * BLOCK + thread * 8u;
    var digit = 0u;
    var run = 0u;
    //#for k in 0..8
    if start + $ku < n {
        let d = digit_of(keys_in[start + $ku]);
        if d != digit {
            if run > 0u { atomicAdd(&digit_counts[digit], run); }
            digit = d;
            run = 0u;
        }
        run++;
    }
    //#end
    if run > 0u { atomicAdd(&digit_counts[digit], run); }
    workgroupBarrier();
    let n_blocks = block_count(n);
    if thread <= digit_bits.mask && block < n_blocks {
        histograms[of_block(thread, block, n_blocks)] = atomicLoad(&digit_counts[thread]);
    }
}

// One workgroup per digit: sums over all blocks before each, and over all.
@compute @workgroup_size(256)
fn scan(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    // Loaded uniformly: there are barriers in the loop, and not every compiler sees that all threads read the same
    // value.
    if thread == 0u { shared_count = item_count(); }
    let n_blocks = block_count(workgroupUniformLoad(&shared_count));
    let digit = group_index(group);
    if digit > digit_bits.mask { return; }
    let first = of_block(digit, 0u, n_blocks);
    var carry = 0u;
    for (var base = 0u; base < n_blocks; base += 2048u) {
        let start = base + thread * 8u;
        var sum = 0u;
        //#for k in 0..8
        var v$k = 0u;
        if start + $ku < n_blocks { v$k = histograms[first + start + $ku]; }
        sum += v$k;
        //#end
        var before = carry + workgroup_scan(thread, sum);
        //#for k in 0..8
        if start + $ku < n_blocks { histograms[first + start + $ku] = before; }
        before += v$k;
        //#end
        carry += workgroup_total;
        workgroupBarrier();
    }
    if thread == 0u { histograms[digit] = carry; }
}

// Sorts the words of a block, eight per thread, by four of their bits, and leaves them in `words`.
fn order_by(bits: u32, thread: u32, mine: ptr<function, array<u32, 8>>) {
    // Counters are 16 bits wide (≤ BLOCK): values h and h+8 share a word.
    //#for k in 0..8
    words[spread($ku * 256u + thread)] = 0u;
    //#end
    //#for k in 0..8
    let h$k = ((*mine)[$k] >> bits) & 15u;
    let counter$k = spread((h$k % 8u) * 256u + thread);
    let half$k = (h$k / 8u) * 16u;
    words[counter$k] += 1u << half$k;
    //#end
    workgroupBarrier();
    // Scan of the counters: first the low halves of words in order, then the high ones.
    var sum = 0u;
    //#for k in 0..8
    let c$k = words[spread(thread * 8u + $ku)];
    sum += c$k;
    //#end
    var before = workgroup_scan(thread, sum);
    before += workgroup_total << 16u;
    //#for k in 0..8
    words[spread(thread * 8u + $ku)] = before;
    before += c$k;
    //#end
    workgroupBarrier();
    //#for k in 0..8
    let at$k = words[counter$k];
    words[counter$k] = at$k + (1u << half$k);
    //#end
    workgroupBarrier();
    //#for k in 0..8
    words[spread((at$k >> half$k) & 0xffffu)] = (*mine)[$k];
    //#end
    workgroupBarrier();
}

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let n = item_count();
    let n_blocks = block_count(n);
    let block = group_index(group);
    let first = block * BLOCK;

    // Words behind the last pair get the highest digit, so that they stay behind.
    var mine: array<u32, 8>;
    //#for k in 0..8
    mine[$k] = ((DIGITS - 1u) << PLACE_BITS) | (thread * 8u + $ku);
    if first + thread * 8u + $ku < n {
        mine[$k] = (digit_of(keys_in[first + thread * 8u + $ku]) << PLACE_BITS) | (thread * 8u + $ku);
    }
    //#end
    order_by(PLACE_BITS, thread, &mine);
    //#for k in 0..8
    mine[$k] = words[spread(thread * 8u + $ku)];
    //#end
    workgroupBarrier();
    order_by(PLACE_BITS + 4u, thread, &mine);

    // Destination of a block's pairs of a digit, minus their place in it.
    var of_digit = 0u;
    var base = 0u;
    if thread <= digit_bits.mask && block < n_blocks {
        of_digit = histograms[thread];
        base = histograms[of_block(thread, block, n_blocks)];
    }
    digit_base[thread] = base + workgroup_scan(thread, of_digit);
    workgroupBarrier();
    // The k-th pair to write is number k·256 + thread of the sorted block.
    //#for k in 0..8
    let place$k = $ku * 256u + thread;
    let word$k = words[spread(place$k)];
    let digit$k = word$k >> PLACE_BITS;
    if place$k == 0u || (words[spread(place$k - 1u)] >> PLACE_BITS) != digit$k { digit_base[digit$k] -= place$k; }
    //#end
    workgroupBarrier();
    //#for k in 0..8
    let from$k = first + (word$k & (BLOCK - 1u));
    if from$k < n {
        let to = digit_base[digit$k] + place$k;
        keys_out[to] = keys_in[from$k];
        values_out[to] = values_in[from$k];
    }
    //#end
}
