// One pass of a stable radix sort of (key, value) pairs by up to eight bits, least significant digit first, for
// software adapters: few cores, lanes that read and write one by one, expensive barriers. Each thread walks a long
// chunk of consecutive pairs with its own DIGITS = 256 counters, which is stable by construction and needs no barrier.
// Same three dispatches as radix_sort.wgsl: histograms, [chunk][digit], their scan in digit-major order, scatter.

//#import shared/sort_pass.wgsl

const LANES: u32 = 8u;
const SHORTEST_CHUNK: u32 = 1024u;      // shorter chunks cost more for counters than for pairs

var<workgroup> counters: array<u32, LANES * DIGITS>;    // [lane][digit]

fn chunk_length(n: u32) -> u32 {
    return max((n + MAX_CHUNKS - 1u) / MAX_CHUNKS, SHORTEST_CHUNK);
}

@compute @workgroup_size(8)
fn count(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3u) {
    let n = item_count();
    let length = chunk_length(n);
    let chunk = group_index(group) * LANES + lane;
    let start = chunk * length;
    if start >= n { return; }
    let end = min(start + length, n);
    let mine = lane * DIGITS;
    for (var d = 0u; d <= digit_bits.mask; d++) { counters[mine + d] = 0u; }
    for (var i = start; i < end; i++) {
        counters[mine + digit_of(keys_in[i])] += 1u;
    }
    for (var d = 0u; d <= digit_bits.mask; d++) { histograms[chunk * DIGITS + d] = counters[mine + d]; }
}

@compute @workgroup_size(256)
fn scan(@builtin(local_invocation_index) digit: u32) {
    let n = item_count();
    let length = chunk_length(n);
    let n_chunks = (n + length - 1u) / length;
    var sum = 0u;
    if digit <= digit_bits.mask {
        for (var c = 0u; c < n_chunks; c++) { sum += histograms[c * DIGITS + digit]; }
    }
    var before = workgroup_scan(digit, sum);
    if digit <= digit_bits.mask {
        for (var c = 0u; c < n_chunks; c++) {
            let here = histograms[c * DIGITS + digit];
            histograms[c * DIGITS + digit] = before;
            before += here;
        }
    }
}

@compute @workgroup_size(8)
fn scatter(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3u) {
    let n = item_count();
    let length = chunk_length(n);
    let chunk = group_index(group) * LANES + lane;
    let start = chunk * length;
    if start >= n { return; }
    let end = min(start + length, n);
    let mine = lane * DIGITS;
    for (var d = 0u; d <= digit_bits.mask; d++) { counters[mine + d] = histograms[chunk * DIGITS + d]; }
    for (var i = start; i < end; i++) {
        let key = keys_in[i];
        let slot = mine + digit_of(key);
        let to = counters[slot];
        counters[slot] = to + 1u;
        keys_out[to] = key;
        values_out[to] = values_in[i];
    }
}
