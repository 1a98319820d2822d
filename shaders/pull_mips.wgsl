// One thread per float of level `map.level`: the sum in fixed point becomes a float, in the same unit, and a quarter of the
// parent's is added. Run from the coarsest level, which has none, down to level 1; adam_texels does level 0 in passing.
// 8 bytes read, 4 written.

//#import shared/view.wgsl
//#import shared/map.wgsl

@group(0) @binding(0) var<uniform> map: Map;
@group(0) @binding(1) var<storage, read_write> gradient: array<u32>;  // bits of an i32, then of an f32

@compute @workgroup_size(256)
fn pull(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    let width = map.width >> map.level;
    if i >= width * (map.height >> map.level) * map.channels { return; }
    let own = level_offset(map, map.level) + i;
    var sum = f32(bitcast<i32>(gradient[own]));
    if map.level + 1u < map.levels { sum += 0.25 * bitcast<f32>(gradient[parent_of(map, map.level, i)]); }
    gradient[own] = bitcast<u32>(sum);
}
