// One thread per float of level 0: adds what its ancestors in the coarser levels got, a quarter per level, so that
// level 0 holds the whole gradient. 4 bytes read per level, 4 written.

//#import shared/view.wgsl
//#import shared/map.wgsl

@group(0) @binding(0) var<uniform> map: Map;
@group(0) @binding(1) var<storage, read_write> gradient: array<f32>;

@compute @workgroup_size(256)
fn pull(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) n_groups: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group, n_groups) * 256u + thread;
    if i >= map.width * map.height * map.channels { return; }
    let channel = i % map.channels;
    let x = i / map.channels % map.width;
    let y = i / map.channels / map.width;
    var sum = gradient[map.offset + i];
    var quarter = 1.0;
    for (var level = 1u; level < map.levels; level += 1u) {
        quarter *= 0.25;
        let texel = (y >> level) * (map.width >> level) + (x >> level);
        sum += quarter * gradient[level_offset(map, level) + texel * map.channels + channel];
    }
    gradient[map.offset + i] = sum;
}
