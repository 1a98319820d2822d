// One thread per float of level `map.level`: the mean of 2×2 texels of the level before. In training, adam_texels also
// writes level 1. 16 bytes read, 4 written.

//#import shared/view.wgsl
//#import shared/map.wgsl

@group(0) @binding(0) var<uniform> map: Map;
@group(0) @binding(1) var<storage, read_write> texels: array<f32>;

@compute @workgroup_size(256)
fn build(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_index) thread: u32,
) {
    let i = group_index(group) * 256u + thread;
    let width = map.width >> map.level;
    if i >= width * (map.height >> map.level) * map.channels { return; }
    let texel = divide(i, map.channels);        // index, channel
    let at = divide(texel.x, width);            // row, column
    let row = 2u * width * map.channels;
    let finer = level_offset(map, map.level - 1u) + 2u * at.x * row + 2u * at.y * map.channels + texel.y;
    let sum = texels[finer] + texels[finer + map.channels] + texels[finer + row] + texels[finer + row + map.channels];
    texels[level_offset(map, map.level) + i] = 0.25 * sum;
}
