// shared/spread.wgsl with LANES lanes, whatever the adapter has: one thread simulates them in turn. The value a lane
// receives is one that another lane left in the previous round: after one more round than there are consecutive
// exchanges, all lanes have the values that they would have in lockstep.
//#import shared/spread.wgsl with EXCHANGE=exchange

@group(0) @binding(0) var<storage, read> addends: array<f32>;           // [lane][splat, of two][SUMS]
@group(0) @binding(1) var<storage, read_write> totals: array<vec4f>;    // [lane]: from `spread`; the last of four is 0
@group(0) @binding(2) var<storage, read_write> whose: array<vec4u>;     // [lane]: from `places`; the last of four is 0

const EXCHANGES: u32 = 32u;     // at most, per call of `spread`
const TIMES: u32 = 7u;

var<workgroup> left: array<f32, EXCHANGES * LANES>;     // [exchange][lane]
var<private> this_lane: u32;
var<private> exchanges: u32;                            // in this call so far

fn exchange(value: f32, apart: u32) -> f32 {
    let first = exchanges * LANES;
    exchanges += 1u;
    left[first + this_lane] = value;
    return left[first + (this_lane ^ apart)];
}

@compute @workgroup_size(1)
fn main() {
    for (var time = 0u; time < TIMES; time++) {
        for (var lane = 0u; lane < LANES; lane++) {
            this_lane = lane;
            exchanges = 0u;
            var a: array<f32, SUMS>;
            var b: array<f32, SUMS>;
            for (var c = 0u; c < SUMS; c++) {
                a[c] = addends[2u * SUMS * lane + c];
                b[c] = addends[2u * SUMS * lane + SUMS + c];
            }
            totals[lane] = vec4f(spread(a, b, lane, LANES), 0.0);
            whose[lane] = vec4u(places(lane, LANES), 0u);
        }
    }
}
